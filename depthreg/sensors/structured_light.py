"""What a structured-light camera reports: Kinect v1 and its kin, which match a projected pattern of dots.

Sources: Barron & Malik, "Intrinsic scene properties from a single RGB-D image" (2013) and Handa et al., "A benchmark
for RGB-D visual odometry" (2014): shifted look-up, disparities in eighths of a pixel, a 9x9 window of dots that have to
agree; Nguyen et al., "Modeling Kinect sensor noise" (2012): axial and lateral noise; Khoshelham & Elberink (2012).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.rendering import Rig
from depthreg.sensors.checks import require_between
from depthreg.sensors.fields import blotches, correlated_noise
from depthreg.sensors.reflection import (
    angle_rad,
    highlight,
    incidence,
    infrared_albedo,
    matte_return,
    ray_stretch,
    view_rays,
)
from depthreg.sensors.windows import look_up

_DOT_SPACING_PX = 3  # the pattern lights about one pixel in nine
_MAX_LATERAL_PX = 4.0  # Nguyen's fit has a pole at grazing angles


def axial_sigma_m(depth_m: Tensor, angle: Tensor) -> Tensor:
    """Standard deviation of the depth, metres, by depth and angle of incidence (radians): Nguyen 2012, eq. 3 and 4.

    Measured on a real Kinect, so it holds the rounding of disparities too.
    """
    head_on = 0.0012 + 0.0019 * (depth_m - 0.4).square()
    grazing = 0.0001 / depth_m.clamp(min=0.1).sqrt() * (angle / (math.pi / 2 - angle)).square()
    return head_on + torch.where(angle > math.radians(60), grazing, 0)


def lateral_sigma_px(angle: Tensor) -> Tensor:
    """Standard deviation of an outline's place, pixels, by angle of incidence in radians: Nguyen 2012, eq. 2."""
    return (0.8 + 0.035 * angle / (math.pi / 2 - angle)).clamp(max=_MAX_LATERAL_PX)


def projector_shadow(depth_m: Tensor, focal_baseline: Tensor) -> Tensor:
    """Where a projector to the camera's right lights nothing, because something nearer is in between.

    A point at column x lies in the projector's column x - f b / z. It is dark where something further right in the
    image lies further left for the projector: a running minimum along the row. So shadows lie to the left of things.

    Args:
        depth_m: (B, 1, H, W), 0 where there is nothing.
        focal_baseline: f b in pixels times metres, (B, 1, 1, 1).

    Returns:
        bool (B, 1, H, W).
    """
    disparity_px = torch.where(depth_m > 0, focal_baseline / depth_m.clamp(min=1e-2), 0)
    at_projector = torch.arange(depth_m.shape[-1], device=depth_m.device) - disparity_px
    first_from_right = at_projector.flip(-1).cummin(dim=-1).values.flip(-1)
    return at_projector > first_from_right


def agreeing_share(disparity_px: Tensor, lit: Tensor, tolerance_px: float) -> Tensor:
    """Share of the nine dots in a 9x9 window that are lit and whose disparity is that of the window's middle.

    Args:
        disparity_px: (B, 1, H, W).
        lit: bool (B, 1, H, W); dots elsewhere don't count as agreeing.
        tolerance_px: Largest difference that counts as the same.

    Returns:
        (B, 1, H, W) in [0, 1].
    """
    height, width = disparity_px.shape[-2:]
    reach = _DOT_SPACING_PX
    dots = F.pad(torch.where(lit, disparity_px, torch.inf), [reach] * 4, value=torch.inf)
    agreeing = torch.zeros_like(disparity_px)
    for dy in (0, reach, 2 * reach):
        for dx in (0, reach, 2 * reach):
            agreeing += (dots[..., dy : dy + height, dx : dx + width] - disparity_px).abs() < tolerance_px
    return agreeing / 9


def quantise(disparity_px: Tensor, step_px: float) -> Tensor:
    """Disparities as whole multiples of a step, at least one."""
    return (disparity_px / step_px).round().clamp(min=1) * step_px


@dataclass(frozen=True)
class StructuredLight:
    """Depth of a camera beside a projector of infrared dots (Kinect v1).

    Noise, shadow, steps and thresholds grow in proportion to the difficulty; at 0 it reports the truth.
    Steps of depth and noise are those of the instrument's own focal length and baseline, whatever the frame's camera;
    the shadow and the 9x9 window live on the frame's pixels.

    Args:
        focal_px: Focal length of the instrument, pixels.
        baseline_m: From the camera to the projector on its right.
        step_px: Disparities are multiples of this.
        min_agreeing_share: Share of the dots in a window that have to agree, else there is a hole.
        agreeing_px: Difference of disparity up to which dots agree.
        min_signal: Weakest light that is matched, of a white wall's at 1 m.
        max_signal: Strongest light before dots melt together.
        unevenness: Standard deviation of the logarithm of the weakest light, in patches of `patch_px`.
        patch_px: Size of these patches.
        min_depth_m, far_depth_m: Nothing is reported outside.
        max_range_m: Scenes with a larger median depth are not meant for this sensor (see `Mix`).
    """

    focal_px: float = 580.0
    baseline_m: float = 0.075
    step_px: float = 0.125
    min_agreeing_share: float = 0.5
    agreeing_px: float = 1.0
    min_signal: float = 0.01
    max_signal: float = 12.0
    unevenness: float = 0.3
    patch_px: float = 14.0
    min_depth_m: float = 0.5
    far_depth_m: float = 10.0
    max_range_m: float = 4.5

    rig = Rig(surfaces=True)

    def __post_init__(self) -> None:
        positive = (1e-6, math.inf)
        require_between(self, focal_px=positive, baseline_m=positive, step_px=positive, agreeing_px=positive)
        require_between(self, min_agreeing_share=(0, 1), min_signal=(0, self.max_signal), max_signal=positive)
        require_between(self, unevenness=(0, 10), patch_px=(1, math.inf), min_depth_m=(0, self.far_depth_m))
        require_between(self, far_depth_m=positive, max_range_m=positive)

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where nothing was matched."""
        truth_m = frames["depth_m"]
        if difficulty == 0:
            return truth_m
        rays = view_rays(frames["intrinsics"], (truth_m.shape[-2], truth_m.shape[-1]))
        cos = incidence(frames["normal"], rays, ray_stretch(rays))
        angle = angle_rad(cos)
        disparity_px = torch.where(truth_m > 0, self._focal_baseline / truth_m.clamp(min=1e-2), 0)
        matched = self._matched(frames, disparity_px, cos, difficulty, generator)
        seen_px = torch.where(matched, disparity_px, 0)
        shift_px = blotches(torch.Size([len(cos), 2, *cos.shape[-2:]]), _DOT_SPACING_PX, generator, cos.device)
        beside_px = look_up(seen_px, difficulty * lateral_sigma_px(angle) * shift_px)
        # Lateral noise is that of outlines; on a slope, Nguyen's axial noise already holds what it does.
        seen_px = torch.where((beside_px - seen_px).abs() > self.agreeing_px, beside_px, seen_px)
        noise = correlated_noise(cos.shape, generator, cos.device)
        measured_px = seen_px + difficulty * noise * self._disparity_sigma_px(seen_px, angle)
        depth_m = self._focal_baseline / quantise(measured_px, difficulty * self.step_px)
        inside = (depth_m >= difficulty * self.min_depth_m) & (difficulty * depth_m <= self.far_depth_m)
        return torch.where((seen_px > 0) & inside, depth_m, 0)

    @property
    def _focal_baseline(self) -> float:
        return self.focal_px * self.baseline_m

    def _disparity_sigma_px(self, disparity_px: Tensor, angle: Tensor) -> Tensor:
        """What rounding leaves of Nguyen's noise to be added before it: rounding's own variance is step^2 / 12."""
        depth_m = self._focal_baseline / disparity_px.clamp(min=1e-2)
        sigma_px = axial_sigma_m(depth_m, angle) * self._focal_baseline / depth_m.square()
        return (sigma_px.square() - self.step_px**2 / 12).clamp(min=0).sqrt()

    def _matched(
        self,
        frames: FrameBatch,
        disparity_px: Tensor,
        cos: Tensor,
        difficulty: float,
        generator: torch.Generator | None,
    ) -> Tensor:
        """Where the pattern is lit, neither too weak nor too strong, and its window agrees, bool (B, 1, H, W)."""
        depth_m, gloss = frames["depth_m"], frames["gloss"]
        light = matte_return(infrared_albedo(frames["albedo"], generator), gloss, cos, depth_m)
        glare = light + highlight(gloss, cos, depth_m)
        uneven = (self.unevenness * blotches(cos.shape, self.patch_px, generator, cos.device)).exp()
        strong = (light > difficulty * self.min_signal * uneven) & (difficulty * glare < self.max_signal)
        focal_baseline = frames["intrinsics"][:, 0, 0, None, None, None] * difficulty * self.baseline_m
        lit = (depth_m > 0) & ~projector_shadow(depth_m, focal_baseline)
        agreeing = agreeing_share(disparity_px, lit, self.agreeing_px / difficulty)
        return lit & strong & (agreeing >= difficulty * self.min_agreeing_share)
