"""The progress bar of a stage."""

import time
from datetime import timedelta
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.callbacks.progress.rich_progress import CustomTimeColumn, ProcessingSpeedColumn

from depthreg.callbacks.throughput import Throughput


class StageProgress(RichProgressBar):
    """Lightning's bar of an epoch, with frames a second and the time that the stage still takes at this speed.

    Args:
        throughput: A callback of the same Trainer.
    """

    def __init__(self, throughput: Throughput) -> None:
        super().__init__()
        self.throughput = throughput
        self._start = (0, 0.0)  # step and time
        self._steps = 0.0  # of the stage

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Remember where this process began: the steps before a resume took none of its time."""
        super().on_train_start(trainer, pl_module)
        self._start, self._steps = (trainer.global_step, time.monotonic()), trainer.estimated_stepping_batches

    def configure_columns(self, trainer: L.Trainer) -> list:
        """Lightning's, without its steps a second and the time of this epoch."""
        columns = super().configure_columns(trainer)
        return [column for column in columns if not isinstance(column, CustomTimeColumn | ProcessingSpeedColumn)]

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        """What stands beside the bar."""
        first_step, start_s = self._start
        done, to_do = trainer.global_step - first_step, self._steps - trainer.global_step
        left_s = seconds_left(done, to_do, time.monotonic() - start_s)
        left = "?" if left_s is None else str(timedelta(seconds=round(left_s)))
        return {"frames/s": f"{self.throughput.frames_per_s:.1f}", "left": left}


def seconds_left(done: int, to_do: float, spent_s: float) -> float | None:
    """Time that steps take at the mean speed of those that are done, validation included; None before the first."""
    return spent_s / done * to_do if done else None
