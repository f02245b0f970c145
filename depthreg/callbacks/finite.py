"""Ends a run whose loss is no number any more."""

from typing import Any

import lightning as L
import torch

from depthreg.errors import RunError


class FiniteLoss(L.Callback):
    """Checks the training loss every few steps; checking each one would make a GPU wait for every step.

    Args:
        every_steps: Steps between checks.

    Raises:
        ValueError: That isn't positive.
    """

    def __init__(self, every_steps: int = 10) -> None:
        if every_steps < 1:
            raise ValueError(f"every_steps must be at least 1, got {every_steps}")
        self.every_steps = every_steps

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: object, batch_idx: int
    ) -> None:
        """Raise `RunError` where the loss isn't finite."""
        if trainer.global_step % self.every_steps == 0 and not torch.isfinite(outputs["loss"]):
            raise RunError(
                f"the training loss became {outputs['loss'].item()} by step {trainer.global_step}, epoch "
                f"{trainer.current_epoch}: a lower learning_rate or trainer.gradient_clip_val may help"
            )
