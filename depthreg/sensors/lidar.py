"""What a spinning LiDAR reports: fewer lines, lost returns, noisy ranges.

Sources: HDL-64E's data sheet (2 cm range noise) and CARLA's drop-off model (intensity exp(-0.004 / m * range)).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch, LidarColumns
from depthreg.errors import InputError
from depthreg.rendering import SCANNERS, Rig


def rasterize(uv_px: Tensor, depth_m: Tensor, size: tuple[int, int]) -> Tensor:
    """Draw returns into a depth image; where several fall into a pixel, the nearest wins.

    Args:
        uv_px: Positions (column, row), (B, N, 2).
        depth_m: z-depth, (B, N); 0 for a return that was lost.
        size: Height and width.

    Returns:
        (B, 1, H, W) in metres, 0 where nothing fell.
    """
    height, width = size
    column, row = uv_px.round().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (depth_m > 0)
    pixel = torch.where(inside, row * width + column, 0)
    candidate = torch.where(inside, depth_m, torch.inf)
    image = torch.full((len(uv_px), height * width), torch.inf, device=uv_px.device)
    image = image.scatter_reduce(1, pixel, candidate, reduce="amin")
    return torch.where(image.isinf(), 0, image).unflatten(1, (1, height, width))


def keep_lines(ring: Tensor, lines: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Choose evenly spread lasers, starting at a random one.

    Args:
        ring: Laser of each return, (B, N), 0 to 63.
        lines: How many of the 64 lasers to keep, (B,), in [1, 64].

    Returns:
        bool (B, N), True for returns of the chosen lasers.
    """
    phase = torch.rand(len(ring), 1, generator=generator).to(ring.device)
    share = lines[:, None].to(ring.device) / 64
    # A laser is kept where the running count of kept lasers steps up: Bresenham's rule for evenly spread picks.
    return torch.floor((ring + 1) * share + phase) > torch.floor(ring * share + phase)


@dataclass(frozen=True)
class Lidar:
    """Depth that thins out from dense into a scanner's returns as the difficulty grows.

    At difficulty 0 it reports the dense truth. In between, dense pixels survive with probability (1 - difficulty)^4
    beside the scanner's returns; at 1 there are only returns, with fewer lines, drop-out and range noise.

    Args:
        scanners: Names of the scanners, keys of `SCANNERS`; each frame is scanned by one of them.
        min_lines: Fewest of the 64 lines kept at difficulty 1.
        drop_share: Share of returns lost at random at difficulty 1.
        absorption_per_m: Rate at which a return's intensity falls with range.
        range_noise_m: Standard deviation of the range at difficulty 1.
    """

    scanners: Sequence[str] = ("hdl64",)
    min_lines: int = 32
    drop_share: float = 0.1
    absorption_per_m: float = 0.004
    range_noise_m: float = 0.02

    def __post_init__(self) -> None:
        unknown = sorted(set(self.scanners) - set(SCANNERS))
        if unknown or not self.scanners:
            raise InputError(f"sensor.scanners must name some of {sorted(SCANNERS)}, got {list(self.scanners)}")

    @property
    def rig(self) -> Rig:
        """One scanner a frame."""
        return Rig(scans=tuple(SCANNERS[name] for name in self.scanners))

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """Sparse, noisy z-depth in metres, (B, 1, H, W); 0 where there is no return."""
        truth_m = frames["depth_m"]
        if difficulty == 0:
            return truth_m
        survivors = torch.rand(truth_m.shape, generator=generator).to(truth_m.device) < (1 - difficulty) ** 4
        returns_m = self._returns(frames["lidar"], difficulty, generator)
        scanned = rasterize(frames["lidar"][..., :2], returns_m, (truth_m.shape[-2], truth_m.shape[-1]))
        return torch.where(scanned > 0, scanned, truth_m * survivors)

    def _returns(self, lidar: Tensor, difficulty: float, generator: torch.Generator | None) -> Tensor:
        columns = LidarColumns(*lidar.unbind(-1))
        depth_m, range_m = columns.depth_m, columns.range_m
        lost_share = difficulty * self.drop_share
        lines = 64 - difficulty * (64 - self.min_lines) * torch.rand(len(lidar), generator=generator)
        noise_m = torch.randn(range_m.shape, generator=generator).to(lidar.device) * self.range_noise_m * difficulty
        luck = torch.rand(range_m.shape, generator=generator).to(lidar.device)
        survives = luck < (1 - lost_share) * torch.exp(-difficulty * self.absorption_per_m * range_m)
        kept = survives & keep_lines(columns.ring, lines, generator) & (range_m > 0)
        # Range noise acts along the ray; z grows in proportion.
        return torch.where(kept, depth_m * (1 + noise_m / range_m.clamp(min=0.1)), 0).clamp(min=0)
