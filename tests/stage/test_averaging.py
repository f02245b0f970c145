"""`callbacks=ema`: which weights a run keeps, against the average's definition."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor

from depthreg.callbacks import FreezeSchedule
from depthreg.config import build, compose_config

DECAY = 0.7


@pytest.fixture
def average() -> L.Callback:
    """The callback as it is configured."""
    return build(compose_config("train", ["callbacks=ema", f"callbacks.ema.multi_avg_fn.decay={DECAY}"]).callbacks.ema)


class Steps(L.Callback):
    """Remembers the weights after each step."""

    def __init__(self) -> None:
        self.states: list[dict[str, Tensor]] = []

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: object) -> None:
        self.states.append({key: value.clone() for key, value in pl_module.network.state_dict().items()})


def weights(path: Path) -> dict[str, Tensor]:
    return torch.load(path, weights_only=True)["state_dict"]


def test_the_average_is_kept_and_stays_in_the_network_for_the_next_stage(
    average: L.Callback, make_stage: Callable[..., Any], train: Callable[..., Any], tmp_path: Path
) -> None:
    """The first step's weights begin it; each later step's count 1 - decay."""
    stage, steps = make_stage(), Steps()
    train(stage, 3, average, steps, ModelCheckpoint(tmp_path, filename="last"), enable_checkpointing=True)
    kept, network = weights(tmp_path / "last.ckpt"), stage.network.state_dict()
    for key in (key for key, value in network.items() if value.is_floating_point()):
        values = torch.stack([state[key].double() for state in steps.states])
        shares = (1 - DECAY) * DECAY ** torch.arange(len(values) - 1, -1, -1, dtype=torch.float64)
        shares[0] /= 1 - DECAY
        expected = torch.tensordot(shares, values, dims=1).to(network[key].dtype)
        torch.testing.assert_close(network[key], expected, rtol=1e-5, atol=1e-6)
        assert torch.equal(kept[f"network.{key}"], network[key])
        assert values.std(dim=0).max() > 1e-5 or "offsets_px" in key  # it did learn


def test_what_is_frozen_stays_as_it_was_to_the_bit(
    average: L.Callback, make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage()
    before = {key: value.clone() for key, value in stage.network.state_dict().items()}
    train(stage, 3, average, freeze=FreezeSchedule(["first_rgb", "first_depth", "registration"]))
    after = stage.network.state_dict()
    assert {key.split(".")[0] for key in before if not torch.equal(before[key], after[key])} == {"completion"}


def test_a_resumed_run_has_the_average_of_all_its_steps(
    make_stage: Callable[..., Any], train: Callable[..., Any], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    recipe = compose_config("train", ["callbacks=ema", f"callbacks.ema.multi_avg_fn.decay={DECAY}"]).callbacks.ema
    whole, resumed = make_stage(), make_stage()
    keep_all = ModelCheckpoint(tmp_path, filename="{epoch}", save_top_k=-1)
    train(whole, 4, build(recipe), keep_all, enable_checkpointing=True)
    train(resumed, 4, build(recipe), resume=tmp_path / "epoch=1.ckpt")
    ours, theirs = resumed.network.state_dict(), whole.network.state_dict()
    assert [key for key in theirs if not torch.equal(ours[key], theirs[key])] == []
