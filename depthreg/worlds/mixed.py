"""Several worlds as one."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from depthreg.errors import InputError
from depthreg.worlds.scene import Scene

_CHOICE = 4  # sets the draw of the world apart from the worlds' own draws of the same seed and index


@dataclass(frozen=True)
class MixedWorld:
    """Draws each scene from one of several worlds; called as `world(seed, index)`.

    Attributes:
        worlds: By name; each is called as `world(seed, index)`.
        shares: How often each is drawn, by the same names; any positive numbers.

    Raises:
        InputError: The names differ, or a share isn't positive.
    """

    worlds: Mapping[str, Callable[[int, int], Scene]]
    shares: Mapping[str, float]

    def __post_init__(self) -> None:
        if not self.worlds or self.worlds.keys() != self.shares.keys() or min(self.shares.values()) <= 0:
            raise InputError(
                f"world.shares must name a positive share of each of {sorted(self.worlds)}, got {dict(self.shares)}"
            )

    def __call__(self, seed: int, index: int) -> Scene:
        """The scene that these numbers stand for; the same on every machine."""
        shares = np.array([self.shares[name] for name in self.worlds], dtype=float)
        number = np.random.default_rng([seed, index, _CHOICE]).choice(len(shares), p=shares / shares.sum())
        return list(self.worlds.values())[number](seed, index)
