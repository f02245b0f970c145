"""Depth from a stereo pair, passive or lit by a dot projector: what the matcher answered to the rendered images."""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.rendering import Rig
from depthreg.sensors.matching import StereoMatcher


def invert(scale: Tensor, values: Tensor) -> Tensor:
    """scale / values, and 0 where the values aren't positive: depth from disparity, and disparity from depth."""
    positive = values > 0
    return torch.where(positive, scale / torch.where(positive, values, 1), 0)


def smooth_uniform(batch: int, size: tuple[int, int], cell: float, generator: torch.Generator | None = None) -> Tensor:
    """Smooth random images whose pixels spread evenly over [0, 1], (B, 1, H, W): thresholds that make patches grow.

    Args:
        batch, size: B, and H and W.
        cell: Size of a patch as a share of the image's height.
        generator: Draws them.
    """
    cell_px = max(1.0, cell * size[0])
    coarse = torch.randn(batch, 1, *(int(side / cell_px) + 2 for side in size), generator=generator)
    smooth = F.interpolate(coarse, size, mode="bicubic", align_corners=True)
    # Interpolation averages, which takes away some of the unit variance that makes ndtr (the normal CDF) even.
    smooth = smooth / smooth.square().mean(dim=(-2, -1), keepdim=True).sqrt().clamp(min=1e-6)
    return torch.special.ndtr(smooth)


@dataclass(frozen=True)
class Stereo:
    """Depth from a matched pair, whose errors and holes grow with the difficulty.

    At difficulty d the error of the disparity is d times the matcher's; the regions without an answer open up patch by
    patch, and truth stands in those that are still closed. At 1 it is the matcher's answer: focal length * baseline /
    disparity.

    Args:
        matcher: Finds disparities in the rendered pair, while frames are loaded.
        max_range_m: A depth beyond this counts as no answer.
        patch: Size of the patches by which holes open, as a share of the image's height.
    """

    matcher: StereoMatcher = field(default_factory=StereoMatcher)
    max_range_m: float = 80.0
    patch: float = 0.1

    def __post_init__(self) -> None:
        if not (self.max_range_m > 0 and self.patch > 0):
            raise InputError(f"max_range_m and patch must be positive, got {self.max_range_m} and {self.patch}")

    @property
    def rig(self) -> Rig:
        """A stereo pair, matched."""
        return Rig(matchers=(self.matcher,))

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where there is no answer.

        Raises:
            InputError: The frames weren't rendered with a matched pair.
        """
        if "disparity_px" not in frames:
            raise InputError("frames hold no disparity_px: render them with this sensor's rig (a matched stereo pair)")
        truth_m, matched_px = frames["depth_m"], frames["disparity_px"]
        if difficulty == 0:
            return truth_m
        reach = (frames["intrinsics"][:, 0, 0] * frames["baseline_m"])[:, None, None, None]  # px m
        answered = matched_px * self.max_range_m >= reach
        disparity_px = torch.lerp(invert(reach, truth_m), matched_px, difficulty)  # the sky's true disparity is 0
        measured_m = invert(reach, disparity_px)
        # What the matcher makes of the sky comes nearer as the error grows.
        measured_m = torch.where((truth_m > 0) | (measured_m <= self.max_range_m), measured_m, 0)
        size = (truth_m.shape[-2], truth_m.shape[-1])
        open_ = smooth_uniform(len(truth_m), size, self.patch, generator).to(truth_m.device) <= difficulty
        return torch.where(answered, measured_m, truth_m.masked_fill(open_, 0))
