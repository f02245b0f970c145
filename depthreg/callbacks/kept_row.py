"""Carries an epoch's metrics in its checkpoint, for a log that lacks them."""

from typing import Any

import lightning as L

from depthreg.trackers import ResumableCSVLogger

_KEY = "depthreg_row"
_OF_OTHER_ROWS = ("val/", "lr-")


class KeptRow(L.Callback):
    """Adds the row of the epoch that a run is resumed after, where `metrics.csv` lacks it.

    Lightning logs what was measured in training after it has saved the epoch's checkpoint, so a process that is killed
    in between never logs it.
    """

    def __init__(self) -> None:
        self.row: dict[str, float] = {}

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        """Keep what is about to be logged."""
        logged = {name: float(value) for name, value in trainer.logged_metrics.items()}
        row = {name: value for name, value in logged.items() if not name.startswith(_OF_OTHER_ROWS)}
        checkpoint[_KEY] = {**row, "epoch": trainer.current_epoch} if trainer.is_last_batch else {}

    def on_load_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        """Remember it."""
        self.row = checkpoint[_KEY]

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log it, if it isn't there."""
        for logger in trainer.loggers:
            if isinstance(logger, ResumableCSVLogger) and self.row:
                logger.add_missing(self.row, trainer.global_step - 1)
