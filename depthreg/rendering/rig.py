"""Which instruments stand beside the depth camera, and so have to be rendered with it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from depthreg.data.sample import Frame
from depthreg.errors import InputError
from depthreg.rendering.scanners import ScanPattern


class PairMatcher(Protocol):
    """Finds disparities in a rendered stereo pair."""

    def __call__(self, frame: Frame, rng: np.random.Generator) -> np.ndarray:
        """Disparity in the left image, (H, W) float32 pixels; 0 where it found nothing."""


@dataclass(frozen=True)
class RandomOffset:
    """A colour camera that stands a little beside the depth camera, displaced and turned at random.

    Args:
        max_shift_m: Largest displacement along each axis, metres.
        max_turn_deg: Largest turn about each axis, degrees.

    Raises:
        InputError: A limit is negative, or the turn would make the colour camera look elsewhere.
    """

    max_shift_m: float
    max_turn_deg: float

    def __post_init__(self) -> None:
        if not self.max_shift_m >= 0 or not 0 <= self.max_turn_deg <= 10:
            raise InputError(
                "offset: expected max_shift_m of at least 0 and max_turn_deg from 0 to 10, "
                f"got {self.max_shift_m} and {self.max_turn_deg}"
            )

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        """One `rgb_from_depth`, (4, 4) rigid."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", self.max_turn_deg * rng.uniform(-1, 1, 3), degrees=True).as_matrix()
        pose[:3, 3] = self.max_shift_m * rng.uniform(-1, 1, 3)
        return pose


@dataclass(frozen=True)
class Rig:
    """What a sensor needs of a frame beyond colour and depth.

    Attributes:
        scans: LiDARs; each frame is scanned by one of them, drawn at random.
        matchers: Stereo matchers; each frame's pair is matched by one of them, drawn at random.
        surfaces: Whether normals, albedo and gloss are needed.
        offset: A colour camera that stands elsewhere.
        right: Whether the right view is needed, even without a matcher.
    """

    scans: tuple[ScanPattern, ...] = ()
    matchers: tuple[PairMatcher, ...] = ()
    surfaces: bool = False
    offset: RandomOffset | None = None
    right: bool = False

    def __or__(self, other: "Rig") -> "Rig":
        """Everything that either needs."""
        return Rig(
            scans=self.scans + tuple(scan for scan in other.scans if scan not in self.scans),
            # Compared, not hashed: a matcher that a configuration made may hold lists.
            matchers=self.matchers + tuple(matcher for matcher in other.matchers if matcher not in self.matchers),
            surfaces=self.surfaces or other.surfaces,
            offset=self.offset or other.offset,
            right=self.right or other.right,
        )
