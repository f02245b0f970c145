"""A mixture of worlds: whose scenes it gives, how often, and what it refuses."""

from collections import Counter

import numpy as np
import pytest

from depthreg.config import compose_config
from depthreg.errors import InputError
from depthreg.worlds import BlocksWorld, HouseholdWorld, MixedWorld
from depthreg.worlds.scene import Light, Scene

LIGHT = Light(np.array([0.0, 0.0, 1.0]), (1.0, 1.0, 1.0), (0.2, 0.2, 0.2))


class NamedWorld:
    """Scenes that hold nothing but the numbers that they were made of."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __call__(self, seed: int, index: int) -> Scene:
        return Scene([], LIGHT, np.diag([self.number, seed, index, 1.0]))


def test_each_world_is_drawn_as_often_as_its_share_says() -> None:
    world = MixedWorld({"a": NamedWorld(1), "b": NamedWorld(2)}, {"a": 3, "b": 1})
    drawn = Counter(world(5, index).camera_from_world[0, 0] for index in range(4000))
    assert drawn[1] / 4000 == pytest.approx(0.75, abs=4 * np.sqrt(0.75 * 0.25 / 4000))


def test_a_scene_is_its_worlds_own_of_the_same_numbers() -> None:
    world = MixedWorld({"a": NamedWorld(1), "b": NamedWorld(2)}, {"a": 1, "b": 1})
    for index in range(20):
        first, again = world(3, index).camera_from_world, world(3, index).camera_from_world
        np.testing.assert_array_equal(first, again)
        assert first[1, 1] == 3 and first[2, 2] == index


@pytest.mark.parametrize("shares", [{"a": 1}, {"a": 1, "b": 0}, {"a": 1, "c": 1}, {}])
def test_shares_that_cannot_be_meant_are_refused(shares: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"world\.shares"):
        MixedWorld({"a": NamedWorld(1), "b": NamedWorld(2)}, shares)


def test_the_configured_mixture_has_streets_and_rooms() -> None:
    config = compose_config("render", ["world=mixed", "camera=driving"])
    assert set(config.world.worlds) == set(config.world.shares) == {"driving", "household"}
    assert HouseholdWorld()(0, 0).baseline_m < BlocksWorld()(0, 0).baseline_m
