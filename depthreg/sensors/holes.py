"""Dense depth with missing patches and missing pixels."""

from dataclasses import dataclass

import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.rendering import Rig
from depthreg.sensors.checks import require_between
from depthreg.sensors.fields import blotches


def random_patches(
    batch: int,
    size: tuple[int, int],
    count: int,
    max_radius: float,
    generator: torch.Generator | None = None,
    roughness: float = 0.0,
) -> Tensor:
    """A union of random blobs, bool (B, 1, H, W).

    Args:
        count: Blobs in each image.
        max_radius: Largest semi-axis as a share of the image's height; axes are uniform between a fifth of it and it.
        roughness: How far outlines stray from ellipses: at 0 not at all, at 1 by about a third of the semi-axis.
    """
    height, width = size
    centre, axes = torch.rand(2, batch, count, 2, generator=generator)
    centre_px = centre * torch.tensor([width, height])
    axes_px = ((0.2 + 0.8 * axes) * max_radius * height).clamp(min=0.5)
    across, along = (
        ((torch.arange(length) - centre_px[..., i, None]) / axes_px[..., i, None]).square()
        for i, length in enumerate((width, height))
    )
    limit = torch.ones(batch, 1, 1, 1)
    if roughness:
        cell_px = max(2.0, 0.3 * max_radius * height)
        uneven = blotches(torch.Size([batch, 1, height, width]), cell_px, generator, limit.device)
        limit = limit + 0.5 * roughness * uneven
    inside = torch.zeros(batch, 1, height, width, dtype=torch.bool)
    for k in range(count):  # one at a time: all at once would be `count` images in memory
        inside |= (across[:, k, None, None, :] + along[:, k, None, :, None]) < limit
    return inside


@dataclass(frozen=True)
class Holes:
    """Depth with patches and pixels missing; both grow with the difficulty, and at 0 nothing is missing.

    Args:
        patches: Missing patches in an image.
        max_radius: Largest semi-axis of a patch at difficulty 1, as a share of the image's height.
        missing_share: Share of single pixels missing at difficulty 1.
        roughness: How far the patches' outlines stray from ellipses.
    """

    patches: int = 12
    max_radius: float = 0.35
    missing_share: float = 0.95
    roughness: float = 0.6

    def __post_init__(self) -> None:
        require_between(self, patches=(0, 1000), max_radius=(0, 10), missing_share=(0, 1), roughness=(0, 10))

    rig = Rig()

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where it is missing."""
        depth_m = frames["depth_m"]
        if difficulty == 0:
            return depth_m
        batch, _, *size = depth_m.shape
        patches = random_patches(
            batch, (size[0], size[1]), self.patches, difficulty * self.max_radius, generator, self.roughness
        )
        pixels = torch.rand(depth_m.shape, generator=generator) < difficulty * self.missing_share
        return depth_m.masked_fill((patches | pixels).to(depth_m.device), 0)
