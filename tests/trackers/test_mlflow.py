"""Runs of MLflow, as MLflow's own client reads them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from depthreg.data.io import write_png
from depthreg.errors import InputError
from depthreg.report import Results, write_report
from depthreg.trackers import Run

pytest.importorskip("mlflow")
from mlflow import MlflowClient
from mlflow.entities import Run as MLflowRun

from depthreg.trackers.mlflow import MLflowTracker

MakeRun = Callable[..., Run]


@pytest.fixture
def uri(tmp_path: Path) -> str:
    """A database that isn't there yet."""
    return f"sqlite:///{tmp_path / 'new' / 'mlflow.db'}"


def read(uri: str) -> list[MLflowRun]:
    """All runs, the oldest first."""
    client = MlflowClient(uri)
    experiment = client.get_experiment_by_name("test")
    assert experiment is not None
    return client.search_runs([experiment.experiment_id], order_by=["attributes.start_time ASC"])


def history(uri: str, run: MLflowRun, key: str) -> list[tuple[int, float]]:
    return [(point.step, point.value) for point in MlflowClient(uri).get_metric_history(run.info.run_id, key)]


def files(uri: str, run: MLflowRun, folder: str) -> set[str]:
    return {artifact.path for artifact in MlflowClient(uri).list_artifacts(run.info.run_id, folder)}


def test_a_run_is_one_run_with_curves_by_stage_pictures_checkpoints_and_results(
    uri: str, make_run: MakeRun, results: Results, tmp_path: Path
) -> None:
    run, checkpoint, picture = make_run(experiment="ablation/no_rgb"), tmp_path / "best.ckpt", tmp_path / "picture.png"
    (run.folder / "run.yaml").touch()
    checkpoint.write_bytes(b"weights")
    write_png(picture, np.zeros((3, 5, 3), np.uint8))
    write_report(results, run.folder)
    with MLflowTracker(run, "test", uri) as tracker:
        for stage in run.stages:
            logger = tracker.stage_logger(stage, 0)
            logger.log_metrics({"train/loss": 3.0}, 0)
            logger.log_metrics({"train/loss": 2.0}, 1)
            logger.log_image("panels/frame_0", [str(picture)], step=1)
            logger.finalize("success")
        tracker.log_checkpoints("joint", [checkpoint])
        assert read(uri)[0].info.status == "RUNNING"
        tracker.log_results(results)
    (found,) = read(uri)
    assert found.info.status == "FINISHED" and found.info.run_name == run.name
    assert found.data.tags.items() >= {"job_type": "ablation/no_rgb", "quick": "true", "full": "true"}.items()
    assert found.data.params["loss/depth/weight"] == "0.9" and found.data.params["run/git/revision"] == "c0ffee"
    assert history(uri, found, "joint/train/loss") == history(uri, found, "full/train/loss") == [(0, 3.0), (1, 2.0)]
    assert found.data.metrics["final/depth_aligned/rmse_m"] == 1.5
    assert files(uri, found, "checkpoints/joint") == {"checkpoints/joint/best.ckpt"}
    assert files(uri, found, "final") == {"final/metrics.csv", "final/metrics.md"}
    assert {"run.yaml", "images"} <= files(uri, found, "")
    assert len([name for name in files(uri, found, "images") if name.endswith(".png")]) == 2


def test_a_resumed_run_goes_on_and_another_one_does_not(uri: str, make_run: MakeRun) -> None:
    first, second = make_run("first"), make_run("second_run")
    for run in (first, second):
        (run.folder / "run.yaml").touch()
    with pytest.raises(KeyboardInterrupt), MLflowTracker(first, "test", uri) as tracker:
        tracker.stage_logger("joint", 0).log_metrics({"train/loss": 3.0}, 0)
        raise KeyboardInterrupt
    assert [run.info.status for run in read(uri)] == ["FAILED"]
    with MLflowTracker(second, "test", uri), MLflowTracker(first, "test", uri) as tracker:
        tracker.stage_logger("joint", 1).log_metrics({"train/loss": 2.0}, 1)
    ours, other = read(uri)
    assert history(uri, ours, "joint/train/loss") == [(0, 3.0), (1, 2.0)]
    assert history(uri, other, "joint/train/loss") == []
    assert ours.info.status == other.info.status == "FINISHED"


def test_a_place_that_is_none_is_refused(make_run: MakeRun, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"logger\.mlflow\.tracking_uri=sqlite:"):
        MLflowTracker(make_run(), "test", f"sqlite:///{tmp_path / 'file' / 'mlflow.db'}")
