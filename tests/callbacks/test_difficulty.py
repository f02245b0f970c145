"""The ramp, in closed form."""

import numpy as np
import pytest

from depthreg.callbacks import DifficultyRamp


@pytest.mark.parametrize("epochs", [2, 3, 8, 50, 100])
@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
@pytest.mark.parametrize("shape", ["linear", "cosine", "steps"])
def test_the_ramp_starts_at_its_start_ends_at_its_end_and_never_falls(epochs: int, share: float, shape: str) -> None:
    ramp = DifficultyRamp(start=0.1, end=0.9, ramp_share=share, shape=shape)
    difficulties = [ramp.difficulty(epoch, epochs) for epoch in range(epochs)]
    assert difficulties[0] == pytest.approx(0.1) and difficulties[-1] == pytest.approx(0.9)
    assert difficulties == sorted(difficulties)
    assert all(0 <= difficulty <= 1 for difficulty in difficulties)
    reached = [epoch for epoch in range(epochs) if difficulties[epoch] == pytest.approx(0.9)]
    assert reached[0] <= max(share * epochs, 1)


def test_the_ramp_is_a_straight_line() -> None:
    ramp = DifficultyRamp(start=0.0, end=1.0, ramp_share=1.0)
    assert [ramp.difficulty(epoch, 6) for epoch in range(6)] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])


def test_a_cosine_ramp_starts_and_ends_gently() -> None:
    ramp = DifficultyRamp(start=0.0, end=1.0, ramp_share=1.0, shape="cosine")
    expected = [(1 - np.cos(np.pi * epoch / 4)) / 2 for epoch in range(5)]
    assert [ramp.difficulty(epoch, 5) for epoch in range(5)] == pytest.approx(expected)


def test_steps_are_of_equal_height_and_length() -> None:
    ramp = DifficultyRamp(start=0.0, end=0.9, ramp_share=1.0, shape="steps", steps=4)
    assert [ramp.difficulty(epoch, 9) for epoch in range(9)] == pytest.approx([0, 0, 0.3, 0.3, 0.6, 0.6, 0.9, 0.9, 0.9])


def test_the_difficulty_of_each_epoch_can_be_listed_and_the_last_one_holds() -> None:
    ramp = DifficultyRamp(values=[0.5, 0.2, 0.7])
    assert [ramp.difficulty(epoch, 5) for epoch in range(5)] == [0.5, 0.2, 0.7, 0.7, 0.7]


def test_a_single_epoch_has_some_difficulty_between_the_two() -> None:
    assert 0.1 <= DifficultyRamp(start=0.1, end=0.9).difficulty(0, 1) <= 0.9


@pytest.mark.parametrize(
    "option",
    [
        {"start": -0.1},
        {"end": 1.1},
        {"ramp_share": 0.0},
        {"ramp_share": 1.5},
        {"shape": "cubic"},
        {"steps": 1},
        {"values": []},
        {"values": [2]},
    ],
)
def test_what_cannot_be_a_ramp_is_refused(option: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(option))):
        DifficultyRamp(**option)
