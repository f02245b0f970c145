"""Rain before a camera: how much it dims, and the streaks of the drops close by.

Sources: extinction by rate from Weber et al., "A multiscale model for rain rendering in real-time" (Computers &
Graphics 2015); sizes of drops from Marshall and Palmer, "The distribution of raindrops with size" (1948); how fast they
fall and how much of the light behind them they replace from Garg and Nayar, "Vision and rain" (IJCV 2007).
"""

from typing import NamedTuple

import torch
from torch import Tensor

_NEAREST_M, _FARTHEST_M = 1.0, 4.0  # of drops: nearer ones are blurred away, farther ones are haze
_SMALLEST_MM = 1.5  # smaller ones leave no streak that a picture shows
_DROPS = 8192  # of an image at most: what 100 mm/h put before KITTI's camera


def rain_extinction_per_m(rate_mm_h: Tensor) -> Tensor:
    """Extinction of rain; any shape."""
    return 0.312e-3 * rate_mm_h**0.67


def drops_per_m3(rate_mm_h: Tensor, min_diameter_mm: float) -> Tensor:
    """How many drops larger than a diameter hang in a cubic metre, by Marshall and Palmer's distribution."""
    per_mm = _sizes_per_mm(rate_mm_h)
    return 8000 / per_mm * torch.exp(-per_mm * min_diameter_mm)


def _sizes_per_mm(rate_mm_h: Tensor) -> Tensor:
    """Rate at which larger drops get rarer."""
    return 4.1 * rate_mm_h**-0.21


class Streaks(NamedTuple):
    """Where drops have fallen while the shutter was open; each (B, N)."""

    x_px: Tensor  # of the middle
    y_px: Tensor
    length_px: Tensor
    opacity_px: Tensor  # share of the light behind it that it replaces, times its width in pixels; 0 = no drop


def random_streaks(
    rate_mm_h: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    exposure_s: float,
    generator: torch.Generator | None = None,
) -> Streaks:
    """The streaks of the drops in the pyramid that the camera looks into.

    Args:
        rate_mm_h: Rain rate, (B,), > 0.
        intrinsics: K (B, 3, 3).
        size: Height and width of the image.
        exposure_s: How long the shutter is open.
        generator: Source of randomness, on the CPU.
    """
    height, width = size
    x, y, luck, excess = torch.rand(4, len(rate_mm_h), _DROPS, generator=generator).to(rate_mm_h.device)
    focal_px = intrinsics[:, :1, 0]
    distance_m = _FARTHEST_M * (1 - luck) ** (1 / 3)  # as many in each cubic metre, none at 0
    diameter_m = 1e-3 * (_SMALLEST_MM - torch.log(1 - excess) / _sizes_per_mm(rate_mm_h)[:, None])
    speed_m_s = 200 * (diameter_m / 2).sqrt()
    pyramid_m3 = width * height / focal_px**2 * _FARTHEST_M**3 / 3
    count = drops_per_m3(rate_mm_h, _SMALLEST_MM)[:, None] * pyramid_m3
    exists = (torch.arange(_DROPS, device=luck.device) < count) & (distance_m > _NEAREST_M)
    # A drop covers a point of its path for the time that it takes to fall by its own diameter.
    opacity = (diameter_m / speed_m_s / exposure_s).clamp(max=1)
    return Streaks(
        x_px=x * width,
        y_px=y * height,
        length_px=speed_m_s * exposure_s * focal_px / distance_m,
        opacity_px=exists * opacity * focal_px * diameter_m / distance_m,
    )


def draw_streaks(streaks: Streaks, slant: Tensor, size: tuple[int, int], points: int) -> Tensor:
    """Share of each pixel's light that streaks replace, (B, 1, H, W) in [0, 1].

    Args:
        streaks: N of each image.
        slant: Pixels to the right for each pixel down, (B,): wind.
        size: Height and width.
        points: Of each streak: at least its length in pixels, else it has gaps.
    """
    height, width = size
    along_px = torch.linspace(-0.5, 0.5, points, device=slant.device) * streaks.length_px[..., None]  # (B, N, P)
    row = (streaks.y_px[..., None] + along_px).round().long()
    x_px = streaks.x_px[..., None] + slant[:, None, None] * along_px
    left = x_px.floor()
    weight = (streaks.opacity_px * streaks.length_px / points)[..., None]
    cover = weight.new_zeros(len(slant), height * width)
    for column, share in ((left, left + 1 - x_px), (left + 1, x_px - left)):
        column = column.long()
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = torch.where(inside, row * width + column, 0)
        cover.scatter_add_(1, pixel.flatten(1), (inside * share * weight).flatten(1))
    return cover.clamp(max=1).unflatten(1, (1, height, width))
