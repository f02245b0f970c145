"""Random fields that vary smoothly over the image: errors of real depth cameras come in patches, not in single pixels.

All randomness is drawn on the CPU, so that a generator's seed gives the same field on every device.
"""

import math
from functools import reduce

import torch
import torch.nn.functional as F
from torch import Tensor

from depthreg.sensors.windows import shifted

# Squared weights of the 7 px kernel below, (1, 2, 3, 3, 3, 2, 1) / 15, summed over one axis: what smoothing leaves.
_KERNEL_POWER = 37 / 225


def correlated_noise(shape: torch.Size, generator: torch.Generator | None, device: torch.device) -> Tensor:
    """Gaussian noise of zero mean and unit variance everywhere, correlated over about 3 px, (B, 1, H, W).

    White noise through a 5 px and a 3 px box, which is a bell of 1.6 px.
    """
    batch, channels, height, width = shape
    white = torch.randn(batch, channels, height + 6, width + 6, generator=generator).to(device)
    for axis in (-1, -2):
        for side in (5, 3):
            white = reduce(torch.add, shifted(white, axis, side))
    return white / (15 * 15 * _KERNEL_POWER)


def blotches(shape: torch.Size, cell_px: float, generator: torch.Generator | None, device: torch.device) -> Tensor:
    """Gaussian noise on a grid of `cell_px`, linear in between, (B, C, H, W).

    Zero mean, and unit variance on average; cheaper than `correlated_noise`, but larger at the nodes than in between.
    """
    batch, channels, *size = shape
    nodes = [math.ceil((side - 1) / cell_px) + 1 for side in size]
    coarse = torch.randn(batch, channels, *nodes, generator=generator).to(device)
    # Linear interpolation leaves 2/3 of the variance along each axis.
    return 1.5 * F.interpolate(coarse, size=size, mode="bilinear", align_corners=True)
