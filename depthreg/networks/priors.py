"""What a sparse depth map says by itself: filled in several ways, none of which is right everywhere."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from depthreg.networks.blocks import fill_smoothly, nearest_valid

FILLINGS = (
    "nearest return",
    "nearest surface",
    "smooth",
    "thin plate",
    "above",
    "below",
    "plane between both",
    "beyond the farthest",
)
FAR_FACTOR = 1.5  # the sky, as a multiple of the farthest return
REACH_PX = 128  # farther than this from any return, filling is smooth
PLATE_STEPS = 8  # at each level: scattered points are filled as well as by planes between them
NOTHING = -1e9  # less than any log-depth, and finite: ONNX Runtime's maxima begin at the lowest finite number
UP, DOWN = 1, -1  # directions in which to look for a return


class Priors(NamedTuple):
    """Filled depth of cells of 2 x 2 pixels, as logarithms relative to the image's mean: no unit matters."""

    centre: Tensor  # (B, 1, 1, 1) mean log-depth of the returns
    returns: Tensor  # (B, 1, H, W) of the pixels themselves, 0 where there is no return
    candidates: Tensor  # (B, 8, h, w), see `FILLINGS`
    sparse: Tensor  # (B, 1, h, w) nearest of a cell's returns, 0 where there is none
    valid: Tensor  # (B, 1, h, w) 1 where a cell holds a return
    distance: Tensor  # (B, 1, h, w) log(1 + pixels to the nearest return), at most `REACH_PX`


def find_priors(depth_m: Tensor, surface_window: int = 7) -> Priors:
    """Fill a sparse depth map.

    A scanner stands beside the camera and so sees past the edges of what is near: where near and far returns mix, the
    surface is the near one (as IP-Basic has it; Ku et al., CRV 2018).

    Args:
        depth_m: (B, 1, H, W), sides even, 0 where there is no return. Without any, all is finite and says nothing.
        surface_window: Side of the neighbourhood in cells, odd, whose nearest surface counts.
    """
    known = depth_m > 0
    logs = torch.where(known, depth_m, 1).log()
    centre = logs.sum(dim=(1, 2, 3), keepdim=True) / known.sum(dim=(1, 2, 3), keepdim=True).clamp(min=1)
    returns = (logs - centre) * known
    cells = F.max_pool2d(torch.where(known, -returns, NOTHING), 2)  # negative: a maximum is the nearest
    valid = cells > NOTHING
    sparse = torch.where(valid, -cells, 0)
    nearest, smooth, distance_px = fill_around(sparse, valid)
    plate = fill_smoothly(sparse, valid, PLATE_STEPS)
    around = window_max(cells, surface_window)
    surface = torch.where(around > NOTHING, -around, nearest)
    farthest = returns.amax(dim=(1, 2, 3), keepdim=True)  # at least the mean's 0
    sky = (farthest + math.log(FAR_FACTOR)).expand_as(smooth)
    candidates = torch.cat([nearest, surface, smooth, plate, *fill_columns(sparse, valid, nearest), sky], dim=1)
    return Priors(centre, returns, candidates, sparse, valid.to(sparse.dtype), (1 + distance_px).log())


def fill_around(values: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest return's value, a smooth filling, and how many pixels away the nearest return is.

    Args:
        values: Of cells, (B, 1, h, w).
        valid: bool, (B, 1, h, w).

    Returns:
        (B, 1, h, w) each; beyond `REACH_PX`, the nearest return's value is the smooth filling's.
    """
    nearest, squared = nearest_valid(values, valid, REACH_PX // 2)
    smooth = fill_smoothly(values, valid)
    distance_px = 2 * squared.to(values.dtype).clamp(max=(REACH_PX / 2) ** 2).sqrt()
    return torch.where(distance_px < REACH_PX, nearest, smooth), smooth, distance_px


def window_max(x: Tensor, side: int) -> Tensor:
    """The maximum of each pixel's neighbourhood, a square of `side` pixels, odd; one axis at a time takes less time."""
    rows = F.max_pool2d(x, (side, 1), stride=1, padding=(side // 2, 0))
    return F.max_pool2d(rows, (1, side), stride=1, padding=(0, side // 2))


def fill_columns(values: Tensor, valid: Tensor, otherwise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The next return above, the next one below, and the plane through both: scan lines lie across the columns.

    The inverse depth of a plane is linear in the image.

    Args:
        values: Log-depth, (B, 1, h, w).
        valid: bool, (B, 1, h, w).
        otherwise: What counts where a column has no return within `REACH_PX`, (B, 1, h, w).

    Returns:
        (B, 1, h, w) each.
    """
    (above, has_above, up), (below, has_below, down) = (next_in_column(values, valid, side) for side in (UP, DOWN))
    share = up / (up + down).clamp(min=1)
    plane = -torch.lerp((-above).exp(), (-below).exp(), share).log()
    above, below = torch.where(has_above, above, otherwise), torch.where(has_below, below, otherwise)
    return above, below, torch.where(has_above & has_below, plane, torch.where(has_above, above, below))


def next_in_column(values: Tensor, valid: Tensor, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """The first valid cell upwards or downwards, its own included, in ever longer strides: log2(reach) passes.

    Args:
        values: (B, 1, h, w).
        valid: bool, (B, 1, h, w).
        side: `UP` or `DOWN`.

    Returns:
        Its value, whether there is one within `REACH_PX`, and how many cells away it is, (B, 1, h, w) each.
    """
    distance = torch.zeros_like(values)
    stride = 1
    while stride < REACH_PX // 2:
        # Validity as numbers: Inductor's C++ for a padded bool doesn't compile (torch 2.13).
        parts = (values, valid.to(values.dtype), distance + stride)
        others = [shifted(part, side * stride) for part in parts]
        found = ~valid & (others[1] > 0)
        values, distance = torch.where(found, others[0], values), torch.where(found, others[2], distance)
        valid = valid | found
        stride *= 2
    return values, valid, distance


def shifted(x: Tensor, rows: int) -> Tensor:
    """What lies so many rows higher up in (B, 1, h, w), lower down where negative; 0 beyond the border."""
    below = max(-rows, 0)
    return F.pad(x, [0, 0, max(rows, 0), below])[..., below : below + x.shape[-2], :]
