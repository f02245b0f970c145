"""What a continuous-wave time-of-flight camera reports: the phase of modulated light that comes back.

Light is a phasor, amplitude times exp(i phase), at each modulation frequency; what reaches one pixel over several ways
adds up. Flying pixels, multipath and phase noise follow from that. Sources: Lange & Seitz, "Solid-state time-of-flight
range camera" (2001): phase noise; Lindner & Kolb (2006): the cyclic error; Kinect Azure's rules for holes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.rendering import Rig
from depthreg.sensors.checks import require_between
from depthreg.sensors.multipath import LIGHT_SPEED_M_PER_S, indirect_light, radians_per_m
from depthreg.sensors.reflection import (
    highlight,
    incidence,
    infrared_albedo,
    matte_return,
    ray_stretch,
    view_rays,
)
from depthreg.sensors.windows import average_returns, local_step_m, mix_neighbours


def unambiguous_range_m(frequencies_mhz: Sequence[int]) -> float:
    """Range at which the phases start again together: c / (2 f), f the greatest common divisor."""
    return LIGHT_SPEED_M_PER_S / (2e6 * math.gcd(*frequencies_mhz))


def range_sigma_m(amplitude: Tensor, sigma_at_1m: float, ambient: float) -> Tensor:
    """Standard deviation of the range by amplitude: photon noise, Lange & Seitz 2001, eq. 11.

    Proportional to sqrt(light) / amplitude, where the light is the lamp's and the surroundings': to
    1 / sqrt(amplitude) in the dark.

    Args:
        amplitude: Relative to a white wall's at 1 m.
        sigma_at_1m: Of a white wall at 1 m in the dark, metres.
        ambient: Light of the surroundings, in the same units as the amplitude.
    """
    return sigma_at_1m * (amplitude + ambient).sqrt() / amplitude.clamp(min=1e-6)


def phasors(range_m: Tensor, amplitude: Tensor, frequencies_mhz: Sequence[float]) -> Tensor:
    """Real and imaginary parts of light that went to `range_m` and back, (B, 2K, H, W); both inputs (B, 1, H, W)."""
    phases = [radians_per_m(frequency) * range_m for frequency in frequencies_mhz]
    return torch.cat([amplitude * part for phase in phases for part in (phase.cos(), phase.sin())], dim=1)


def rotate(indirect: Tensor, direct: Tensor, amplitude: Tensor) -> Tensor:
    """`indirect` phasors, relative to the phase of `direct`, on the same scale as it; both (B, 2K, H, W).

    Args:
        indirect: Relative to the direct light's phase.
        direct: Amplitude times exp(i phase).
        amplitude: Of the direct light, (B, 1, H, W).
    """
    unit = direct / amplitude.clamp(min=1e-9)
    real, imaginary = indirect[:, 0::2], indirect[:, 1::2]
    cos, sin = unit[:, 0::2], unit[:, 1::2]
    return torch.stack([real * cos - imaginary * sin, real * sin + imaginary * cos], dim=2).flatten(1, 2)


def unwrap(phases: Sequence[Tensor], frequencies_mhz: Sequence[int]) -> Tensor:
    """Range of one or two phases in [0, 2 pi), metres, in [0, unambiguous range).

    The last frequency gives the range; of its possible numbers of whole turns, the one is taken that the first
    frequency's phase agrees with best.
    """
    turn_m = [2 * math.pi / radians_per_m(frequency) for frequency in frequencies_mhz]
    first_m, fine_m = (
        phase * turn / (2 * math.pi)
        for phase, turn in zip((phases[0], phases[-1]), (turn_m[0], turn_m[-1]), strict=True)
    )
    best_m, best_error_m = fine_m, torch.full_like(fine_m, torch.inf)
    for turns in range(round(unambiguous_range_m(frequencies_mhz) / turn_m[-1])):
        candidate_m = fine_m + turns * turn_m[-1]
        # Distance to the nearest of the first frequency's possible ranges.
        error_m = ((candidate_m - first_m) / turn_m[0] + 0.5).remainder(1).sub(0.5).abs()
        best_m = torch.where(error_m < best_error_m, candidate_m, best_m)
        best_error_m = torch.minimum(error_m, best_error_m)
    return best_m


@dataclass(frozen=True)
class Tof:
    """Depth of a continuous-wave time-of-flight camera.

    Noise, mixing, wiggling, multipath and thresholds grow in proportion to the difficulty; at 0 it reports the truth.

    Args:
        frequencies_mhz: One modulation frequency, or two that together reach further.
        sigma_at_1m: Standard deviation of the range on a white wall at 1 m, metres.
        ambient: Light of the surroundings relative to the lamp's on that wall.
        mixing: Share of a pixel's light that comes from each neighbour along an axis: flying pixels at edges.
        wiggle_m: Amplitude of the cyclic error, whose period is a quarter of one frequency's unambiguous range.
        multipath: One-bounce light relative to Lambert's law; 0 turns it off.
        patches: How many patches light each other.
        min_amplitude, max_amplitude: Weakest and strongest light of a return, of a white wall's at 1 m.
        min_albedo: Darker surfaces give no return: 15 of 255 grey levels in models of Kinect Azure.
        max_step_m: Largest step within 3x3 pixels; at larger ones there are holes (Kinect Azure: 0.8 m).
        wrap_share: Share of the samples in which things beyond the unambiguous range come back too near.
        resolution_share: Width and height of the instrument's image as a share of the frame's.
        filter_passes: How often the instrument averages its depth over 3x3 pixels, across edges too, as telephones do.
        max_range_m: Scenes with a larger median depth are not meant for this sensor (see `Mix`).
    """

    frequencies_mhz: Sequence[int] = (80, 100)
    sigma_at_1m: float = 0.001
    ambient: float = 0.05
    mixing: float = 0.2
    wiggle_m: float = 0.004
    multipath: float = 1.0
    patches: int = 400
    min_amplitude: float = 0.008
    max_amplitude: float = 12.0
    min_albedo: float = 15 / 255
    max_step_m: float = 0.8
    wrap_share: float = 0.5
    resolution_share: float = 1.0
    filter_passes: int = 0
    max_range_m: float = 6.0

    rig = Rig(surfaces=True)

    def __post_init__(self) -> None:
        frequencies = list(self.frequencies_mhz)
        if len(frequencies) not in (1, 2) or any(not isinstance(f, int) or f <= 0 for f in frequencies):
            raise InputError(f"sensor.frequencies_mhz={frequencies}: expected one or two whole numbers above 0")
        positive, share = (1e-6, math.inf), (0, 1)
        require_between(self, sigma_at_1m=(0, 1), ambient=(0, math.inf), mixing=(0, 1 / 3), wiggle_m=(0, 1))
        require_between(self, multipath=(0, 10), patches=(1, 4096), min_albedo=share, wrap_share=share)
        require_between(self, min_amplitude=(0, self.max_amplitude), max_amplitude=positive, max_step_m=positive)
        require_between(self, resolution_share=(0.01, 1), filter_passes=(0, 9), max_range_m=positive)

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where there is no return."""
        truth_m = frames["depth_m"]
        if difficulty == 0:
            return truth_m
        height, width = truth_m.shape[-2:]
        share = 1 - difficulty * (1 - self.resolution_share)
        size = (max(1, round(share * height)), max(1, round(share * width)))
        rays = view_rays(frames["intrinsics"], (height, width))
        stretch = ray_stretch(rays)
        albedo = infrared_albedo(frames["albedo"], generator)
        light, glare = self._light(frames, rays, stretch, albedo, difficulty)
        if size != (height, width):
            light = F.adaptive_avg_pool2d(light, size)
            stretch, albedo, glare, truth_m = (
                F.interpolate(image, size=size, mode="nearest-exact") for image in (stretch, albedo, glare, truth_m)
            )
        amplitude = torch.hypot(light[:, -2, None], light[:, -1, None])
        measured_m = self._ranges(light, amplitude, truth_m * stretch, difficulty, generator) / stretch
        weak = (amplitude < difficulty * self.min_amplitude) | (albedo < difficulty * self.min_albedo)
        strong = difficulty * (amplitude + glare) > self.max_amplitude
        torn = difficulty * local_step_m(measured_m) > self.max_step_m
        reported_m = measured_m.masked_fill(weak | strong | torn | (truth_m == 0), 0).clamp(min=0)
        for _ in range(self.filter_passes):
            reported_m = average_returns(reported_m, difficulty / 3)
        return F.interpolate(reported_m, size=(height, width), mode="nearest-exact")

    def _light(
        self, frames: FrameBatch, rays: Tensor, stretch: Tensor, albedo: Tensor, difficulty: float
    ) -> tuple[Tensor, Tensor]:
        """Phasors that each pixel receives (B, 2K, H, W), and the strength of highlights (B, 1, H, W)."""
        range_m, gloss = frames["depth_m"] * stretch, frames["gloss"]
        cos = incidence(frames["normal"], rays, stretch)
        amplitude = matte_return(albedo, gloss, cos, range_m)
        light = phasors(range_m, amplitude, self.frequencies_mhz)
        if self.multipath:
            points_m, focal_px = rays * frames["depth_m"], frames["intrinsics"][:, 0, 0]
            bounced = indirect_light(points_m, frames["normal"], albedo, focal_px, self.frequencies_mhz, self.patches)
            light = light + rotate(bounced, light, amplitude) * (difficulty * self.multipath * albedo)
        return mix_neighbours(light, difficulty * self.mixing), highlight(gloss, cos, range_m)

    def _ranges(
        self, light: Tensor, amplitude: Tensor, truth_m: Tensor, difficulty: float, generator: torch.Generator | None
    ) -> Tensor:
        """Ranges of phasors, with noise, wiggling and wrapping, (B, 1, H, W) metres."""
        batch, device = len(light), light.device
        sigma_m = difficulty * range_sigma_m(amplitude, self.sigma_at_1m, self.ambient)
        start, luck = torch.rand(2, batch, 1, 1, 1, generator=generator).to(device)
        phases = []
        for k, frequency in enumerate(self.frequencies_mhz):
            phase = torch.atan2(light[:, 2 * k + 1, None], light[:, 2 * k, None])
            noise_m = sigma_m * torch.randn(amplitude.shape, generator=generator).to(device)
            wiggle_m = difficulty * self.wiggle_m * torch.sin(4 * phase + 2 * math.pi * start)
            phases.append((phase + radians_per_m(frequency) * (noise_m + wiggle_m)).remainder(2 * math.pi))
        wrapped_m, reach_m = unwrap(phases, self.frequencies_mhz), unambiguous_range_m(self.frequencies_mhz)
        # An easier instrument knows how many whole turns are missing.
        turns = ((truth_m - wrapped_m) / reach_m).round() * (luck >= difficulty * self.wrap_share)
        return wrapped_m + turns * reach_m
