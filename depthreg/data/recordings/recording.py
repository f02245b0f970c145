"""What every recording gives, whatever its format: named frames, read one at a time, and when they were taken."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from depthreg.errors import InputError
from depthreg.networks.output import MIN_SIDE_PX

MAX_APART_S = 0.02  # of a colour and a depth image that count as one moment, as TUM's tools have it


class Rgbd(NamedTuple):
    """One moment: colour and sparse depth of one size."""

    rgb: np.ndarray  # (H, W, 3) uint8
    depth_m: np.ndarray  # (H, W) float32 z-depth, 0 = no return
    intrinsics: np.ndarray | None = None  # K (3, 3) float32; None where unknown


@dataclass(frozen=True)
class RecordedFrame:
    """A frame that is read when it is needed; reading raises `InputError` if it can't be used."""

    name: str  # unique in its recording, and fit for a folder
    read: Callable[[], Rgbd]
    time_s: float | None = None  # since whenever; None where the recording doesn't say


@dataclass(frozen=True)
class Recording:
    """The frames of one rig, in the order of their times."""

    frames: Sequence[RecordedFrame]
    depth_scale: float  # stored units per metre, of the depth images that are written too
    unpaired: int = 0  # images that no partner of their moment was found for


@dataclass(frozen=True)
class Settings:
    """What a user may say about a recording that doesn't say it itself, or says it wrongly."""

    depth_scale: float | None = None  # stored units per metre
    rgb_topic: str | None = None
    depth_topic: str | None = None


@dataclass(frozen=True)
class Kind:
    """A format of recordings."""

    name: str
    holds: str  # how to tell one, for messages
    recognises: Callable[[Path], bool]
    open: Callable[[Path, Settings], Recording]


def check_frame(frame: Rgbd, rgb_name: object, depth_name: object) -> Rgbd:
    """The frame itself, if the networks take it.

    Raises:
        InputError: The sizes differ, a side is below `MIN_SIDE_PX`, or there is no return.
    """
    rgb_size, depth_size = ("x".join(map(str, array.shape[1::-1])) for array in (frame.rgb, frame.depth_m))
    if rgb_size != depth_size:
        raise InputError(f"{rgb_name} is {rgb_size} but {depth_name} is {depth_size}: one size was expected")
    if min(frame.depth_m.shape) < MIN_SIDE_PX:
        raise InputError(f"{rgb_name} is {rgb_size}: at least {MIN_SIDE_PX}x{MIN_SIDE_PX} was expected")
    if not frame.depth_m.any():
        raise InputError(f"{depth_name} holds no valid return: at least one depth above 0 was expected")
    return frame


def associate(rgb_s: Sequence[float], depth_s: Sequence[float], where: Path) -> list[tuple[int, int]]:
    """Indices of the colour and depth images that belong together: each is the nearest of the other in time.

    Args:
        rgb_s, depth_s: When the images were taken.
        where: The recording, for the message.

    Returns:
        Pairs no more than `MAX_APART_S` apart, in the order of the colour images' times.

    Raises:
        InputError: There are none.
    """
    if not (len(rgb_s) and len(depth_s)):
        raise InputError(
            f"{where} holds {len(rgb_s)} colour and {len(depth_s)} depth images: some of both were expected"
        )
    to_depth, to_rgb = _nearest(rgb_s, depth_s), _nearest(depth_s, rgb_s)
    apart_s = np.abs(np.asarray(depth_s)[to_depth] - np.asarray(rgb_s))
    pairs = [
        (int(i), int(to_depth[i]))
        for i in np.argsort(rgb_s, kind="stable")
        if to_rgb[to_depth[i]] == i and apart_s[i] <= MAX_APART_S
    ]
    if not pairs:
        raise InputError(
            f"{where}: no colour and depth image lie within {MAX_APART_S:g} s of each other, "
            f"the nearest are {apart_s.min():.3f} s apart"
        )
    return pairs


def _nearest(ours_s: Sequence[float], theirs_s: Sequence[float]) -> np.ndarray:
    """For each of our times the index of the nearest of theirs."""
    order = np.argsort(theirs_s, kind="stable")
    sorted_s = np.asarray(theirs_s)[order]
    after = np.searchsorted(sorted_s, ours_s).clip(max=len(order) - 1)
    before = (after - 1).clip(min=0)
    nearer_before = np.abs(sorted_s[before] - ours_s) <= np.abs(sorted_s[after] - ours_s)
    return order[np.where(nearer_before, before, after)]
