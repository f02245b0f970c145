"""What is measured on the way: speed, waiting, gradients, the time that is left."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning as L
import pytest
import torch
from torch.optim import Optimizer
from torch.utils.data import DataLoader

from depthreg.callbacks import StageProgress, Throughput
from depthreg.callbacks.progress import seconds_left
from depthreg.losses import DepthL1, JointLoss
from depthreg.sensors import Clean, SensorSimulator
from depthreg.stage import Stage


class Clock:
    """Stands still unless it is told how long something takes."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class SlowStage(Stage):
    """Simulates for 1 s, trains for 4 s and validates for 50 s."""

    clock: Clock

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        self.clock.now_s += 1
        return super().on_after_batch_transfer(batch, dataloader_idx)

    def training_step(self, batch: Any, batch_idx: int) -> torch.Tensor:
        self.clock.now_s += 4
        return super().training_step(batch, batch_idx)

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        self.clock.now_s += 50
        super().validation_step(batch, batch_idx)


class SlowLoader:
    """Takes 3 s for a batch."""

    def __init__(self, loader: DataLoader, clock: Clock) -> None:
        self.loader, self.clock = loader, clock

    def __len__(self) -> int:
        return len(self.loader)

    def __iter__(self) -> Any:
        for batch in self.loader:
            self.clock.now_s += 3
            yield batch


class Recorder(L.Callback):
    """Keeps what was logged, epoch by epoch."""

    def __init__(self) -> None:
        self.epochs: list[dict[str, float]] = []

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.epochs.append({name: float(value) for name, value in trainer.callback_metrics.items()})


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of all that measures."""
    clock = Clock()
    stub = SimpleNamespace(perf_counter=clock, monotonic=clock)
    for module in ("depthreg.stage", "depthreg.callbacks.throughput", "depthreg.callbacks.progress"):
        monkeypatch.setattr(f"{module}.time", stub)
    return clock


@pytest.fixture
def fit(
    clock: Clock, tmp_path: Path, make_network: Callable[..., Any], make_loader: Callable[..., DataLoader]
) -> Callable[..., Recorder]:
    """Trains on three batches of two frames an epoch."""

    def run(*callbacks: L.Callback, epochs: int = 2, **options: Any) -> Recorder:
        stage = SlowStage("full", make_network(), JointLoss(depth=DepthL1(1)), SensorSimulator(Clean()), 1e-3)
        stage.clock, recorder = clock, Recorder()
        bar = any(isinstance(callback, StageProgress) for callback in callbacks)
        options = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": bar, **options}
        trainer = L.Trainer(
            accelerator="cpu",
            max_epochs=epochs,
            default_root_dir=tmp_path,
            callbacks=[*callbacks, recorder],
            enable_model_summary=False,
            num_sanity_val_steps=0,
            **options,
        )
        trainer.fit(stage, SlowLoader(make_loader(6), clock), make_loader(2))
        return recorder

    return run


@pytest.mark.parametrize("options", [{}, {"val_check_interval": 1}])
def test_waiting_is_for_the_loader_and_frames_are_those_of_training(
    options: dict[str, int], fit: Callable[..., Recorder]
) -> None:
    for epoch in fit(Throughput(), **options).epochs:
        assert epoch["train/wait_share"] == pytest.approx(3 / 8)
        assert epoch["train/frames_per_s"] == pytest.approx(2 / 8)


def test_the_gradient_norm_is_that_before_clipping(fit: Callable[..., Recorder]) -> None:
    class Judge(L.Callback):
        norms: list[float] = []  # noqa: RUF012

        def on_before_optimizer_step(self, trainer: L.Trainer, pl_module: L.LightningModule, _: Optimizer) -> None:
            self.norms.append(torch.nn.utils.clip_grad_norm_(pl_module.parameters(), 1e9).item())

    (epoch,) = fit(Judge(), epochs=1, gradient_clip_val=1e-3).epochs
    assert len(Judge.norms) == 3 and min(Judge.norms) > 1e-3
    assert epoch["train/grad_norm"] == pytest.approx(sum(Judge.norms) / 3, rel=1e-5)


def test_the_bar_shows_speed_and_what_the_stage_still_takes(fit: Callable[..., Recorder], clock: Clock) -> None:
    shown: list[dict[str, str]] = []

    class Bar(StageProgress):
        def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
            shown.append(super().get_metrics(trainer, pl_module))
            return shown[-1]

    throughput = Throughput()
    fit(throughput, Bar(throughput))
    assert shown[0] == {"frames/s": "0.2", "left": "0:00:40"}  # five more steps of 8 s
    assert shown[-1] == {"frames/s": "0.2", "left": "0:00:00"}
    first_of_second_epoch = shown[len(shown) // 2]  # two more, of (4 * 8 + 51) / 4 s
    assert first_of_second_epoch["left"] == "0:00:42"


def test_time_left_is_in_proportion_to_the_steps_left() -> None:
    assert seconds_left(done=10, to_do=30, spent_s=5.0) == 15.0
    assert seconds_left(done=10, to_do=0, spent_s=5.0) == 0.0
    assert seconds_left(done=0, to_do=30, spent_s=5.0) is None
