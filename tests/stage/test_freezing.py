"""What each stage of the paper's curriculum lets learn, in which epoch, to the bit."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from depthreg.callbacks import FreezeSchedule
from depthreg.config import compose_config

COMPLETION = "completion."


def schedule(stage: str) -> FreezeSchedule:
    """As the configuration has it."""
    return FreezeSchedule(**compose_config("train").stages[stage].freeze)


def answers(stage: Any) -> Any:
    generator = torch.Generator().manual_seed(0)
    rgb, depth_m = (torch.rand(2, channels, 71, 90, generator=generator) for channels in (3, 1))
    with torch.no_grad():
        return stage.network.eval()(rgb, 9 * depth_m)


def test_joint_training_rests_completion_in_every_other_epoch(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage()
    history = train(stage, 4, freeze=schedule("joint"))
    everything = set(stage.network.state_dict())
    registration = {key for key in everything if not key.startswith(COMPLETION)}
    assert [history.changed(epoch) for epoch in range(4)] == [everything, registration, everything, registration]


def test_completion_gives_the_same_depth_before_and_after_an_epoch_that_rests_it(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage()
    generator = torch.Generator().manual_seed(0)
    given = [torch.rand(2, channels, 72, 88, generator=generator) for channels in (4, 16)]
    before = stage.network.completion.eval()(*given)
    train(stage, 1, freeze=FreezeSchedule(["completion"]))
    assert torch.equal(before, stage.network.completion.eval()(*given))


def test_completion_training_leaves_registration_as_it_was(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage()
    before = answers(stage)
    history = train(stage, 2, freeze=schedule("completion"))
    after = answers(stage)
    assert torch.equal(before.affine_rgb_from_depth, after.affine_rgb_from_depth)
    assert torch.equal(before.rgb_aligned, after.rgb_aligned)
    assert not torch.equal(before.depth_m, after.depth_m)
    completion = {key for key in stage.network.state_dict() if key.startswith(COMPLETION)}
    assert history.changed(0) == history.changed(1) == completion


def test_full_training_changes_everything_in_every_epoch(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage()
    history = train(stage, 2, freeze=schedule("full"))
    assert history.changed(0) == history.changed(1) == set(stage.network.state_dict())


def test_frozen_parameters_have_no_gradient_for_adam_to_follow(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage(weight_decay=0.1)
    train(stage, 1, freeze=FreezeSchedule(["registration"]))
    assert all(parameter.grad is None for parameter in stage.network.registration.parameters())


def test_a_part_of_a_module_can_be_frozen(make_stage: Callable[..., Any], train: Callable[..., Any]) -> None:
    stage = make_stage()
    history = train(stage, 1, freeze=FreezeSchedule(["completion.head"]))
    assert history.changed(0) == {key for key in stage.network.state_dict() if not key.startswith("completion.head.")}


@pytest.mark.parametrize(("period", "resting"), [(1, [0, 1, 2, 3, 4, 5]), (2, [1, 3, 5]), (3, [2, 5])])
def test_how_often_a_module_rests_can_be_chosen(period: int, resting: list[int]) -> None:
    freeze = FreezeSchedule(["completion"], period)
    assert [epoch for epoch in range(6) if freeze.frozen(epoch)] == resting


@pytest.mark.parametrize(("name", "said"), [("completoin", "expected completion"), ("", "first_rgb, first_depth")])
def test_a_module_that_the_network_lacks_is_refused(name: str, said: str, make_network: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=said):
        FreezeSchedule([name]).check(make_network())


def test_what_an_earlier_stage_froze_thaws_in_the_next(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    first = make_stage()
    train(first, 1, freeze=schedule("completion"))
    history = train(make_stage(network=first.network), 1)
    assert history.changed(0) == set(first.network.state_dict())


def test_frozen_modules_are_back_in_their_place_after_validation(
    make_stage: Callable[..., Any], train: Callable[..., Any]
) -> None:
    stage = make_stage()
    train(stage, 3, freeze=FreezeSchedule(["completion"]))
    assert not any(parameter.requires_grad for parameter in stage.network.completion.parameters())
    assert not stage.network.completion.training and stage.network.registration.training
