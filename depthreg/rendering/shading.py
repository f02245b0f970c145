"""From what a ray hits to the colour that a camera records. Light is linear until `develop`."""

import cv2
import numpy as np

from depthreg.rendering.surfaces import Hits, Surfaces
from depthreg.worlds.scene import RGB, Light
from depthreg.worlds.textures import TEXELS, TILE, texture_start

_GAMMA = 2.2
_TONES = 4096
_TONE_CURVE = np.rint(255 * np.linspace(0, 1, _TONES) ** (1 / _GAMMA)).astype(np.uint8)
_LENS_BLUR_PX = 0.5  # sigma of a decent lens; without it edges look cut out with scissors


def _column(rgb: RGB) -> np.ndarray:
    return np.array(rgb, dtype=np.float32)[:, None]


def sky(light: Light, rays: np.ndarray) -> np.ndarray:
    """Colour (3, N) of the sky in unit directions (3, N): a gradient, and clouds on a flat layer."""
    up = rays[2].clip(0, 1)
    horizon, zenith = _column(light.sky_horizon_rgb), _column(light.sky_zenith_rgb)
    clear = horizon + np.sqrt(up) * (zenith - horizon)
    column, row = np.floor(rays[:2] / (up + 0.12) * (0.25 * TILE)).astype(np.int32) & (TILE - 1)
    thickness, brightness = TEXELS.take(texture_start("clouds") + row * TILE + column, axis=0)[:, :2].T * np.float32(
        1 / 255
    )
    cloud = (3 * (thickness + light.cloud_cover - 0.8)).clip(0, 1) * (4 * up).clip(0, 1)
    white = 2 * brightness * (0.2 * horizon + 0.8 * horizon.max())
    return clear + cloud * (white - clear)


def _mirrored(light: Light, hits: Hits, sunlight: np.ndarray) -> np.ndarray:
    """Colour (3, M) seen in perfectly polished surfaces: sky, the dark street below it, the sun's highlight."""
    away = hits.direction + 2 * hits.cos_incidence * hits.normal
    # Houses and trees stand round every street, so the sky only begins some way up.
    open_sky = (3 * away[2] - 0.2).clip(0, 1)
    around = 0.25 * _column(light.ambient_rgb)
    glint = 20 * (light.sun_direction.astype(np.float32) @ away).clip(0.7) ** 200 * (sunlight > 0)
    return around + open_sky * (sky(light, away) - around) + glint * _column(light.sun_rgb)


def shade(surfaces: Surfaces, light: Light, hits: Hits, albedo: np.ndarray, gloss: np.ndarray) -> np.ndarray:
    """Colour (3, M) of surfaces of some albedo (3, M) and gloss (M,) that camera rays hit: sun, sky, polish and fog."""
    sunlight = surfaces.sunlight(hits, light)
    # The sky lights what faces up in full; the ground reflects half of it to what faces down.
    ambient = 0.75 + 0.25 * hits.normal[2]
    color = albedo * (sunlight * _column(light.sun_rgb) + ambient * _column(light.ambient_rgb))
    shiny = np.flatnonzero(gloss > 0.02)
    if len(shiny):
        polished = hits.take(shiny)
        # Schlick's approximation: polish mirrors little head-on and everything at a grazing angle.
        share = gloss.take(shiny) * (0.08 + 0.92 * (1 - polished.cos_incidence) ** 5)
        dull = color.take(shiny, axis=1)
        color[:, shiny] = dull + share * (_mirrored(light, polished, sunlight.take(shiny)) - dull)
    if light.fog_per_m > 0:
        haze = _column(light.sky_horizon_rgb)
        color = haze + np.exp(-light.fog_per_m * hits.range_m) * (color - haze)
    return color


def develop(linear: np.ndarray, exposure: float) -> np.ndarray:
    """The picture (H - 2, W - 2, 3) uint8 of linear light (3, H, W): lens blur, exposure, gamma.

    The blur looks one pixel round each, so that much is cropped off.
    """
    tones = []
    for plane in linear:
        blurred = cv2.GaussianBlur(plane, (3, 3), _LENS_BLUR_PX)[1:-1, 1:-1]
        level = (blurred * np.float32(exposure * (_TONES - 1)) + np.float32(0.5)).clip(0, _TONES - 1)
        tones.append(_TONE_CURVE[level.astype(np.uint16)])
    return np.stack(tones, axis=-1)
