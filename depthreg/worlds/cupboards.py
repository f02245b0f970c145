"""Cupboards, shelves and what has a screen, built of solids in the frame that `furniture` describes."""

from itertools import pairwise

import numpy as np

from depthreg.worlds.furniture import Furniture, Surface, chair, mirrored, turned
from depthreg.worlds.interior import Palette, pick
from depthreg.worlds.shapes import Part


def bookcase(rng: np.random.Generator, palette: Palette) -> Furniture:
    """Open shelves full of books, boxes and gaps."""
    width, depth, height, board = rng.uniform(0.7, 1.3), rng.uniform(0.26, 0.36), rng.uniform(1.0, 2.1), 0.022
    body = pick(rng, (palette.wood, palette.wood, palette.paint))
    levels = np.linspace(0.06, height - board, max(3, round(height / 0.36)))
    parts = [Part("box", (board, depth, height), (x, depth / 2, 0), body) for x in mirrored((width - board) / 2)]
    parts.append(Part("box", (width - board, 0.01, height - 0.02), (0, 0.005, 0.01), body))
    parts += [Part("box", (width - 2 * board, depth - 0.01, board), (0, depth / 2, float(z)), body) for z in levels]
    inner = width - 2 * board
    for low, high in pairwise(levels):
        parts += _books(rng, palette, inner, float(low) + board, float(high - low) - board, depth)
    top = Surface((0, depth / 2, height), width, depth)
    return Furniture("bookcase", parts, width, depth, height, (top,) if height < 1.5 else ())


def _books(rng: np.random.Generator, palette: Palette, width: float, z: float, room: float, depth: float) -> list[Part]:
    """Books, boxes and gaps from left to right on one board."""
    parts: list[Part] = []
    x = -width / 2 + 0.01
    while True:
        kind = rng.random()
        thickness = rng.uniform(0.015, 0.05) if kind < 0.8 else rng.uniform(0.1, 0.25)
        if x + thickness > width / 2 - 0.01:
            return parts
        if kind < 0.93:  # the rest stays empty
            size_m = (thickness - 0.002, depth * rng.uniform(0.55, 0.85), room * rng.uniform(0.55, 0.92))
            parts.append(
                Part(
                    "box",
                    size_m,
                    (x + thickness / 2, depth - 0.02 - size_m[1] / 2, z),
                    pick(rng, palette.bright),
                )
            )
        x += thickness


def cabinet(
    rng: np.random.Generator,
    palette: Palette,
    width: float,
    depth: float,
    height: float,
    rows: int,
    columns: int,
) -> Furniture:
    """A closed body with a grid of doors or drawers: chest, sideboard, wardrobe, kitchen cupboards."""
    front = pick(rng, (palette.wood, palette.paint))
    parts = [
        Part("box", (width - 0.06, depth - 0.08, 0.08), (0, (depth - 0.08) / 2, 0), palette.dark),
        Part("box", (width, depth - 0.03, height - 0.08), (0, (depth - 0.03) / 2, 0.08), front),
    ]
    door_width, door_height = width / columns, (height - 0.1) / rows
    for column in range(columns):
        for row in range(rows):
            x, z = (column + 0.5) * door_width - width / 2, 0.09 + row * door_height
            parts.append(Part("box", (door_width - 0.008, 0.02, door_height - 0.008), (x, depth - 0.02, z), front))
            handle_z = z + door_height - 0.07 if door_height < 1.0 else 1.0
            parts.append(Part("box", (min(0.14, 0.5 * door_width), 0.025, 0.015), (x, depth, handle_z), palette.metal))
    top = (Surface((0, depth / 2, height), width, depth),) if height < 1.5 else ()
    return Furniture("cabinet", parts, width, depth + 0.015, height, top)


def chest(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A chest of drawers or a sideboard."""
    columns = int(rng.integers(1, 4))
    width = columns * rng.uniform(0.45, 0.7)
    return cabinet(
        rng, palette, width, rng.uniform(0.38, 0.48), rng.uniform(0.6, 1.1), int(rng.integers(2, 5)), columns
    )


def wardrobe(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A tall cupboard with two or three doors."""
    columns = int(rng.integers(2, 4))
    return cabinet(rng, palette, 0.5 * columns, 0.58, rng.uniform(1.8, 2.15), 1, columns)


def fridge(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A fridge with a freezer below and notes on its door."""
    width, depth, height, split = 0.6, 0.64, rng.uniform(1.4, 1.85), 0.6
    shell = pick(rng, (palette.linen, palette.metal, palette.paint))
    parts = [
        Part("box", (width, depth - 0.06, height), (0, (depth - 0.06) / 2, 0), shell),
        Part("box", (width, 0.05, split - 0.05), (0, depth - 0.03, 0.04), shell),
        Part("box", (width, 0.05, height - split - 0.01), (0, depth - 0.03, split), shell),
        *(Part("box", (0.02, 0.03, 0.3), (0.25, depth, z), palette.metal) for z in (0.25, split + 0.1)),
    ]
    for layer in range(int(rng.integers(0, 5))):
        size_m = (rng.uniform(0.08, 0.21), 0.004 + 0.002 * layer, rng.uniform(0.08, 0.28))
        at_m = (rng.uniform(-0.18, 0.1), depth - 0.004, rng.uniform(split + 0.05, height - 0.3))
        parts.append(Part("box", size_m, at_m, pick(rng, (palette.linen, *palette.bright))))
    return Furniture("fridge", parts, width, depth + 0.015, height)


def counter(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A kitchen counter: cupboards, worktop, sink and hob, splash-back and wall cupboards."""
    columns = int(rng.integers(3, 6))
    width, depth, height = 0.6 * columns, 0.6, 0.9
    low = cabinet(rng, palette, width, depth, height - 0.04, 1, columns)
    high = cabinet(rng, palette, width, 0.34, 0.7, 1, columns)
    lift = 1.45
    hung = [part.moved((0, 0, lift)) for part in high.parts[1:]]
    sink_x, hob_x = (0.6 * (float(x) - (columns - 1) / 2) for x in rng.permutation(columns)[:2])
    fittings = [
        Part("box", (width, depth + 0.03, 0.04), (0, (depth + 0.03) / 2, height - 0.04), palette.stone),
        Part("box", (width - 0.01, 0.012, lift - height + 0.1), (0, 0.006, height), palette.tile),
        Part("box", (0.5, 0.4, 0.006), (sink_x, 0.33, height), palette.metal),
        Part("rod", (0.025, 0.025, 0.22), (sink_x, 0.08, height), palette.metal),
        Part("box", (0.02, 0.16, 0.02), (sink_x, 0.15, height + 0.21), palette.metal),
        Part("box", (0.56, 0.48, 0.008), (hob_x, 0.31, height), palette.dark),
    ]
    free = tuple(
        Surface((0.6 * (c - (columns - 1) / 2), depth / 2, height), 0.56, 0.5)
        for c in range(columns)
        if abs(0.6 * (c - (columns - 1) / 2) - sink_x) > 0.1
    )
    return Furniture("counter", low.parts + hung + fittings, width, depth + 0.03, 2.2, free)


def desk(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A desk with a screen, a keyboard and a chair pushed up to it."""
    width, depth, height = rng.uniform(1.2, 1.6), 0.7, 0.74
    parts = [Part("box", (width, depth, 0.03), (0, depth / 2, height - 0.03), palette.wood)]
    parts += [
        Part("box", (0.04, depth - 0.06, height - 0.03), (x, depth / 2, 0), palette.paint)
        for x in mirrored(width / 2 - 0.04)
    ]
    parts.append(Part("box", (width - 0.1, 0.02, 0.4), (0, 0.06, height - 0.45), palette.paint))
    parts += screen(rng.uniform(0.5, 0.65), (0, 0.2, height), palette)
    parts.append(Part("box", (0.42, 0.14, 0.02), (0, 0.5, height), palette.dark))
    parts += turned(chair(rng, palette), rng.uniform(-0.15, 0.15), depth + 0.5)
    side = width / 2 - 0.4
    free = tuple(Surface((x, depth / 2, height), side, depth) for x in mirrored(width / 2 - side / 2))
    return Furniture("desk", parts, width, depth + 0.5, 1.25, free)


def screen(width: float, at_m: tuple[float, float, float], palette: Palette) -> list[Part]:
    """A flat screen on a foot."""
    x, y, z = at_m
    return [
        Part("box", (0.4 * width, 0.16, 0.012), (x, y, z), palette.dark),
        Part("box", (0.06, 0.03, 0.12), (x, y - 0.02, z), palette.dark),
        Part("box", (width, 0.03, 0.58 * width), (x, y, z + 0.08), palette.dark),
    ]


def television(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A low board with a large screen."""
    width, depth, height = rng.uniform(1.2, 1.8), 0.42, rng.uniform(0.4, 0.55)
    board = cabinet(rng, palette, width, depth, height, 1, 3)
    size = rng.uniform(0.8, 1.1)
    side = (width - 0.5 * size) / 2
    free = tuple(Surface((x, depth / 2, height), 0.4 * side, depth) for x in mirrored(width / 2 - 0.25 * side))
    return Furniture(
        "television", board.parts + screen(size, (0, 0.2, height), palette), width, depth + 0.015, 1.3, free
    )
