"""Edges in colour that no depth has, such as shadows and reflections, and edges of depth that colour hardly shows."""

import math
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from depthreg.data.sample import Measurement
from depthreg.geometry import pixel_grid

BANDS = 3  # shadows in an image, at most
DARKEST = 0.75  # share of the light that a shadow takes, at most
CLEAREST = 0.4  # share of a reflection, at most
FAINTEST = 0.8  # share of the contrast that is lost, at most


def add_distractors(measurement: Measurement, generators: Sequence[torch.Generator], share: float) -> Measurement:
    """Cast shadows over some samples' colour, reflect it in some, take contrast from some; the truth stays as it is.

    Args:
        measurement: A batch.
        generators: One for each sample, on the CPU.
        share: Chance of shadows, of a reflection, and of less contrast.
    """
    if not share:
        return measurement
    seen = [distracted(rgb, generator, share) for rgb, generator in zip(measurement["rgb"], generators, strict=True)]
    return cast(Measurement, {**measurement, "rgb": torch.stack(seen)})


def distracted(rgb: Tensor, generator: torch.Generator, share: float) -> Tensor:
    """Colour (3, H, W) in [0, 1] with shadows, a reflection and less contrast, each by chance."""
    lots = torch.rand(6 + 4 * BANDS, generator=generator).tolist()
    shadowed, reflecting, clear, turn, faded, faint, *bands = lots
    if shadowed < share:
        rgb = rgb * shade(rgb.shape[-2:], [bands[4 * i : 4 * i + 4] for i in range(BANDS)]).to(rgb)
    if reflecting < share:
        # Its own image upside down and rolled: as much structure, and in the wrong place.
        reflection = rgb.flip(-2).roll(int((0.25 + 0.5 * turn) * rgb.shape[-1]), -1)
        rgb = torch.lerp(rgb, reflection, CLEAREST * clear)
    if faded < share:
        rgb = torch.lerp(rgb, rgb.mean().expand_as(rgb), FAINTEST * faint)
    return rgb


def shade(size: Sequence[int], bands: Sequence[Sequence[float]]) -> Tensor:
    """The share of the light (H, W) that straight bands leave.

    Args:
        size: Height and width.
        bands: Direction, place, breadth and darkness of each, in [0, 1]; from a few pixels to half the image broad.
    """
    height, width = size
    x, y = (pixel_grid(height, width) / max(height, width) - 0.5).unbind(-1)
    light = torch.ones(height, width)
    for direction, place, breadth, darkness in bands:
        across = x * math.cos(math.pi * direction) + y * math.sin(math.pi * direction)
        inside = (across - (place - 0.5)).abs() < 0.25 * breadth**2
        light = light * torch.where(inside, 1 - DARKEST * darkness, 1)
    return light
