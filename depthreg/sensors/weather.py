"""Fog, rain and night, on pictures in linear light of scenes whose depth is known.

Fog dims each point and adds airlight by Koschmieder's law; the visibility is the distance at which 5 % of a contrast is
left (WMO's meteorological optical range). Rain does the same more weakly, and the drops close to the camera leave
streaks (`rain.py`). At night a blue remainder of the daylight is left, and headlights, which fade with the square of
the distance.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from depthreg.data.sample import Measurement
from depthreg.errors import InputError
from depthreg.geometry import invert_affine, pixel_grid, sample_at, transform_points, unproject
from depthreg.sensors.rain import draw_streaks, rain_extinction_per_m, random_streaks

_FARTHEST_M = 1000.0  # what has no depth, sky mostly, counts as so far away
_FOG_LAYER_M = 100.0
_FASTEST_DROP_M_S = 10.0
_NIGHT_TINT = (0.6, 0.8, 1.3)  # what is left of daylight after dusk is blue


def range_in_view(depth_m: Tensor, affine_rgb_from_depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Distance of what each pixel of the colour shows, (B, 1, H, W) metres.

    Inverse depths are moved, because they blend at edges and are 0 in the sky. Beyond the depth's borders its last
    pixels go on.

    Args:
        depth_m: Dense z-depth (B, 1, H, W), 0 = sky.
        affine_rgb_from_depth: A (B, 2, 3).
        intrinsics: K (B, 3, 3).
    """
    height, width = depth_m.shape[-2:]
    inverse = torch.where(depth_m > 0, 1 / depth_m.clamp(min=1e-3), 0)
    grid = pixel_grid(height, width, device=depth_m.device, dtype=depth_m.dtype).reshape(1, -1, 2)
    places_px = transform_points(invert_affine(affine_rgb_from_depth), grid.expand(len(depth_m), -1, -1))
    last = places_px.new_tensor([width - 1, height - 1])
    places_px = places_px.minimum(last).clamp(min=0).unflatten(1, (height, width))
    moved, _ = sample_at(inverse, places_px)
    return rays(intrinsics, (height, width)).norm(dim=1, keepdim=True) / moved.clamp(min=1 / _FARTHEST_M)


def change_some(images: Tensor, drawn: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Images (B, ...) of which some are changed.

    Args:
        images: Left as they are.
        drawn: (B,) on the CPU, so that no device is waited for; not 0 for those to change.
        change: Makes the changed images from their numbers (K,) in the batch, which are on the CPU too.
    """
    chosen = drawn.nonzero().flatten()
    return images.index_copy(0, chosen.to(images.device), change(chosen)) if len(chosen) else images


def rays(intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Directions through the pixels, (B, 3, H, W), z = 1."""
    return unproject(intrinsics.new_ones(len(intrinsics), *size), intrinsics).permute(0, 3, 1, 2)


def haze(linear: Tensor, range_m: Tensor, extinction_per_m: Tensor, airlight: Tensor) -> Tensor:
    """Koschmieder's law: light fades as exp(-extinction * range), and airlight takes its place.

    Args:
        linear: (B, 3, H, W) in linear light.
        range_m: (B, 1, H, W).
        extinction_per_m: (B,).
        airlight: Brightness of endless fog, (B,) in linear light.
    """
    passed = torch.exp(-extinction_per_m[:, None, None, None] * range_m)
    return passed * linear + (1 - passed) * airlight[:, None, None, None]


def overcast(linear: Tensor, extinction_per_m: Tensor, airlight: Tensor) -> Tensor:
    """Highlights dimmed as where fog lies between the sun and the scene: diffuse light makes nothing brighter than fog.

    Without this, sky that the renderer's exposure has clipped would shine through the edges of leaves.

    Args:
        linear: (B, 3, H, W) in linear light.
        extinction_per_m: (B,); what passes a layer of 100 m still makes highlights.
        airlight: (B,) in linear light.
    """
    sunny = torch.exp(-extinction_per_m * _FOG_LAYER_M)
    return linear.minimum((airlight + sunny * (1 - airlight))[:, None, None, None])


def fog_extinction_per_m(visibility_m: float) -> float:
    """Extinction of fog in which 5 % of a contrast is left at `visibility_m`."""
    return math.log(20) / visibility_m


def night(linear: Tensor, range_m: Tensor, directions: Tensor, daylight: Tensor, headlight_m: float) -> Tensor:
    """The scene with less daylight, lit by a car's low beam.

    Args:
        linear: By day, (B, 3, H, W) in linear light.
        range_m: (B, 1, H, W).
        directions: Of the pixels, (B, 3, H, W), z = 1, y down.
        daylight: Share that is left, (B,), 1 = day.
        headlight_m: Distance at which headlights are as bright as a full day; they fade with its square.
    """
    x, y = directions[:, :1], directions[:, 1:2]
    below_cutoff = 0.1 + 0.9 * torch.sigmoid((y + 0.01) / 0.02)  # low beam leaves what is above the horizon dark
    beam = below_cutoff * torch.exp(-0.5 * (x / 0.45) ** 2) * (headlight_m / range_m).square().clamp(max=1)
    left = daylight[:, None, None, None]
    tint = 1 + (1 - left) * (linear.new_tensor(_NIGHT_TINT)[:, None, None] - 1)
    return linear * (left * tint + (1 - left) * beam)


@dataclass(frozen=True)
class Weather:
    """Fog, rain or night on some samples: more of them, and worse, as difficulty grows.

    Args:
        fog_share, rain_share, night_share: Share of samples at difficulty 1; together at most 1.
        min_visibility_m: In the densest fog.
        max_rain_mm_h: In the heaviest rain.
        airlight: Brightness of fog, least and most, in linear light; 1 = white.
        exposure_s: Of the camera in rain: the longer, the longer and fainter the streaks.
        min_daylight: Share of daylight left in the darkest night, after the camera has adapted.
        headlight_m: Distance at which headlights replace daylight in full.

    Raises:
        InputError: A share or a limit can't be meant.
    """

    fog_share: float = 0.15
    rain_share: float = 0.15
    night_share: float = 0.15
    min_visibility_m: float = 50.0
    max_rain_mm_h: float = 100.0
    airlight: tuple[float, float] = (0.35, 0.8)
    exposure_s: float = 0.003
    min_daylight: float = 0.02
    headlight_m: float = 8.0

    def __post_init__(self) -> None:
        shares = (self.fog_share, self.rain_share, self.night_share)
        if not all(share >= 0 for share in shares) or sum(shares) > 1:
            raise InputError(f"weather: expected shares of at least 0 and together at most 1, got {shares}")
        limits = (self.min_visibility_m, self.max_rain_mm_h, self.exposure_s, self.headlight_m, self.min_daylight)
        low, high = self.airlight
        if not all(limit > 0 for limit in limits) or self.min_daylight > 1 or not 0 <= low <= high <= 1:
            raise InputError(
                "weather: expected limits above 0, min_daylight up to 1 and airlight as two numbers from 0 to 1, "
                f"the smaller first, got {self}"
            )

    def __call__(
        self, linear: Tensor, measurement: Measurement, difficulty: float, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """The scene in its weather.

        Args:
            linear: The measurement's picture in linear light, (B, 3, H, W).
            measurement: With the truth.
            difficulty: In [0, 1].
            generator: Source of randomness, on the CPU.

        Returns:
            Linear light (B, 3, H, W), and the share of daylight that is left, (B,) on the CPU; 1 = day.
        """
        luck, severity = torch.rand(2, len(linear), generator=generator)
        edges = difficulty * torch.tensor([0.0, self.fog_share, self.rain_share, self.night_share]).cumsum(0)
        kinds = [(luck >= low) & (luck < high) for low, high in itertools.pairwise(edges)]
        foggy, rainy, dark = (kind * difficulty * severity for kind in kinds)

        def seen(chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            depth_m, intrinsics = measurement["truth_depth_m"][chosen], measurement["intrinsics"][chosen]
            affine = measurement["truth_affine_rgb_from_depth"][chosen]
            return linear[chosen], range_in_view(depth_m, affine, intrinsics), intrinsics

        out = change_some(linear, foggy, lambda i: self._fog(*seen(i)[:2], foggy[i].to(linear.device), generator))
        out = change_some(out, rainy, lambda i: self._rain(*seen(i), rainy[i].to(linear.device), generator))
        daylight = self.min_daylight**dark  # each step of severity takes the same share away
        return change_some(out, dark, lambda i: self._night(*seen(i), daylight[i].to(linear.device))), daylight

    def _fog(self, linear: Tensor, range_m: Tensor, severity: Tensor, generator: torch.Generator | None) -> Tensor:
        extinction_per_m = severity * fog_extinction_per_m(self.min_visibility_m)
        airlight = self._airlight(linear, generator)
        return haze(overcast(linear, extinction_per_m, airlight), range_m, extinction_per_m, airlight)

    def _rain(
        self,
        linear: Tensor,
        range_m: Tensor,
        intrinsics: Tensor,
        severity: Tensor,
        generator: torch.Generator | None,
    ) -> Tensor:
        size, rate_mm_h = (linear.shape[-2], linear.shape[-1]), severity * self.max_rain_mm_h
        airlight = self._airlight(linear, generator)
        slant = (torch.rand(len(linear), generator=generator) - 0.5).to(linear.device)
        streaks = random_streaks(rate_mm_h, intrinsics, size, self.exposure_s, generator)
        points = math.ceil(_FASTEST_DROP_M_S * self.exposure_s * size[1])  # 1 m away, where the view is 1 m wide
        cover = draw_streaks(streaks, slant, size, points)
        extinction_per_m = rain_extinction_per_m(rate_mm_h)
        hazy = haze(overcast(linear, extinction_per_m, airlight), range_m, extinction_per_m, airlight)
        # A drop refracts light from all over the scene, sky included, whatever lies behind it.
        return (1 - cover) * hazy + cover * airlight[:, None, None, None]

    def _night(self, linear: Tensor, range_m: Tensor, intrinsics: Tensor, daylight: Tensor) -> Tensor:
        directions = rays(intrinsics, (linear.shape[-2], linear.shape[-1]))
        return night(linear, range_m, directions, daylight, self.headlight_m)

    def _airlight(self, linear: Tensor, generator: torch.Generator | None) -> Tensor:
        low, high = self.airlight
        return (low + (high - low) * torch.rand(len(linear), generator=generator)).to(linear.device)
