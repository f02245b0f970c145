"""Cups, bottles, books and the like, and how they get onto surfaces."""

from collections.abc import Callable

import numpy as np

from depthreg.worlds.furniture import Surface
from depthreg.worlds.interior import Palette, pick
from depthreg.worlds.shapes import Part

Maker = Callable[[np.random.Generator, Palette], list[Part]]


def _cup(rng: np.random.Generator, palette: Palette) -> list[Part]:
    height, material = rng.uniform(0.07, 0.11), pick(rng, (palette.linen, *palette.bright))
    handle = Part("box", (0.03, 0.012, 0.5 * height), (0.045, 0, 0.25 * height), material)
    return [Part("pot", (0.085, 0.085, height), (0, 0, 0), material), handle]


def _bottle(rng: np.random.Generator, palette: Palette) -> list[Part]:
    width = rng.uniform(0.06, 0.1)
    return [Part("bottle", (width, width, rng.uniform(0.18, 0.32)), (0, 0, 0), pick(rng, palette.bright))]


def _bowl(rng: np.random.Generator, palette: Palette) -> list[Part]:
    width = rng.uniform(0.12, 0.28)
    return [Part("bowl", (width, width, 0.4 * width), (0, 0, 0), pick(rng, (palette.linen, *palette.bright)))]


def _fruit_bowl(rng: np.random.Generator, palette: Palette) -> list[Part]:
    parts = [Part("bowl", (0.26, 0.26, 0.1), (0, 0, 0), palette.wood)]
    for angle in np.linspace(0, 2 * np.pi, 4, endpoint=False):
        at_m = (0.06 * np.cos(angle), 0.06 * np.sin(angle), 0.04)
        parts.append(Part("ball", (0.08, 0.08, 0.08), at_m, pick(rng, palette.bright)))
    return parts


def _books(rng: np.random.Generator, palette: Palette) -> list[Part]:
    parts, z = [], 0.0
    for _ in range(int(rng.integers(1, 5))):
        size_m = (rng.uniform(0.14, 0.2), rng.uniform(0.2, 0.26), rng.uniform(0.01, 0.045))
        parts.append(Part("box", size_m, (0, 0, z), pick(rng, palette.bright), rng.uniform(-15, 15)))
        z += size_m[2]
    return parts


def _papers(rng: np.random.Generator, palette: Palette) -> list[Part]:
    materials = (palette.linen, pick(rng, palette.bright))
    return [
        Part("box", (0.21, 0.297, 0.002), (rng.uniform(-0.03, 0.03), 0, 0.002 * k), m, rng.uniform(-25, 25))
        for k, m in enumerate(materials)
    ]


def _carton(rng: np.random.Generator, palette: Palette) -> list[Part]:
    width, depth, height = rng.uniform(0.06, 0.25), rng.uniform(0.05, 0.18), rng.uniform(0.06, 0.28)
    return [Part("box", (width, depth, height), (0, 0, 0), pick(rng, palette.bright))]


def _tin(rng: np.random.Generator, palette: Palette) -> list[Part]:
    width = rng.uniform(0.06, 0.14)
    return [Part("cylinder", (width, width, rng.uniform(0.08, 0.2)), (0, 0, 0), pick(rng, palette.bright))]


def _pot_plant(rng: np.random.Generator, palette: Palette) -> list[Part]:
    size = rng.uniform(0.18, 0.32)
    return [
        Part(
            "pot",
            (0.45 * size, 0.45 * size, 0.4 * size),
            (0, 0, 0),
            pick(rng, (palette.linen, *palette.bright)),
        ),
        Part("foliage", (size, size, 0.9 * size), (0, 0, 0.38 * size), palette.leaf, rng.uniform(0, 360)),
    ]


def _lamp(rng: np.random.Generator, palette: Palette) -> list[Part]:
    height, shade = rng.uniform(0.32, 0.5), rng.uniform(0.2, 0.3)
    return [
        Part("cylinder", (0.12, 0.12, 0.02), (0, 0, 0), palette.metal),
        Part("bottle", (0.1, 0.1, height - 0.1), (0, 0, 0.02), pick(rng, palette.bright)),
        Part("shade", (shade, shade, 0.18), (0, 0, height - 0.16), palette.linen),
    ]


def _picture_frame(rng: np.random.Generator, palette: Palette) -> list[Part]:
    width, height = rng.uniform(0.1, 0.2), rng.uniform(0.12, 0.25)
    return [
        Part("box", (width, 0.02, height), (0, 0, 0), palette.wood),
        Part("box", (width - 0.03, 0.024, height - 0.03), (0, 0, 0.015), pick(rng, palette.bright)),
    ]


def _laptop(rng: np.random.Generator, palette: Palette) -> list[Part]:
    return [
        Part("box", (0.32, 0.22, 0.016), (0, 0, 0), palette.metal),
        Part("box", (0.316, 0.01, 0.21), (0, -0.11, 0.01), palette.dark),
    ]


# Every thing with the radius of the circle that it stands in.
_THINGS: tuple[tuple[Maker, float], ...] = (
    (_cup, 0.07),
    (_cup, 0.07),
    (_bottle, 0.06),
    (_bottle, 0.06),
    (_bowl, 0.15),
    (_fruit_bowl, 0.14),
    (_books, 0.17),
    (_papers, 0.19),
    (_carton, 0.16),
    (_tin, 0.08),
    (_pot_plant, 0.17),
    (_lamp, 0.16),
    (_picture_frame, 0.11),
    (_laptop, 0.2),
)


def scatter(rng: np.random.Generator, palette: Palette, surface: Surface, tries: int) -> list[Part]:
    """Small things that stand on a surface and not in each other, in the frame of the surface's furniture."""
    x0, y0, z = surface.center_m
    parts: list[Part] = []
    circles: list[tuple[float, float, float]] = []
    for _ in range(tries):
        make, radius = _THINGS[int(rng.integers(len(_THINGS)))]
        room_x, room_y = surface.width_m / 2 - radius, surface.depth_m / 2 - radius
        if room_x < 0 or room_y < 0:
            continue
        x, y = x0 + rng.uniform(-room_x, room_x), y0 + rng.uniform(-room_y, room_y)
        if all(np.hypot(x - cx, y - cy) > radius + cr for cx, cy, cr in circles):
            circles.append((x, y, radius))
            parts += [part.moved((x, y, z)) for part in make(rng, palette)]
    return parts
