"""Event files, as TensorBoard's own reader tells them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from depthreg.data.io import write_png
from depthreg.report import Results
from depthreg.trackers import Run

event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")

from depthreg.trackers.tensorboard import TensorBoardTracker  # noqa: E402

MakeRun = Callable[..., Run]


def read(folder: Path) -> "event_accumulator.EventAccumulator":
    return event_accumulator.EventAccumulator(str(folder)).Reload()


def scalars(folder: Path, tag: str) -> list[tuple[int, float]]:
    return [(event.step, event.value) for event in read(folder).Scalars(tag)]


def test_a_run_is_a_folder_with_curves_by_stage_pictures_and_results(
    make_run: MakeRun, results: Results, tmp_path: Path
) -> None:
    run, picture = make_run(), tmp_path / "picture.png"
    colors = np.arange(45, dtype=np.uint8).reshape(3, 5, 3)
    write_png(picture, colors)
    with TensorBoardTracker(run) as tracker:
        for stage in run.stages:
            logger = tracker.stage_logger(stage, 0)
            logger.log_metrics({"train/loss": 3.0}, 0)
            logger.log_metrics({"train/loss": 2.0}, 1)
            logger.log_image("panels/frame_0", [str(picture)], step=1)
            logger.finalize("success")
        tracker.log_checkpoints("joint", [picture])
        tracker.log_results(results)
    folder = run.folder / "tensorboard"
    assert scalars(folder / "joint", "train/loss") == scalars(folder / "full", "train/loss") == [(0, 3.0), (1, 2.0)]
    (shown,) = read(folder / "joint").Images("panels/frame_0")
    assert (shown.step, shown.width, shown.height) == (1, 5, 3)
    assert scalars(folder, "final/depth_aligned/rmse_m") == [(0, 1.5)]
    text = {tag: read(folder).Tensors(f"{tag}/text_summary")[0].tensor_proto.string_val[0] for tag in ("run", "final")}
    assert b"c0ffee" in text["run"] and b"depth, aligned" in text["final"]


def test_a_resumed_stage_takes_back_what_came_after_its_checkpoint(make_run: MakeRun) -> None:
    run = make_run()
    for first_step, losses in ((0, (5.0, 4.0, 3.0, 2.0)), (2, (3.5, 2.5))):
        with TensorBoardTracker(run) as tracker:
            logger = tracker.stage_logger("joint", first_step)
            for step, loss in enumerate(losses, first_step):
                logger.log_metrics({"train/loss": loss}, step)
            logger.finalize("success")
    expected = [(0, 5.0), (1, 4.0), (2, 3.5), (3, 2.5)]
    assert scalars(run.folder / "tensorboard" / "joint", "train/loss") == expected
