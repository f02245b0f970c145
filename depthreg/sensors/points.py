"""Depth at few points: the corners that visual-inertial odometry tracks, or pixels chosen at random."""

import math
from dataclasses import dataclass

import torch
from kornia.feature import gftt_response
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.rendering import Rig
from depthreg.sensors.checks import require_between
from depthreg.sensors.windows import largest_within

_GREY = (0.299, 0.587, 0.114)  # ITU-R BT.601, as cameras and OpenCV have it


def grey_of(frames: FrameBatch) -> Tensor:
    """Brightness on the depth's grid, without the margin, (B, 1, H, W) in [0, 1]."""
    rgb, (height, width) = frames["rgb"], frames["depth_m"].shape[-2:]
    margin_px = (rgb.shape[-1] - width) // 2
    inner = rgb[..., margin_px : margin_px + height, margin_px : margin_px + width].float() / 255
    return (inner * inner.new_tensor(_GREY)[:, None, None]).sum(dim=1, keepdim=True)


def strongest_corners(grey: Tensor, most: int, radius_px: int, quality: float) -> tuple[Tensor, Tensor]:
    """Corners that can be tracked best (Shi & Tomasi, "Good features to track", 1994), the strongest first.

    Args:
        grey: (B, 1, H, W).
        most: How many to look for.
        radius_px: Half the side of the window in which one corner suppresses weaker ones.
        quality: Smallest response, as a share of the image's largest.

    Returns:
        Places y * W + x, int64 (B, N) with N <= `most`, and whether there was a corner left for them, bool (B, N).
    """
    response = gftt_response(grey)
    peak = largest_within(response, radius_px)
    enough = (response >= quality * response.amax(dim=(1, 2, 3), keepdim=True)) & (response > 0)
    candidates = torch.where((response == peak) & enough, response, 0).flatten(1)
    values, places = candidates.topk(min(most, candidates.shape[1]), dim=1)
    return places, values > 0


def draw_counts(batch: int, limits: tuple[int, int], generator: torch.Generator | None) -> Tensor:
    """Numbers of points, log-uniform between the limits, (B,) float on the CPU."""
    low, high = (math.log(limit) for limit in limits)
    return (low + (high - low) * torch.rand(batch, generator=generator)).exp().round()


def disturb_inverse_depth(
    depth_m: Tensor, sigma_per_m: float, outlier_share: float, outlier_octaves: float, generator: torch.Generator | None
) -> Tensor:
    """Errors of triangulation: constant in inverse depth, so the depth's grow with z^2; and a few gross ones.

    Args:
        depth_m: Of any shape, 0 where there is none.
        sigma_per_m: Standard deviation of 1 / z.
        outlier_share: Share of points with a gross error.
        outlier_octaves: Largest gross error, as a power of two that the depth is multiplied by.

    Returns:
        Depths of the same shape; 0 where the error would put the point behind the camera, which a tracker notices.
    """
    noise = torch.randn(depth_m.shape, generator=generator).to(depth_m.device)
    luck, gross = torch.rand(2, *depth_m.shape, generator=generator).to(depth_m.device)
    inverse_per_m = 1 / depth_m.clamp(min=1e-3) + sigma_per_m * noise
    factor = torch.where(luck < outlier_share, torch.exp2(outlier_octaves * (2 * gross - 1)), 1)
    return torch.where((depth_m > 0) & (inverse_per_m > 0), factor / inverse_per_m.clamp(min=1e-6), 0)


def _check_counts(counts: tuple[int, int]) -> None:
    low, high = counts
    if not 0 < low <= high:
        raise InputError(f"sensor.counts={list(counts)}: expected two numbers of points above 0, the smaller first")


@dataclass(frozen=True)
class RandomPoints:
    """Depth at pixels chosen uniformly, as benchmarks on indoor sets have it; what is chosen is the truth.

    The density falls geometrically from 1 at difficulty 0 to the drawn number of points at difficulty 1, where each
    pixel is kept by chance, so numbers scatter by their root.

    Args:
        counts: Fewest and most points at difficulty 1; drawn log-uniformly for each sample.
    """

    counts: tuple[int, int] = (150, 2000)

    rig = Rig()

    def __post_init__(self) -> None:
        _check_counts(self.counts)

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """Sparse z-depth in metres, (B, 1, H, W); 0 where there is no point."""
        depth_m = frames["depth_m"]
        if difficulty == 0:
            return depth_m
        wanted = draw_counts(len(depth_m), self.counts, generator).to(depth_m.device)
        luck = torch.rand(depth_m.shape, generator=generator).to(depth_m.device)
        share = (wanted / (depth_m > 0).sum(dim=(1, 2, 3)).clamp(min=1)).clamp(max=1) ** difficulty
        return torch.where(luck < share[:, None, None, None], depth_m, 0)


@dataclass(frozen=True)
class FeaturePoints:
    """Depth at corners of the image, as visual-inertial odometry triangulates them.

    At difficulty 0 it reports the dense truth. In between, dense pixels survive with probability (1 - difficulty)^4
    beside the corners; at 1 there are corners only. Errors grow in proportion to the difficulty.

    Args:
        counts: Fewest and most corners; drawn log-uniformly for each sample.
        radius_px: Half the side of the window in which one corner suppresses the others.
        quality: Smallest response of a corner as a share of the image's largest.
        inverse_sigma_per_m: Standard deviation of inverse depth: at z metres, the depth's is z^2 times that.
        outlier_share: Share of mistracked points at difficulty 1.
        outlier_octaves: Their largest error at difficulty 1: depth is off by up to 2 to this power.
    """

    counts: tuple[int, int] = (150, 1500)
    radius_px: int = 3
    quality: float = 0.005
    inverse_sigma_per_m: float = 0.005
    outlier_share: float = 0.03
    outlier_octaves: float = 1.0

    rig = Rig()

    def __post_init__(self) -> None:
        _check_counts(self.counts)
        require_between(self, radius_px=(1, 100), quality=(0, 1), inverse_sigma_per_m=(0, 1), outlier_share=(0, 1))
        require_between(self, outlier_octaves=(0, 10))

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """Sparse, noisy z-depth in metres, (B, 1, H, W); 0 where there is no point."""
        truth_m = frames["depth_m"]
        if difficulty == 0:
            return truth_m
        count = draw_counts(len(truth_m), self.counts, generator).to(truth_m.device)
        places, found = strongest_corners(grey_of(frames), self.counts[1], self.radius_px, self.quality)
        chosen = found & (torch.arange(places.shape[1], device=places.device) < count[:, None])
        tracked_m = disturb_inverse_depth(
            truth_m.flatten(1).gather(1, places) * chosen,
            difficulty * self.inverse_sigma_per_m,
            difficulty * self.outlier_share,
            difficulty * self.outlier_octaves,
            generator,
        )
        survivors = torch.rand(truth_m.shape, generator=generator).to(truth_m.device) < (1 - difficulty) ** 4
        dense_m = (truth_m * survivors).flatten(1)
        reported_m = torch.where(chosen, tracked_m, dense_m.gather(1, places))
        return dense_m.scatter(1, places, reported_m).view_as(truth_m)
