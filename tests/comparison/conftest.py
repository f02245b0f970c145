"""Small folders as `depthreg train` leaves them, with figures that are worked out by hand."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from depthreg.data import io
from depthreg.report import write_report

MakeRun = Callable[..., Path]


def write_stage(folder: Path, losses: Sequence[float], frozen: Sequence[int], steps_an_epoch: int) -> None:
    """Lightning's `metrics.csv`: validation and training of an epoch are lines of their own."""
    folder.mkdir(parents=True)
    columns = ["epoch", "step", "val/loss", "train/loss", "train/difficulty", "frozen/completion"]
    with (folder / "metrics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for epoch, loss in enumerate(losses):
            step = (epoch + 1) * steps_an_epoch - 1
            writer.writerow({"epoch": epoch, "step": step, "val/loss": loss})
            ramp = {"train/difficulty": min(1, 0.5 + epoch / 4), "frozen/completion": float(epoch in frozen)}
            writer.writerow({"epoch": epoch, "step": step, "train/loss": loss / 2} | ramp)


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Writes a run's folder below `tmp_path` and gives it."""

    def make(
        name: str,
        *,
        seed: int = 1,
        overrides: Sequence[str] = (),
        config: Mapping[str, Any] | None = None,
        rmse_m: float | None = 1.0,
        stages: Sequence[str] = ("joint",),
        losses: Sequence[float] = (4.0, 2.0, 1.0),
        frozen: Sequence[int] = (1,),
        revision: str = "0123456789abcdef",
        frames_differ: bool = False,
        color: tuple[int, int, int] = (200, 0, 0),
    ) -> Path:
        folder = tmp_path / name
        trainer = {"devices": 1, "num_nodes": 1, "accumulate_grad_batches": 1}
        base = {"curriculum": ["joint"], "stages": {"joint": {}}, "data": {"batch_size": 4}, "trainer": trainer}
        record = {
            "id": "0",
            "started": "2026-01-02T03:04:05+00:00",
            "overrides": [*overrides, f"seed={seed}"],
            "git": {"revision": revision, "dirty": False},
            "config": {**base, "loss": {"weight": 0.5}, **(config or {}), "seed": seed},
        }
        for stage in stages:
            write_stage(folder / stage, losses, frozen, steps_an_epoch=10)
            (folder / stage / "panels").mkdir()
            for epoch in (0, len(losses) - 1):
                picture = np.full((6, 9, 3), color, np.uint8)
                io.write_png(folder / stage / "panels" / f"epoch_{epoch:03d}_frame_0.png", picture)
        folder.mkdir(exist_ok=True)
        (folder / "run.yaml").write_text(yaml.safe_dump(record))
        if rmse_m is not None:
            depth = {"ours": {"rmse_m": rmse_m}, "nearest": {"rmse_m": 9.0 if frames_differ else 8.0}}
            write_report({"depth, misaligned": depth}, folder)
        return folder

    return make
