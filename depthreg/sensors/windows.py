"""What pixels make of their neighbours: operations over small windows, along one axis after the other for speed."""

from collections.abc import Iterator
from functools import reduce

import torch
import torch.nn.functional as F
from torch import Tensor


def largest_within(image: Tensor, radius_px: int) -> Tensor:
    """Largest value of each square window of 2 `radius_px` + 1 pixels, (B, C, H, W)."""
    for axis, padding in ((-1, (radius_px, radius_px, 0, 0)), (-2, (0, 0, radius_px, radius_px))):
        padded = F.pad(image, padding, value=-torch.inf)
        image = reduce(torch.maximum, shifted(padded, axis, 2 * radius_px + 1))
    return image


def shifted(padded: Tensor, axis: int, count: int) -> Iterator[Tensor]:
    """Views of an image that start at each of its first `count` pixels along an axis, as long as they fit.

    Adding or comparing whole images is many times faster on a CPU than PyTorch's pooling over small windows.
    """
    length = padded.shape[axis] - count + 1
    return (padded.narrow(axis, start, length) for start in range(count))


def local_step_m(depth_m: Tensor) -> Tensor:
    """Largest minus smallest depth of each 3x3 window, (B, 1, H, W)."""
    return largest_within(depth_m, 1) + largest_within(-depth_m, 1)


def mix_neighbours(image: Tensor, share: float) -> Tensor:
    """What pixels see whose footprint takes in `share` of each neighbour along both axes, (B, C, H, W)."""
    for axis, padding in ((-1, (1, 1, 0, 0)), (-2, (0, 0, 1, 1))):
        padded, length = F.pad(image, padding, mode="replicate"), image.shape[axis]
        beside = padded.narrow(axis, 0, length) + padded.narrow(axis, 2, length)
        image = torch.lerp(image, beside / 2, 2 * share)
    return image


def average_returns(depth_m: Tensor, share: float) -> Tensor:
    """Average over the returns in 3x3 pixels, with `share` of each neighbour along both axes; holes stay holes.

    Args:
        depth_m: (B, 1, H, W), 0 where there is no return.
        share: In [0, 1/3]; at 1/3 all returns count the same.
    """
    is_return = depth_m > 0
    weight = mix_neighbours(is_return.to(depth_m.dtype), share)
    return torch.where(is_return, mix_neighbours(depth_m, share) / weight.clamp(min=1e-6), 0)


def look_up(image: Tensor, shift_px: Tensor) -> Tensor:
    """`image[y + shift_y, x + shift_x]` at the nearest pixel, held inside the image.

    Args:
        image: (B, 1, H, W).
        shift_px: (x, y), (B, 2, H, W).
    """
    height, width = image.shape[-2:]
    column = (torch.arange(width, device=image.device) + shift_px[:, 0].round()).clamp(0, width - 1)
    row = (torch.arange(height, device=image.device)[:, None] + shift_px[:, 1].round()).clamp(0, height - 1)
    place = (row * width + column).long().flatten(1)
    return image.flatten(2).gather(2, place[:, None]).view_as(image)
