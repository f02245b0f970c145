"""Stages on the smallest network, trained by a real Trainer within a second."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from depthreg.callbacks import DifficultyRamp, FreezeSchedule
from depthreg.losses import CornerError, DepthL1, Dissimilarity, JointLoss, MatchCrossEntropy
from depthreg.networks import JointNetwork
from depthreg.sensors import Lidar, SensorSimulator
from depthreg.stage import Stage


@pytest.fixture(scope="session")
def make_stage(make_network: Callable[[], JointNetwork]) -> Callable[..., Stage]:
    """A stage with every term of the loss and every disturbance."""

    def make(name: str = "full", network: JointNetwork | None = None, **options: Any) -> Stage:
        terms = {"ssim": Dissimilarity(0.02), "corner": CornerError(1), "match": MatchCrossEntropy(1)}
        return Stage(
            name=name,
            network=network or make_network(),
            loss=JointLoss(depth=DepthL1(0.9), **terms),
            simulator=SensorSimulator(Lidar(), max_corner_shift_px=50.0),
            learning_rate=1e-3,
            **options,
        )

    return make


@pytest.fixture
def make_trainer(tmp_path: Path) -> Callable[..., L.Trainer]:
    """A Trainer with the callbacks that every run has."""

    def make(epochs: int, *callbacks: L.Callback, freeze: FreezeSchedule | None = None, **options: Any) -> L.Trainer:
        return L.Trainer(
            accelerator="cpu",
            max_epochs=epochs,
            logger=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=0,
            default_root_dir=tmp_path,
            callbacks=[freeze or FreezeSchedule(), DifficultyRamp(), *callbacks],
            **{"enable_checkpointing": False, **options},
        )

    return make


class History(L.Callback):
    """Remembers what the network held, and how it was trained, after each epoch."""

    def __init__(self) -> None:
        self.states: list[dict[str, Tensor]] = []
        self.learning_rates: list[float] = []  # of each step
        self.difficulties: list[float] = []
        self.losses: list[float] = []

    @staticmethod
    def state_of(module: torch.nn.Module) -> dict[str, Tensor]:
        return {key: value.clone() for key, value in module.state_dict().items()}

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.states.append(self.state_of(pl_module.network))

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: object, batch_idx: int
    ) -> None:
        self.learning_rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.states.append(self.state_of(pl_module.network))
        self.difficulties.append(pl_module.difficulty)
        self.losses.append(trainer.callback_metrics["train/loss"].item())

    def changed(self, epoch: int) -> set[str]:
        """Names of the parameters and statistics that an epoch changed."""
        before, after = self.states[epoch : epoch + 2]
        return {key for key in before if not torch.equal(before[key], after[key])}


@pytest.fixture
def train(make_trainer: Callable[..., L.Trainer], make_loader: Callable[..., DataLoader]) -> Callable[..., History]:
    """Fits a stage and tells what happened."""

    def run(stage: Stage, epochs: int, *callbacks: L.Callback, resume: Path | None = None, **options: Any) -> History:
        history = History()
        trainer = make_trainer(epochs, history, *callbacks, **options)
        trainer.fit(stage, make_loader(4), make_loader(2, first=50), ckpt_path=resume, weights_only=True)
        return history

    return run
