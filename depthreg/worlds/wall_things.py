"""What hangs on or opens in the walls of a room: doors, windows, pictures, boards."""

import numpy as np

from depthreg.worlds.floorplan import Floorplan
from depthreg.worlds.furniture import Surface, mirrored
from depthreg.worlds.interior import Palette, pick
from depthreg.worlds.scene import Material, SceneObject
from depthreg.worlds.shapes import Part, assemble
from depthreg.worlds.small_things import scatter

_DAYLIGHT = Material((1.5, 1.6, 1.7))  # brighter than any paint: it shines by itself


def openings(rng: np.random.Generator, palette: Palette, plan: Floorplan, height_m: float) -> list[SceneObject]:
    """A door and one to three windows; they come before the furniture, which keeps the door free."""
    objects: list[SceneObject] = []
    pose = plan.along_wall(rng, 0.95, 0.8, 0.0, 2.1)
    if pose:
        objects += assemble("door", _door(palette), *pose)
    for _ in range(int(rng.integers(1, 4))):
        width, bottom = rng.uniform(0.9, 1.8), rng.uniform(0.85, 1.0)
        top = min(height_m - 0.2, bottom + rng.uniform(1.0, 1.4))
        pose = plan.along_wall(rng, width + 0.5, 0.2, bottom, top)
        if pose:
            objects += assemble("window", _window(rng, palette, width, top - bottom), *pose)
    return objects


def decorations(rng: np.random.Generator, palette: Palette, plan: Floorplan, height_m: float) -> list[SceneObject]:
    """Pictures, boards and notes on what is left of the walls."""
    objects: list[SceneObject] = []
    for _ in range(int(rng.integers(4, 10))):
        kind = rng.random()
        if kind < 0.6:
            width, height = rng.uniform(0.25, 1.0), rng.uniform(0.25, 0.7)
            name, parts = "picture", _picture(rng, palette, width, height)
        elif kind < 0.8:
            width, height = rng.uniform(0.6, 1.1), 0.35
            name, parts = "board", _board(rng, palette, width)
        else:
            width, height = 0.32, 0.32
            name, parts = "clock", _clock(palette, width)
        bottom = rng.uniform(1.2, max(1.25, height_m - height - 0.4))
        pose = plan.along_wall(rng, width, 0.25, bottom, bottom + height)
        if pose:
            objects += assemble(name, parts, *pose)
    return objects


def _door(palette: Palette) -> list[Part]:
    return [
        Part("box", (0.83, 0.02, 2.02), (0, 0.01, 0), palette.wood),
        *(Part("box", (0.06, 0.05, 2.03), (x, 0.025, 0), palette.paint) for x in mirrored(0.445)),
        Part("box", (0.95, 0.05, 0.07), (0, 0.025, 2.03), palette.paint),
        Part("box", (0.12, 0.05, 0.02), (0.33, 0.05, 1.0), palette.metal),
        *(Part("box", (0.55, 0.012, 0.75), (0, 0.022, z), palette.wood) for z in (0.18, 1.12)),
    ]


def _window(rng: np.random.Generator, palette: Palette, width: float, height: float) -> list[Part]:
    bar = 0.06
    parts = [
        Part("box", (width - bar, 0.01, height - bar), (0, 0.005, bar / 2), _DAYLIGHT),
        Part("box", (width + 0.1, 0.16, 0.03), (0, 0.08, -0.03), palette.paint),
        *(
            Part("box", (bar, 0.05, height - 2 * bar), (x, 0.025, bar), palette.paint)
            for x in (*mirrored((width - bar) / 2), 0.0)
        ),
        *(Part("box", (width, 0.05, bar), (0, 0.025, z), palette.paint) for z in (0.0, height - bar)),
    ]
    if rng.random() < 0.6:
        fold = 0.07
        parts.append(Part("box", (width + 0.45, 0.03, 0.03), (0, 0.11, height), palette.metal))
        for x in (k * fold + 0.5 * width - 0.1 for k in range(4)):
            for side in mirrored(x):
                parts.append(Part("rod", (fold, 0.08, height + 0.2), (side, 0.11, -0.2), palette.fabric))
    return parts


def _picture(rng: np.random.Generator, palette: Palette, width: float, height: float) -> list[Part]:
    frame, border = pick(rng, (palette.wood, palette.dark, palette.paint)), rng.uniform(0.015, 0.04)
    mount, inside = rng.uniform(0.0, 0.08), (width - 2 * border, height - 2 * border)
    parts = [
        Part("box", (width, 0.025, height), (0, 0.0125, 0), frame),
        Part("box", (inside[0], 0.027, inside[1]), (0, 0.0135, border), palette.linen),
    ]
    canvas = (inside[0] - 2 * mount, 0.029, inside[1] - 2 * mount)
    picture = pick(rng, palette.bright)
    parts.append(Part("box", canvas, (0, 0.0145, border + mount), picture))
    for layer in range(int(rng.integers(1, 5))):  # a few fields of colour stand for the motif
        share_x, share_z = rng.uniform(0.1, 0.6, 2)
        at_x = canvas[0] * rng.uniform(share_x / 2 - 0.5, 0.5 - share_x / 2)
        at_z = border + mount + canvas[2] * rng.uniform(0, 1 - share_z)
        depth = 0.031 + 0.002 * layer
        size_m = (share_x * canvas[0], depth, share_z * canvas[2])
        parts.append(Part("box", size_m, (at_x, depth / 2, at_z), pick(rng, palette.bright)))
    return parts


def _board(rng: np.random.Generator, palette: Palette, width: float) -> list[Part]:
    depth = 0.24
    board = Part("box", (width, depth, 0.025), (0, depth / 2, 0), palette.wood)
    things = scatter(rng, palette, Surface((0, depth / 2, 0.025), width, depth + 0.04), tries=8)
    return [board, *things]


def _clock(palette: Palette, width: float) -> list[Part]:
    hand = width / 2
    return [
        Part("box", (width, 0.02, width), (0, 0.01, 0), palette.dark),
        Part("box", (width - 0.03, 0.026, width - 0.03), (0, 0.013, 0.015), palette.linen),
        Part("box", (0.012, 0.03, 0.4 * width), (0, 0.015, hand), palette.dark),
        Part("box", (0.3 * width, 0.032, 0.012), (0.15 * width, 0.016, hand), palette.dark),
    ]
