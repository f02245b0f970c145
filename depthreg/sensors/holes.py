"""Dense depth with missing patches and missing pixels."""

from dataclasses import dataclass

import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.geometry import pixel_grid
from depthreg.rendering import Rig


def random_patches(
    batch: int, size: tuple[int, int], count: int, max_radius: float, generator: torch.Generator | None = None
) -> Tensor:
    """A union of random ellipses, bool (B, 1, H, W).

    Args:
        count: Ellipses in each image.
        max_radius: Largest semi-axis as a share of the image's height; axes are uniform between a fifth of it and it.
    """
    height, width = size
    centre, axes = torch.rand(2, batch, count, 2, generator=generator)
    centre_px = centre * torch.tensor([width, height])
    axes_px = ((0.2 + 0.8 * axes) * max_radius * height).clamp(min=0.5)
    distance = (pixel_grid(height, width)[None, None] - centre_px[:, :, None, None]) / axes_px[:, :, None, None]
    return (distance.square().sum(-1) < 1).any(dim=1, keepdim=True)


@dataclass(frozen=True)
class Holes:
    """Depth with patches and pixels missing; both grow with the difficulty, and at 0 nothing is missing.

    Args:
        patches: Missing patches in an image.
        max_radius: Largest semi-axis of a patch at difficulty 1, as a share of the image's height.
        missing_share: Share of single pixels missing at difficulty 1.
    """

    patches: int = 12
    max_radius: float = 0.35
    missing_share: float = 0.95

    rig = Rig()

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where it is missing."""
        depth_m = frames["depth_m"]
        if difficulty == 0:
            return depth_m
        batch, _, *size = depth_m.shape
        patches = random_patches(batch, (size[0], size[1]), self.patches, difficulty * self.max_radius, generator)
        pixels = torch.rand(depth_m.shape, generator=generator) < difficulty * self.missing_share
        return depth_m.masked_fill((patches | pixels).to(depth_m.device), 0)
