"""When a stage gives way to the next."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader

from depthreg.callbacks import Patience


class Replay(L.LightningModule):
    """Validates to the losses that it is given, one an epoch."""

    def __init__(self, losses: list[float]) -> None:
        super().__init__()
        self.layer, self.losses = torch.nn.Linear(1, 1), losses

    def training_step(self, batch: torch.Tensor) -> torch.Tensor:
        return self.layer(batch).mean()

    def validation_step(self, batch: torch.Tensor) -> None:
        self.log("val/loss", self.losses[self.current_epoch])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.fixture
def fit(tmp_path: Path) -> Callable[..., int]:
    """Trains, and tells how many epochs it took."""

    def run(losses: list[float], patience: int, resume: Path | None = None) -> int:
        data = DataLoader(torch.ones(2, 1))
        options: dict[str, Any] = {"accelerator": "cpu", "logger": False, "num_sanity_val_steps": 0}
        quiet = {"enable_progress_bar": False, "enable_model_summary": False}
        keep = ModelCheckpoint(tmp_path, filename="last", enable_version_counter=False)
        trainer = L.Trainer(**options, **quiet, max_epochs=len(losses), callbacks=[Patience(patience), keep])
        trainer.fit(Replay(losses), data, data, ckpt_path=resume, weights_only=True)
        return trainer.current_epoch

    return run


@pytest.mark.parametrize(("patience", "epochs"), [(1, 3), (2, 6), (3, 8)])
def test_a_stage_ends_after_so_many_epochs_without_a_better_loss(
    patience: int, epochs: int, fit: Callable[..., int]
) -> None:
    assert fit([5, 4, 4.5, 3, 3, 3, 2, 2], patience) == epochs


def test_a_stage_that_gets_better_takes_all_its_epochs(fit: Callable[..., int]) -> None:
    assert fit([5, 4, 3, 2], 1) == 4


def test_a_run_that_was_killed_after_its_patience_had_ended_does_not_train_on(
    fit: Callable[..., int], tmp_path: Path
) -> None:
    losses = [5, 4, 4.5, 3, 2]
    assert fit(losses, 1) == 3
    assert fit(losses, 1, resume=tmp_path / "last.ckpt") == 3


def test_no_patience_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Patience(0)
