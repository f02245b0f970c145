"""Program of `test_data_parallel.py`: trains stages in this process and those that torchrun started beside it.

python train_together.py FOLDER NAME:BATCH_SIZE[:OVERRIDE...] ...

FOLDER/NAME_RANK.pt then says what this process saw and held. `plain` trains the network as it is. In other plans a
normalisation that doesn't mix the frames of a batch takes BatchNorm's place, and everything is in double precision:
where a gradient is zero but for rounding, Adam makes whole steps of it.
"""

import sys
from pathlib import Path

import lightning as L
import torch
from torch import Tensor, nn

from depthreg.config import build, compose_config
from depthreg.curriculum import build_stage
from depthreg.devices import strategy
from depthreg.walk import walk

CONFIGURATION = [
    *("data.width=80", "data.height=64", "data.train_count=9", "data.val_count=5", "data.workers=0"),
    *("data.cache_dir=null", "model.completion_widths=[16]", "curriculum=[joint]", "epochs.joint=3"),
    *("trainer.accelerator=cpu", "loss.depth.weight=1"),
]


def without_batch_norm(network: nn.Module) -> nn.Module:
    """The network, in double precision, with every BatchNorm replaced by one that looks at a single frame."""
    for module in list(network.modules()):
        for name, child in module.named_children():
            if isinstance(child, nn.BatchNorm2d):
                setattr(module, name, nn.GroupNorm(1, child.num_features))
    return network.double()


SEEN = ("frames", "states", "gradients", "metrics")


class Witness(L.Callback):
    """Remembers frames, weights and statistics after each step, and metrics after each epoch."""

    def __init__(self) -> None:
        self.frames: list[list[int]] = []
        self.states: list[dict[str, Tensor]] = []
        self.gradients: list[set[str]] = []
        self.metrics: list[dict[str, float]] = []

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        measure, dtype = pl_module.on_after_batch_transfer, next(pl_module.parameters()).dtype

        def measure_and_remember(batch: dict[str, Tensor], dataloader_idx: int) -> dict[str, Tensor]:
            self.frames.append(batch["index"].tolist())
            return {key: value.to(dtype) for key, value in measure(batch, dataloader_idx).items()}

        pl_module.on_after_batch_transfer = measure_and_remember

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        learning = {name for name, value in pl_module.network.named_parameters() if value.grad is not None}
        self.gradients.append(learning)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: object) -> None:
        self.states.append({key: value.detach().clone() for key, value in pl_module.network.state_dict().items()})

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        state = {key: value.detach().clone() for key, value in pl_module.network.state_dict().items()}
        assert all(torch.equal(value, self.states[-1][key]) for key, value in state.items())  # validation only looks

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.metrics.append({key: value.item() for key, value in trainer.callback_metrics.items()})


def main(folder: Path, *plans: str) -> None:
    """Train each plan after the other."""
    for plan in plans:
        name, batch_size, *overrides = plan.split(":")
        config = compose_config("train", [*CONFIGURATION, f"data.batch_size={batch_size}", *overrides])
        torch.manual_seed(0)
        network = build(config.model)
        if name != "plain":
            network = without_batch_norm(network)
        parts = build_stage(config, walk(config)[0], network)
        witness = Witness()
        trainer = L.Trainer(
            **{**config.trainer, "strategy": strategy(config.trainer)},
            max_epochs=3,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            default_root_dir=folder,
            callbacks=[*parts.callbacks, witness],
        )
        trainer.fit(parts.module, parts.data)
        torch.save({key: getattr(witness, key) for key in SEEN}, folder / f"{name}_{trainer.global_rank}.pt")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]), *sys.argv[2:])
