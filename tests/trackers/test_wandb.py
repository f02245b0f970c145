"""Offline runs of wandb, as wandb's own reader tells them."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthreg.data.io import write_png
from depthreg.report import Results
from depthreg.trackers import Run
from depthreg.trackers.wandb import WandbTracker

MakeRun = Callable[..., Run]


def read(folder: Path) -> list[dict[str, Any]]:
    """The records of a run's only offline folder."""
    (log,) = folder.glob("wandb/offline-run-*/run-*.wandb")
    command = [str(Path(sys.executable).with_name("wandb")), "leet", "inspect", "--json", str(log)]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [json.loads(line) for line in lines]


def only(records: list[dict[str, Any]], kind: str) -> dict[str, Any]:
    (found,) = [record[kind] for record in records if record["type"] == kind]
    return found


def history(records: list[dict[str, Any]], key: str) -> list[tuple[int, float]]:
    """Step and value wherever a metric was logged."""
    rows = [record["history"]["item"] for record in records if record["type"] == "history"]
    return [(row.get("trainer/global_step"), row[key]) for row in rows if key in row]


def test_a_curriculum_is_one_run_with_curves_by_stage(make_run: MakeRun) -> None:
    run = make_run(experiment="ablation/no_ramp")
    with WandbTracker(run, project="test") as tracker:
        for stage, losses in (("joint", (3.0, 2.0)), ("full", (5.0,))):
            logger = tracker.stage_logger(stage, 0)
            for step, loss in enumerate(losses):
                logger.log_metrics({"train/loss": loss}, step)
            logger.finalize("success")
    records = read(run.folder)
    assert history(records, "joint/train/loss") == [(0, 3.0), (1, 2.0)]
    assert history(records, "full/train/loss") == [(0, 5.0)]
    begun = only(records, "run")
    assert begun["run_id"] == run.id and begun["display_name"] == run.name == "2026-11-25_14-40-40"
    assert begun["job_type"] == "ablation/no_ramp"
    assert set(begun["tags"]) == {"ablation/no_ramp", "quick", "joint", "full"}
    config = begun["config"]["update"]
    assert config["loss"] == {"depth": {"weight": 0.9}}
    assert config["run"]["git"]["revision"] == "c0ffee" and config["run"]["hardware"] == {"cores": 2}
    assert only(records, "exit").get("exit_code", 0) == 0


def test_two_runs_in_one_process_are_two_runs(make_run: MakeRun) -> None:
    runs = [make_run("first"), make_run("second_run")]
    for value, run in enumerate(runs):
        with WandbTracker(run, project="test") as tracker:
            tracker.stage_logger("joint", 0).log_metrics({"train/loss": float(value)}, 0)
    assert [only(read(run.folder), "run")["run_id"] for run in runs] == [run.id for run in runs]
    assert [history(read(run.folder), "joint/train/loss") for run in runs] == [[(0, 0.0)], [(0, 1.0)]]


def test_a_run_that_fails_is_marked(make_run: MakeRun) -> None:
    run = make_run()
    with pytest.raises(RuntimeError), WandbTracker(run, project="test"):
        raise RuntimeError
    assert only(read(run.folder), "exit")["exit_code"] == 1


def test_pictures_checkpoints_and_the_final_table_are_kept(make_run: MakeRun, results: Results, tmp_path: Path) -> None:
    run, checkpoint, picture = make_run(), tmp_path / "best.ckpt", tmp_path / "picture.png"
    checkpoint.write_bytes(b"weights")
    write_png(picture, np.zeros((3, 5, 3), np.uint8))
    with WandbTracker(run, project="test") as tracker:
        tracker.stage_logger("joint", 0).log_image("panels/frame_0", [str(picture)], step=7)
        tracker.log_checkpoints("joint", [checkpoint])
        tracker.log_results(results)
    records = read(run.folder)
    assert history(records, "joint/panels/frame_0.width") == [(7, 5)]
    kept = [record["artifact"] for record in records if record["type"] == "artifact"]
    (model,) = [artifact for artifact in kept if artifact["type"] == "model"]
    assert model["name"] == f"{run.id}-joint"
    assert [Path(entry["local_path"]) for entry in model["manifest"]["contents"]] == [checkpoint]  # no copy
    ((_, path),) = history(records, "final/table.path")
    (files,) = run.folder.glob("wandb/offline-run-*/files")
    table = json.loads((files / path).read_text())
    assert table["columns"] == ["task", "metric", "ours", "nearest"]
    assert table["data"] == [["depth, aligned", "rmse_m", 1.5, 2.5], ["registration", "corner_error_px", 0.75, None]]
    summaries = [record["summary"]["update"] for record in records if record["type"] == "summary"]
    assert any(summary.get("final/depth_aligned/rmse_m") == 1.5 for summary in summaries)


def test_checkpoints_can_be_left_out(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run()
    with WandbTracker(run, project="test", checkpoints=False) as tracker:
        tracker.log_checkpoints("joint", [tmp_path / "not_read.ckpt"])
    assert "artifact" not in {record["type"] for record in read(run.folder)}
