"""What every network of depthreg takes and gives."""

from typing import NamedTuple

from torch import Tensor

from depthreg.networks.registration import LocalMatches

MIN_SIDE_PX = 64  # the smallest picture that a network takes


class JointOutput(NamedTuple):
    """What a network returns."""

    depth_m: Tensor  # (B, 1, H, W) dense z-depth in metres, within the network's range
    rgb_aligned: Tensor  # (B, 3, H, W) colour on the depth's grid, 0 where the colour image doesn't reach
    affine_rgb_from_depth: Tensor  # (B, 2, 3) in pixels
    matches: list[LocalMatches]  # what registration saw on the way; training learns from it
    trust: Tensor  # (B,) in [0, 1], how likely the affine is right; 1 from a network that can't tell
    log_error: Tensor  # (B, 1, H, W) expected absolute error of log(depth); NaN from a network that can't tell
    earlier_m: tuple[Tensor, ...] = ()  # depth as it was on the way, (B, 1, H, W) each; training learns from it


def check_inputs(rgb: Tensor, depth_m: Tensor) -> None:
    """Refuse what no network takes.

    Raises:
        ValueError: The sizes differ, or a side is below 64 pixels.
    """
    if min(rgb.shape[-2:]) < MIN_SIDE_PX or rgb.shape[-2:] != depth_m.shape[-2:]:
        raise ValueError(
            f"rgb and depth_m must be of one size, at least {MIN_SIDE_PX} x {MIN_SIDE_PX}, "
            f"got {tuple(rgb.shape)}, {tuple(depth_m.shape)}"
        )
