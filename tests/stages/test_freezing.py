"""What each stage lets learn, in which epoch, to the bit."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from depthreg.networks import JointNetwork
from depthreg.stages import CompletionStage, FullStage, JointStage

COMPLETION = "completion."


def parameters_and_statistics(network: JointNetwork) -> set[str]:
    return set(network.state_dict())


def test_joint_training_rests_completion_in_every_other_epoch(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage(JointStage)
    history = train(stage, 4)
    everything = parameters_and_statistics(stage.network)
    registration = {key for key in everything if not key.startswith(COMPLETION)}
    assert [history.changed(epoch) for epoch in range(4)] == [everything, registration, everything, registration]


def test_how_often_completion_rests_can_be_chosen(make_stage: Callable[..., Any]) -> None:
    stage = make_stage(JointStage, freeze_period=3)
    resting = [epoch for epoch in range(9) if list(stage.frozen_modules(epoch))]
    assert resting == [2, 5, 8]


def test_completion_training_leaves_registration_as_it_was(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage(CompletionStage)
    generator = torch.Generator().manual_seed(0)
    given = torch.rand(2, 3, 71, 90, generator=generator), 9 * torch.rand(2, 1, 71, 90, generator=generator)
    before = stage.network.eval()(*given)
    history = train(stage, 2)
    after = stage.network.eval()(*given)
    assert torch.equal(before.affine_rgb_from_depth, after.affine_rgb_from_depth)
    assert torch.equal(before.rgb_aligned, after.rgb_aligned)
    assert not torch.equal(before.depth_m, after.depth_m)
    completion = {key for key in stage.network.state_dict() if key.startswith(COMPLETION)}
    assert history.changed(0) == history.changed(1) == completion


def test_frozen_parameters_have_no_gradient_for_adam_to_follow(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage(CompletionStage, weight_decay=0.1)
    train(stage, 1)
    assert all(p.grad is None for m in stage.network.registration_modules() for p in m.parameters())


def test_full_training_changes_everything_in_every_epoch(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage(FullStage)
    history = train(stage, 2)
    assert history.changed(0) == history.changed(1) == parameters_and_statistics(stage.network)


def test_a_stage_thaws_what_the_one_before_it_froze(make_stage: Callable[..., Any], train: Callable[..., Any]) -> None:
    first = make_stage(CompletionStage)
    train(first, 1)
    history = train(make_stage(FullStage, network=first.network), 1)
    assert history.changed(0) == parameters_and_statistics(first.network)


def test_frozen_modules_are_back_in_their_place_after_validation(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage(JointStage, freeze_period=1)  # rests always
    train(stage, 3)
    assert not any(parameter.requires_grad for parameter in stage.network.completion.parameters())
    assert not stage.network.completion.training and stage.network.registration.training


@pytest.mark.parametrize("stage", [JointStage, CompletionStage, FullStage])
def test_what_is_frozen_depends_on_the_epoch_alone(stage: type, make_stage: Callable[..., Any]) -> None:
    asked_in_order, asked_backwards = make_stage(stage), make_stage(stage)
    names = [[type(m).__name__ for m in asked_in_order.frozen_modules(epoch)] for epoch in range(5)]
    backwards = [[type(m).__name__ for m in asked_backwards.frozen_modules(epoch)] for epoch in reversed(range(5))]
    assert names == backwards[::-1]
