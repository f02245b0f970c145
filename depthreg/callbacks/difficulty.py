"""How hard training is, from the epoch alone."""

import math
from collections.abc import Sequence

import lightning as L

from depthreg.stage import Stage

SHAPES = ("linear", "cosine", "steps")


class DifficultyRamp(L.Callback):
    """Raises the difficulty from `start` to `end`, then holds it.

    Args:
        start: Difficulty of the first epoch, in [0, 1].
        end: Difficulty reached, in [0, 1].
        ramp_share: Share of the stage's epochs after which `end` is reached.
        shape: `linear`; `cosine`, which starts and ends gently; `steps`, equal ones, with `start` and `end` among them.
        steps: How many levels `steps` has.
        values: Difficulty of each epoch instead of all that; the last one holds.

    Raises:
        ValueError: A value is out of range.
    """

    def __init__(
        self,
        start: float = 0.1,
        end: float = 1.0,
        ramp_share: float = 0.7,
        shape: str = "linear",
        steps: int = 4,
        values: Sequence[float] | None = None,
    ) -> None:
        if not (0 <= start <= 1 and 0 <= end <= 1 and 0 < ramp_share <= 1):
            raise ValueError(f"start and end must be in [0, 1], ramp_share in (0, 1]; got {start}, {end}, {ramp_share}")
        if shape not in SHAPES or steps < 2:
            raise ValueError(f"shape must be one of {', '.join(SHAPES)}, steps at least 2; got {shape}, {steps}")
        if values is not None and not (values and all(0 <= value <= 1 for value in values)):
            raise ValueError(f"values must be numbers in [0, 1], at least one, got {list(values)}")
        self.start, self.end, self.ramp_share = start, end, ramp_share
        self.shape, self.steps, self.values = shape, steps, values

    def difficulty(self, epoch: int, epochs: int) -> float:
        """Difficulty of an epoch (from 0) of a stage of so many epochs."""
        if self.values is not None:
            return self.values[min(epoch, len(self.values) - 1)]
        last = max(self.ramp_share * epochs - 1, 1)
        done = min(epoch / last, 1)
        if self.shape == "cosine":
            done = (1 - math.cos(math.pi * done)) / 2
        elif self.shape == "steps":
            done = min(math.floor(done * self.steps), self.steps - 1) / (self.steps - 1)
        return self.start + (self.end - self.start) * done

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A run that is resumed within an epoch isn't told of its start."""
        self.on_train_epoch_start(trainer, pl_module)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Set the stage's difficulty for this epoch."""
        assert isinstance(pl_module, Stage)
        pl_module.difficulty = self.difficulty(trainer.current_epoch, trainer.max_epochs or 1)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log it."""
        assert isinstance(pl_module, Stage)
        pl_module.log("train/difficulty", pl_module.difficulty)
