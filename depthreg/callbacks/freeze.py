"""Freezes what a stage says is frozen in an epoch."""

import lightning as L

from depthreg.stages import Stage


class FreezeSchedule(L.Callback):
    """Applies `Stage.frozen_modules` at the start of each epoch.

    A frozen module stops learning and normalises by its stored statistics. Nothing is remembered, so a resumed run
    freezes what the uninterrupted one would have. Under DDP the set of learning parameters changes after the wrap:
    use `trainer.strategy=ddp_find_unused_parameters_true`.
    """

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Thaw everything, then freeze this epoch's modules."""
        assert isinstance(pl_module, Stage)
        pl_module.network.requires_grad_(True).train()
        for module in pl_module.frozen_modules(trainer.current_epoch):
            module.requires_grad_(False).eval()
