"""How hard training is, from the epoch alone."""

import lightning as L

from depthreg.stages import Stage


class DifficultyRamp(L.Callback):
    """Raises the difficulty linearly from `start` to `end`, then holds it.

    Args:
        start: Difficulty of the first epoch, in [0, 1].
        end: Difficulty reached, in [0, 1].
        ramp_share: Share of the stage's epochs after which `end` is reached.
    """

    def __init__(self, start: float = 0.1, end: float = 1.0, ramp_share: float = 0.7) -> None:
        if not (0 <= start <= 1 and 0 <= end <= 1 and 0 < ramp_share <= 1):
            raise ValueError(f"start and end must be in [0, 1], ramp_share in (0, 1]; got {start}, {end}, {ramp_share}")
        self.start, self.end, self.ramp_share = start, end, ramp_share

    def difficulty(self, epoch: int, epochs: int) -> float:
        """Difficulty of an epoch (from 0) of a stage of so many epochs."""
        last = max(self.ramp_share * epochs - 1, 1)
        return self.start + (self.end - self.start) * min(epoch / last, 1)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Set the stage's difficulty for this epoch."""
        assert isinstance(pl_module, Stage)
        pl_module.difficulty = self.difficulty(trainer.current_epoch, trainer.max_epochs or 1)
