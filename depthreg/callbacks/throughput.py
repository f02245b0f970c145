"""How fast training is, and how much of its time is spent waiting for data."""

import time

import lightning as L

from depthreg.data.sample import Measurement
from depthreg.stage import Stage


class Throughput(L.Callback):
    """Logs `train/frames_per_s` and `train/wait_share` of each epoch.

    Both are of the time in steps and between them; validation, pictures and checkpoints don't count. Waiting is from a
    step's end until the loader has the next batch. On a GPU a step ends when its work is queued: what waiting overlaps
    with that work is counted, too.
    """

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self.waited_s = self.worked_s = 0.0
        self.frames = 0  # of all processes
        self._waiting_since = time.perf_counter()

    @property
    def frames_per_s(self) -> float:
        """Of this epoch so far; 0 before its first step."""
        return self.frames / (self.waited_s + self.worked_s) if self.frames else 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A run that is resumed within an epoch isn't told of its start."""
        self._clear()

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Begin anew."""
        self._clear()

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Measurement, batch_idx: int
    ) -> None:
        """The batch came a while ago: since then its sensors were simulated."""
        assert isinstance(pl_module, Stage)
        self.waited_s += max(pl_module.batch_came_s - self._waiting_since, 0.0)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: object, batch: Measurement, batch_idx: int
    ) -> None:
        """A step is done."""
        assert isinstance(pl_module, Stage)
        self._waiting_since = time.perf_counter()
        self.worked_s += self._waiting_since - pl_module.batch_came_s
        self.frames += len(batch["rgb"]) * trainer.world_size

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Validation within an epoch isn't waiting."""
        self._waiting_since = time.perf_counter()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the epoch's figures; one that was interrupted after its last step has none."""
        if self.frames:
            share = self.waited_s / (self.waited_s + self.worked_s)
            pl_module.log_dict({"train/frames_per_s": self.frames_per_s, "train/wait_share": share})
