"""Fog, rain and night, on pictures in linear light of scenes whose depth is known.

Fog dims each point and adds airlight by Koschmieder's law; the visibility is the distance at which 5 % of a contrast is
left (WMO's meteorological optical range). Rain does the same more weakly, and the drops close to the camera leave
streaks (`rain.py`). At night a blue remainder of the daylight is left, and headlights, which fade with the square of
the distance.
"""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from depthreg.data.sample import Measurement
from depthreg.errors import InputError
from depthreg.geometry import affine_places, invert_affine, samples_at
from depthreg.sensors.color import GAMMA, change_some, sensor_noise
from depthreg.sensors.mix import median_depth_m
from depthreg.sensors.rain import draw_streaks, rain_extinction_per_m, random_streaks
from depthreg.sensors.reflection import ray_stretch, view_rays

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
    places_px = affine_places(invert_affine(affine_rgb_from_depth), (height, width))
    last = places_px.new_tensor([width - 1, height - 1])
    moved = samples_at(inverse, places_px.minimum(last).clamp(min=0))
    return ray_stretch(view_rays(intrinsics, (height, width))) / moved.clamp(min=1 / _FARTHEST_M)


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


def lose_returns(
    depth_m: Tensor, intrinsics: Tensor, extinction_per_m: Tensor, generator: torch.Generator | None = None
) -> Tensor:
    """What a scanner still measures through fog or rain, (B, 1, H, W) metres.

    Its light has to go there and back. Drops being far larger than its wavelength, they dim it as they dim what we see
    (Kim et al., SPIE 4214, 2001: no dependence on the wavelength below 500 m of visibility).

    Args:
        depth_m: Returns in clear air, (B, 1, H, W).
        intrinsics: K (B, 3, 3).
        extinction_per_m: (B,).
        generator: Source of randomness, on the CPU.
    """
    range_m = depth_m * ray_stretch(view_rays(intrinsics, (depth_m.shape[-2], depth_m.shape[-1])))
    luck = torch.rand(depth_m.shape, generator=generator).to(depth_m.device)
    return depth_m * (luck < torch.exp(-2 * extinction_per_m[:, None, None, None] * range_m))


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


class Sky(NamedTuple):
    """The weather of each sample, (B,) on the CPU."""

    extinction_per_m: Tensor  # of fog or rain; 0 in clear air
    airlight: Tensor  # brightness of fog, in linear light
    rain_mm_h: Tensor  # 0 = dry
    daylight: Tensor  # share that is left; 1 = day

    def outside(self, outdoors: Tensor) -> "Sky":
        """The same weather where `outdoors` (B,), and a clear day elsewhere."""
        return Sky(
            extinction_per_m=self.extinction_per_m * outdoors,
            airlight=self.airlight,
            rain_mm_h=self.rain_mm_h * outdoors,
            daylight=torch.where(outdoors, self.daylight, 1),
        )


@dataclass(frozen=True)
class Weather:
    """Fog, rain or night on some samples: more of them, and worse, as difficulty grows; at 0 it is a clear day.

    Args:
        fog_share, rain_share, night_share: Share of samples at difficulty 1; together at most 1.
        min_visibility_m: In the densest fog.
        max_rain_mm_h: In the heaviest rain.
        airlight: Brightness of fog, least and most, in linear light; 1 = white.
        exposure_s: Of the camera in rain: the longer, the longer and fainter the streaks.
        min_daylight: Share of daylight left in the darkest night, after the camera has adapted.
        headlight_m: Distance at which headlights replace daylight in full.
        full_well_e: Electrons of a white pixel by day.
        read_noise_e: Electrons.
        indoors_below_m: A scene of a smaller median depth is a room, which has no weather.

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
    full_well_e: float = 10_000.0
    read_noise_e: float = 4.0
    indoors_below_m: float = 6.0

    def __post_init__(self) -> None:
        shares = (self.fog_share, self.rain_share, self.night_share)
        if not all(share >= 0 for share in shares) or sum(shares) > 1:
            raise InputError(f"weather: expected shares of at least 0 and together at most 1, got {shares}")
        air = self.min_visibility_m, self.max_rain_mm_h, self.exposure_s, self.indoors_below_m
        dark = self.min_daylight, self.headlight_m, self.full_well_e, self.read_noise_e
        low, high = self.airlight
        if not all(limit > 0 for limit in (*air, *dark)) or self.min_daylight > 1 or not 0 <= low <= high <= 1:
            raise InputError(
                "weather: expected limits above 0, min_daylight up to 1 and airlight as two numbers from 0 to 1, "
                f"the smaller first, got {self}"
            )

    def draw(self, batch: int, difficulty: float, generator: torch.Generator | None = None) -> Sky:
        """Some weather for each sample: fog, rain, night or none of them."""
        luck, severity, bright = torch.rand(3, batch, generator=generator)
        edges = difficulty * torch.tensor([0.0, self.fog_share, self.rain_share, self.night_share]).cumsum(0)
        kinds = [(luck >= low) & (luck < high) for low, high in itertools.pairwise(edges)]
        fog, rain, dark = (kind * difficulty * severity for kind in kinds)
        rain_mm_h = rain * self.max_rain_mm_h
        low, high = self.airlight
        return Sky(
            extinction_per_m=fog * fog_extinction_per_m(self.min_visibility_m) + rain_extinction_per_m(rain_mm_h),
            airlight=low + (high - low) * bright,
            rain_mm_h=rain_mm_h,
            daylight=self.min_daylight**dark,  # each step of severity takes the same share away
        )

    def __call__(
        self,
        measurement: Measurement,
        difficulty: float,
        generator: torch.Generator | None = None,
        scanned: bool = False,
    ) -> Measurement:
        """The same measurement in some weather.

        Args:
            measurement: Of a clear day, with the truth.
            difficulty: In [0, 1].
            generator: Source of randomness, on the CPU.
            scanned: Whether the depth was measured with light of the sensor's own, which fog swallows.
        """
        if difficulty == 0:
            return measurement
        rgb = measurement["rgb"]
        outdoors = median_depth_m(measurement["truth_depth_m"]).cpu() >= self.indoors_below_m
        sky = self.draw(len(rgb), difficulty, generator).outside(outdoors)
        out = Measurement(**measurement)
        out["rgb"] = change_some(rgb, sky.extinction_per_m, lambda i: self._through_air(measurement, sky, i, generator))
        out["rgb"] = change_some(out["rgb"], 1 - sky.daylight, lambda i: self._at_night(measurement, sky, i, generator))
        if scanned:
            depth_m, intrinsics = measurement["depth_m"], measurement["intrinsics"]
            extinction_per_m = sky.extinction_per_m.to(rgb.device)
            out["depth_m"] = change_some(
                depth_m,
                sky.extinction_per_m,
                lambda i: lose_returns(depth_m[i], intrinsics[i], extinction_per_m[i], generator),
            )
        return out

    def _through_air(
        self, measurement: Measurement, sky: Sky, chosen: Tensor, generator: torch.Generator | None
    ) -> Tensor:
        """The pictures of the chosen samples (K,) in fog or rain."""
        linear, range_m, intrinsics = _seen(measurement, chosen)
        extinction_per_m, airlight, rain_mm_h, _ = (values[chosen].to(linear.device) for values in sky)
        hazy = haze(overcast(linear, extinction_per_m, airlight), range_m, extinction_per_m, airlight)
        wet = change_some(
            hazy,
            sky.rain_mm_h[chosen],
            lambda i: self._behind_streaks(hazy[i], intrinsics[i], rain_mm_h[i], airlight[i], generator),
        )
        return wet ** (1 / GAMMA)

    def _behind_streaks(
        self,
        linear: Tensor,
        intrinsics: Tensor,
        rain_mm_h: Tensor,
        airlight: Tensor,
        generator: torch.Generator | None,
    ) -> Tensor:
        size = (linear.shape[-2], linear.shape[-1])
        slant = (torch.rand(len(linear), generator=generator) - 0.5).to(linear.device)
        streaks = random_streaks(rain_mm_h, intrinsics, size, self.exposure_s, generator)
        points = math.ceil(_FASTEST_DROP_M_S * self.exposure_s * size[1])  # 1 m away, where the view is 1 m wide
        cover = draw_streaks(streaks, slant, size, points)
        # A drop refracts light from all over the scene, sky included, whatever lies behind it.
        return (1 - cover) * linear + cover * airlight[:, None, None, None]

    def _at_night(
        self, measurement: Measurement, sky: Sky, chosen: Tensor, generator: torch.Generator | None
    ) -> Tensor:
        """The pictures of the chosen samples (K,) after dusk, with the noise of a sensor that has less light."""
        linear, range_m, intrinsics = _seen(measurement, chosen)
        daylight = sky.daylight[chosen].to(linear.device)
        directions = view_rays(intrinsics, (linear.shape[-2], linear.shape[-1]))
        dark = night(linear, range_m, directions, daylight, self.headlight_m)
        noisy = sensor_noise(dark, self.full_well_e * daylight, self.read_noise_e, generator)
        return noisy.clamp(0, 1) ** (1 / GAMMA)


def _seen(measurement: Measurement, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The chosen samples (K,): linear light (K, 3, H, W), how far away it comes from (K, 1, H, W), and K (K, 3, 3)."""
    intrinsics = measurement["intrinsics"][chosen]
    affine = measurement["truth_affine_rgb_from_depth"][chosen]
    range_m = range_in_view(measurement["truth_depth_m"][chosen], affine, intrinsics)
    return measurement["rgb"][chosen] ** GAMMA, range_m, intrinsics
