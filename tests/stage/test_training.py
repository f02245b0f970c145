"""Learning rates, draws, metrics and resuming."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from depthreg.callbacks import FreezeSchedule
from depthreg.geometry import identity_affine


def test_the_learning_rate_rises_to_its_own_and_is_lowered_at_each_milestone(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    history = train(make_stage(warmup_steps=2, lr_milestones=(0.4, 0.8), lr_divisor=4.0), 5)
    shares = [1 / 2, 1, 1, 1, 1 / 4, 1 / 4, 1 / 4, 1 / 4, 1 / 16, 1 / 16]  # two steps an epoch
    assert history.learning_rates == pytest.approx([1e-3 * share for share in shares])


def test_without_warm_up_and_milestones_the_learning_rate_stays(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    assert train(make_stage(warmup_steps=0), 2).learning_rates == [1e-3] * 4


def test_the_optimizer_is_adam_over_the_whole_network(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage(weight_decay=0.02)
    train(stage, 1)
    optimizer = stage.optimizers().optimizer
    assert type(optimizer) is torch.optim.Adam
    (group,) = optimizer.param_groups  # one group for good: none is added when something thaws
    assert group["weight_decay"] == 0.02
    assert {id(p) for p in group["params"]} == {id(p) for p in stage.network.parameters()}


def test_training_lowers_the_loss(make_stage: Callable[..., Any], train: Callable[..., Any]) -> None:
    losses = train(make_stage(warmup_steps=0), 12).losses
    assert sum(losses[-3:]) < 0.8 * sum(losses[:3])


@pytest.mark.parametrize("freeze", [{}, {"modules": ["completion"], "period": 2}, {"modules": ["registration"]}])
def test_resume_continues_as_if_it_had_never_stopped(
    freeze: dict[str, Any], make_stage: Callable[..., Any], train: Callable[..., Any], tmp_path: Path
) -> None:
    options, schedule = {"lr_milestones": (0.25, 0.75), "warmup_steps": 6}, FreezeSchedule(**freeze)
    keep_all = ModelCheckpoint(tmp_path, filename="{epoch}", save_top_k=-1)
    uninterrupted = train(make_stage(**options), 4, keep_all, freeze=schedule, enable_checkpointing=True)
    resumed = train(make_stage(**options), 4, freeze=schedule, resume=tmp_path / "epoch=1.ckpt")
    assert resumed.difficulties == uninterrupted.difficulties[2:]
    assert resumed.learning_rates == uninterrupted.learning_rates[4:]
    assert [resumed.changed(i) for i in (0, 1)] == [uninterrupted.changed(i) for i in (2, 3)]
    for key, value in uninterrupted.states[-1].items():
        assert torch.equal(resumed.states[-1][key], value), key


def test_draws_differ_between_steps_and_stages_but_not_between_runs(
    make_stage: Callable[..., Any], make_loader: Callable[..., Any], make_trainer: Callable[..., Any]
) -> None:
    def draws(name: str) -> list[torch.Tensor]:
        stage, seen = make_stage(name), []

        def step(batch: dict[str, torch.Tensor], batch_idx: int) -> torch.Tensor:
            seen.append(batch["truth_affine_rgb_from_depth"])
            return stage.network(batch["rgb"], batch["depth_m"]).depth_m.mean()

        stage.training_step = step
        make_trainer(2).fit(stage, make_loader(4))
        return seen

    first, again, other = draws("joint"), draws("joint"), draws("full")
    assert len(first) == 4 and all(torch.equal(ours, theirs) for ours, theirs in zip(first, again, strict=True))
    directions = [(draw - identity_affine(2)).flatten() for draw in (*first, *other)]
    similar = torch.corrcoef(torch.stack(directions)) - torch.eye(8)
    assert similar.abs().max() < 0.999  # not even the same draw at another difficulty


def test_validation_does_not_depend_on_the_batch_size(
    make_stage: Callable[..., Any], make_trainer: Callable[..., Any], make_loader: Callable[..., Any]
) -> None:
    def scores(batch_size: int) -> dict[str, float]:
        loader = make_loader(4)
        loader = type(loader)(loader.dataset, batch_size=batch_size, collate_fn=loader.collate_fn)
        (found,) = make_trainer(1).validate(make_stage(), loader, verbose=False)
        return {key: value for key, value in found.items() if not key.endswith("loss")}

    singly, together = scores(1), scores(3)
    assert {"val/rmse_m", "val/corner_error_px", "val/irmse_per_km"} <= singly.keys()
    assert singly == pytest.approx(together, rel=1e-3)
    assert singly["val/identity_corner_error_px"] > 0.5  # validation misaligns whatever the ramp says


def test_a_batch_that_is_measured_already_is_left_alone(
    make_stage: Callable[..., Any], make_trainer: Callable[..., Any]
) -> None:
    measured = {"rgb": torch.rand(1, 3, 64, 64), "depth_m": torch.rand(1, 1, 64, 64)}
    assert make_stage().on_after_batch_transfer(measured, 0) is measured
