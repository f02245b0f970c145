"""Freezes parts of the network in some epochs."""

import difflib
from collections.abc import Sequence

import lightning as L
from torch import nn

from depthreg.stage import Stage


class FreezeSchedule(L.Callback):
    """Freezes the named modules in every `period`-th epoch, counted from 1; a period of 1 is every epoch.

    A frozen module stops learning and normalises by its stored statistics. Nothing is remembered, so a resumed run
    freezes what the uninterrupted one would have. On several devices it needs `depthreg.devices.DataParallel`, or
    Lightning's `ddp_find_unused_parameters_true`: what learns changes after DDP has looked at it.

    Args:
        modules: Names within the network, such as `completion` or `completion.head`.
        period: In epochs; the paper's first stage rests completion in every second one.

    Raises:
        ValueError: The period isn't positive.
    """

    def __init__(self, modules: Sequence[str] = (), period: int = 1) -> None:
        if period < 1:
            raise ValueError(f"freeze.period must be at least 1, got {period}")
        self.modules, self.period = tuple(modules), period

    def frozen(self, epoch: int) -> tuple[str, ...]:
        """Names of what doesn't learn in an epoch, counted from 0."""
        return self.modules if epoch % self.period == self.period - 1 else ()

    def check(self, network: nn.Module) -> None:
        """Refuse what the network doesn't have.

        Raises:
            ValueError: It has no module of a name.
        """
        known = [name for name, _ in network.named_modules() if name]
        for name in self.modules:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                choices = near or [name for name, _ in network.named_children()]
                raise ValueError(f"freeze.modules has '{name}': expected {', '.join(choices)} or another module's name")

    def apply(self, network: nn.Module, epoch: int) -> None:
        """Thaw everything, then freeze an epoch's modules."""
        network.requires_grad_(True).train()
        for name in self.frozen(epoch):
            network.get_submodule(name).requires_grad_(False).eval()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """A run that is resumed within an epoch isn't told of its start."""
        assert isinstance(pl_module, Stage)
        self.apply(pl_module.network, trainer.current_epoch)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Freeze what this epoch wants."""
        assert isinstance(pl_module, Stage)
        self.apply(pl_module.network, trainer.current_epoch)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log for each part of the network whether it was frozen."""
        assert isinstance(pl_module, Stage)
        for name, part in pl_module.network.named_children():
            learns = [parameter.requires_grad for parameter in part.parameters()]
            pl_module.log(f"frozen/{name}", float(bool(learns) and not any(learns)))
