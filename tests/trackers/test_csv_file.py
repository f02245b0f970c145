"""Curves as CSV, beside what Lightning's own logger writes."""

import csv
from pathlib import Path

import pytest
from lightning.pytorch.loggers import CSVLogger, Logger

from depthreg.trackers import ResumableCSVLogger

STEPS: list[tuple[int, dict[str, float]]] = [
    (0, {"lr-Adam": 0.1}),
    (9, {"val/loss": 0.1 + 0.2, "epoch": 0}),
    (9, {"train/loss": 1e-30, "epoch": 0}),
    (10, {"lr-Adam": 0.05}),
    (19, {"val/loss": 7.0, "epoch": 1}),
    (19, {"train/loss": float("nan"), "epoch": 1}),
]


def log(logger: Logger, steps: list[tuple[int, dict[str, float]]] = STEPS) -> None:
    for step, metrics in steps:
        logger.log_metrics(metrics, step)
        logger.save()


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_file_is_what_lightning_writes(tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    log(ResumableCSVLogger(ours))
    log(CSVLogger(theirs, name="", version=""))
    assert rows(ours) == rows(theirs)
    assert (ours / "metrics.csv").read_text() == (theirs / "metrics.csv").read_text().replace("\r\n", "\n")


@pytest.mark.parametrize("done", [0, 10, 20])
def test_a_resumed_log_is_that_of_an_uninterrupted_run(done: int, tmp_path: Path) -> None:
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    whole.mkdir()
    resumed.mkdir()
    log(ResumableCSVLogger(whole))
    log(ResumableCSVLogger(resumed), STEPS[:5])
    log(ResumableCSVLogger(resumed, first_step=done), [row for row in STEPS if row[0] >= done])
    expected = rows(whole)[:5] if done == 20 else rows(whole)
    assert rows(resumed) == expected


def test_half_a_row_of_a_killed_process_is_left_out(tmp_path: Path) -> None:
    log(ResumableCSVLogger(tmp_path), STEPS[:3])
    whole = rows(tmp_path)
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("0,,9,0.1234")  # as many columns as a whole one
    log(ResumableCSVLogger(tmp_path, first_step=10), STEPS[3:4])
    assert rows(tmp_path)[:3] == whole and len(rows(tmp_path)) == 4


def test_a_log_is_whole_at_any_moment_of_a_new_column(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logger = ResumableCSVLogger(tmp_path)
    log(logger, STEPS[:2])
    before = (tmp_path / "metrics.csv").read_bytes()
    monkeypatch.setattr(Path, "replace", lambda *_: pytest.fail("killed"))
    with pytest.raises(pytest.fail.Exception):
        log(logger, STEPS[2:3])
    assert (tmp_path / "metrics.csv").read_bytes() == before


def test_a_log_to_which_nothing_is_added_stays(tmp_path: Path) -> None:
    log(ResumableCSVLogger(tmp_path), STEPS[:3])
    ResumableCSVLogger(tmp_path, first_step=10).save()
    assert len(rows(tmp_path)) == 3
