"""Moves on to the next stage when validation has stopped improving."""

import lightning as L
from lightning.pytorch.callbacks import EarlyStopping


class Patience(EarlyStopping):
    """Ends a stage whose validation loss has not improved for so many epochs.

    Validation is at one difficulty throughout, so that a ramp doesn't look like a loss that gets worse.

    Args:
        epochs: Without improvement.

    Raises:
        ValueError: It isn't positive.
    """

    def __init__(self, epochs: int) -> None:
        if epochs < 1:
            raise ValueError(f"patience must be at least 1, got {epochs}")
        super().__init__(monitor="val/loss", patience=epochs, check_on_train_epoch_end=False, check_finite=False)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A run that was killed after its patience had ended doesn't train on when it is resumed."""
        if self.wait_count >= self.patience:
            trainer.should_stop = True
