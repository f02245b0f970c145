"""What rooms and furniture are made of: materials that go together."""

import colorsys
from dataclasses import dataclass

import numpy as np

from depthreg.worlds.scene import RGB, Material


@dataclass(frozen=True)
class Palette:
    """The materials that the things of one room share."""

    wood: Material
    paint: Material  # of doors, fronts and frames
    fabric: Material
    rug: Material
    linen: Material
    cardboard: Material
    tape: Material
    metal: Material
    dark: Material
    stone: Material
    tile: Material
    leaf: Material
    bright: tuple[Material, ...]  # books, cups, boxes, cushions, pictures


def pick(rng: np.random.Generator, materials: tuple[Material, ...]) -> Material:
    """One of several materials."""
    return materials[int(rng.integers(len(materials)))]


def _hsv(hue: float, saturation: float, value: float) -> RGB:
    return colorsys.hsv_to_rgb(hue % 1, float(np.clip(saturation, 0, 1)), float(np.clip(value, 0, 1)))


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 2**31))


def wall_material(rng: np.random.Generator) -> Material:
    """Paint, plaster or wallpaper."""
    color = _hsv(rng.normal(0.12, 0.12), rng.uniform(0.0, 0.25), rng.uniform(0.5, 0.8))
    pattern = str(rng.choice(["plain", "plaster", "stripes"], p=[0.5, 0.35, 0.15]))
    scale_m = {"plain": 1.0, "plaster": 4.0, "stripes": 0.16}[pattern]
    return Material(color, pattern, _scaled(color, 0.97), scale_m, seed=_seed(rng))


def floor_material(rng: np.random.Generator, patterns: tuple[str, ...]) -> Material:
    """One of the floors "planks", "tiles" and "carpet"."""
    pattern = str(rng.choice(patterns))
    if pattern == "planks":
        return _wood(rng, "planks", scale_m=0.14)
    value = rng.uniform(0.15, 0.6)
    color = _hsv(rng.random(), rng.uniform(0.0, 0.3), value)
    if pattern == "tiles":
        return Material(
            color, "tiles", _scaled(color, rng.choice([0.5, 1.3])), scale_m=rng.uniform(0.2, 0.45), gloss=0.1
        )
    return Material(color, "carpet", _scaled(color, 0.7), scale_m=1.5, seed=_seed(rng))


def _wood(rng: np.random.Generator, pattern: str = "wood", scale_m: float = 0.6) -> Material:
    tones = [(0.47, 0.31, 0.17), (0.58, 0.42, 0.24), (0.3, 0.17, 0.09), (0.17, 0.095, 0.055), (0.5, 0.4, 0.3)]
    color = _scaled(tones[int(rng.integers(len(tones)))], rng.uniform(0.85, 1.15))
    return Material(color, pattern, _scaled(color, 0.78), scale_m, seed=_seed(rng))


def _scaled(color: RGB, factor: float) -> RGB:
    red, green, blue = (min(float(factor * c), 1.0) for c in color)
    return red, green, blue


def draw_palette(rng: np.random.Generator) -> Palette:
    """Materials that go together: one wood, one fabric, one paint, and small things of all colours."""
    fabric = _hsv(rng.random(), rng.uniform(0.0, 0.6), rng.uniform(0.08, 0.55))
    paint = pick(
        rng,
        (Material((0.72, 0.71, 0.68)), Material((0.72, 0.71, 0.68)), Material(_hsv(rng.random(), 0.45, 0.4))),
    )
    return Palette(
        wood=_wood(rng),
        paint=paint,
        fabric=Material(fabric, "fabric", _scaled(fabric, 0.7), scale_m=0.6, seed=_seed(rng)),
        rug=Material(
            _hsv(rng.random(), rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.5)),
            "carpet",
            fabric,
            0.3,
            seed=_seed(rng),
        ),
        cardboard=Material((0.42, 0.29, 0.17)),
        tape=Material((0.5, 0.38, 0.22), gloss=0.1),
        linen=Material((0.75, 0.74, 0.71)),
        metal=Material((0.5, 0.5, 0.52), gloss=0.3),
        dark=Material((0.03, 0.03, 0.035), gloss=0.08),
        stone=Material(_hsv(0.1, 0.1, rng.uniform(0.04, 0.6)), "noise", (0.35, 0.34, 0.33), 0.4, seed=_seed(rng)),
        leaf=Material((0.08, 0.2, 0.04), "noise", (0.15, 0.3, 0.07), 0.3),
        tile=Material(_hsv(rng.random(), rng.uniform(0, 0.3), 0.65), "tiles", (0.6, 0.6, 0.58), 0.1, gloss=0.05),
        bright=tuple(
            Material(_hsv(rng.normal(k / 10, 0.05), rng.beta(1.2, 1.5), rng.uniform(0.05, 0.75))) for k in range(10)
        ),
    )
