"""Furniture of plausible sizes, built of solids.

A piece stands in its own frame with the middle of its back at the origin and its front towards +y. No two solids of a
thing show faces that overlap in one plane: which is in front would be chance, and Cycles draws them black.
"""

from dataclasses import dataclass

import numpy as np

from depthreg.worlds.interior import Palette, pick
from depthreg.worlds.shapes import Part


@dataclass(frozen=True)
class Surface:
    """A level rectangle that small things can stand on, in the frame of its furniture."""

    center_m: tuple[float, float, float]
    width_m: float  # along x
    depth_m: float  # along y


@dataclass(frozen=True)
class Furniture:
    """A piece of furniture and the box that it fills, x in [-width / 2, width / 2] and y in [0, depth]."""

    name: str
    parts: list[Part]
    width_m: float
    depth_m: float
    height_m: float
    surfaces: tuple[Surface, ...] = ()


def mirrored(x: float) -> tuple[float, float]:
    """The same distance to the left and to the right."""
    return -x, x


def _four(width: float, depth: float) -> list[tuple[float, float]]:
    """Corners of a rectangle in front of the origin."""
    return [(x, y) for x in (-width / 2, width / 2) for y in (0.0, depth)]


def table(rng: np.random.Generator, palette: Palette, height: float = 0.74) -> Furniture:
    """A dining, side or coffee table on four legs."""
    width, depth, leg, top = rng.uniform(1.0, 1.8), rng.uniform(0.6, 0.9), rng.uniform(0.04, 0.08), 0.035
    body = pick(rng, (palette.wood, palette.wood, palette.paint))
    inset = leg / 2 + 0.02
    parts = [Part("box", (width, depth, top), (0, depth / 2, height - top), body)]
    for x, y in _four(width - 2 * inset, depth - 2 * inset):
        parts.append(Part("box", (leg, leg, height - top), (x, y + inset, 0), body))
    apron = (width - 2 * inset, 0.02, 0.07)
    parts += [Part("box", apron, (0, y, height - top - 0.07), body) for y in (inset, depth - inset)]
    return Furniture("table", parts, width, depth, height, (Surface((0, depth / 2, height), width, depth),))


def chair(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A chair with a slatted back."""
    side, seat, top, leg = 0.44, 0.45, rng.uniform(0.82, 1.0), 0.04
    body, cushion = palette.wood, pick(rng, (palette.wood, palette.fabric, palette.dark))
    edge = side + 0.006  # flush with the legs, it would flicker
    parts = [Part("box", (edge, edge, 0.04), (0, side / 2, seat - 0.04), cushion)]
    for x, y in _four(side - leg, side - leg):
        height = top if y == 0 else seat - 0.04
        parts.append(Part("box", (leg, leg, height), (x, y + leg / 2, 0), body))
    slats = int(rng.integers(2, 4))
    for z in np.linspace(seat + 0.15, top - 0.07, slats):
        parts.append(Part("box", (side - leg, 0.02, 0.06), (0, leg / 2, float(z)), body))
    return Furniture("chair", parts, side, side, top)


def sofa(rng: np.random.Generator, palette: Palette, seats: int | None = None) -> Furniture:
    """A sofa, or an armchair where it has one seat."""
    seats = seats or int(rng.integers(2, 4))
    arm, depth, seat, back = 0.18, 0.88, 0.42, rng.uniform(0.8, 0.92)
    inner = 0.65 * seats
    width = inner + 2 * arm
    cloth = palette.fabric
    parts = [
        Part("box", (width - 0.02, depth - 0.03, 0.26), (0, depth / 2, 0.06), cloth),
        Part("box", (width - 0.01, 0.22, back - 0.06), (0, 0.11, 0.06), cloth),
        *(Part("box", (arm, depth, 0.54), (x, depth / 2, 0.06), cloth) for x in mirrored((width - arm) / 2)),
        *(Part("box", (0.05, 0.05, 0.06), (x, y + 0.1, 0), palette.dark) for x, y in _four(width - 0.2, depth - 0.2)),
    ]
    for x in 0.65 * (np.arange(seats) - (seats - 1) / 2):
        parts.append(Part("box", (0.64, depth - 0.24, 0.14), (x, 0.24 + (depth - 0.24) / 2, seat - 0.12), cloth))
        parts.append(Part("box", (0.62, 0.14, 0.38), (x, 0.29, seat), cloth))
        if rng.random() < 0.4:
            parts.append(Part("box", (0.38, 0.12, 0.36), (x, 0.44, seat + 0.02), pick(rng, palette.bright)))
    return Furniture("sofa", parts, width, depth, back)


def armchair(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A sofa for one."""
    return sofa(rng, palette, seats=1)


def lounge(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A sofa with a low table and a rug in front."""
    seat, low = sofa(rng, palette), table(rng, palette, height=0.42)
    front = seat.depth_m + 0.32
    rug = Part("box", (seat.width_m, 1.3, 0.01), (0, front + 0.25, 0), palette.rug)
    parts = [*seat.parts, rug, *(part.moved((0, front, 0.01)) for part in low.parts)]
    top = Surface((0, front + low.depth_m / 2, low.height_m + 0.01), low.width_m, low.depth_m)
    return Furniture("lounge", parts, seat.width_m, front + low.depth_m, seat.height_m, (top,))


def side_table(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A small round table."""
    width, height = rng.uniform(0.4, 0.6), rng.uniform(0.45, 0.65)
    parts = [
        Part("cylinder", (width, width, 0.025), (0, width / 2, height - 0.025), palette.wood),
        Part("rod", (0.05, 0.05, height - 0.04), (0, width / 2, 0.015), palette.metal),
        Part("cylinder", (0.6 * width, 0.6 * width, 0.015), (0, width / 2, 0), palette.metal),
    ]
    top = Surface((0, width / 2, height), 0.7 * width, 0.7 * width)
    return Furniture("side table", parts, width, width, height, (top,))


def carton(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A box or a basket on the floor."""
    width, depth, height = rng.uniform(0.25, 0.5), rng.uniform(0.25, 0.4), rng.uniform(0.2, 0.45)
    if rng.random() < 0.6:
        parts = [
            Part("box", (width, depth, height), (0, depth / 2, 0), palette.cardboard),
            Part("box", (0.05, depth + 0.004, height + 0.002), (0, depth / 2, 0), palette.tape),
        ]
    else:
        wide = min(width, depth)
        parts = [Part("pot", (wide, wide, height), (0, depth / 2, 0), pick(rng, palette.bright))]
    return Furniture("carton", parts, width, depth, height)


def bed(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A bed with its head at the wall."""
    width, length = float(rng.choice([0.95, 1.4, 1.65])), 2.1
    parts = [
        Part("box", (width, length, 0.2), (0, length / 2, 0.1), palette.wood),
        Part("box", (width + 0.02, 0.06, rng.uniform(0.8, 1.1)), (0, 0.03, 0), palette.wood),
        *(Part("box", (0.07, 0.07, 0.1), (x, y + 0.05, 0), palette.wood) for x, y in _four(width - 0.1, length - 0.1)),
        Part("box", (width - 0.06, length - 0.14, 0.2), (0, length / 2, 0.3), palette.linen),
        Part("box", (width + 0.02, length - 0.62, 0.12), (0, length / 2 + 0.28, 0.42), palette.fabric),
    ]
    for x in mirrored(width / 4) if width > 1.2 else [0.0]:
        parts.append(Part("box", (min(0.65, width / 2 - 0.04), 0.4, 0.13), (x, 0.34, 0.5), palette.linen))
    return Furniture("bed", parts, width + 0.02, length, 1.1)


def turned(piece: Furniture, x: float, y: float) -> list[Part]:
    """The parts of a piece turned round to face the origin, its back at (x, y)."""
    return [
        Part(p.shape, p.size_m, (x - p.at_m[0], y - p.at_m[1], p.at_m[2]), p.material, p.yaw_deg + 180)
        for p in piece.parts
    ]


def floor_lamp(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A standing lamp with a shade."""
    height, shade = rng.uniform(1.4, 1.7), rng.uniform(0.3, 0.42)
    parts = [
        Part("cylinder", (0.28, 0.28, 0.025), (0, 0.21, 0), palette.metal),
        Part("rod", (0.025, 0.025, height - 0.2), (0, 0.21, 0), palette.metal),
        Part("shade", (shade, shade, 0.26), (0, 0.21, height - 0.26), palette.linen),
    ]
    return Furniture("lamp", parts, 0.42, 0.42, height)


def plant(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A plant in a pot on the floor."""
    spread, pot, height = rng.uniform(0.5, 0.9), rng.uniform(0.24, 0.36), rng.uniform(0.5, 1.2)
    middle = spread / 2
    parts = [
        Part("pot", (pot, pot, pot), (0, middle, 0), pick(rng, palette.bright)),
        Part("rod", (0.03, 0.03, 0.5 * height), (0, middle, 0.9 * pot), palette.wood),
        Part("foliage", (spread, spread, 0.7 * height), (0, middle, pot), palette.leaf),
        Part(
            "foliage",
            (0.7 * spread, 0.7 * spread, 0.5 * height),
            (0, middle, pot + 0.5 * height),
            palette.leaf,
            40.0,
        ),
    ]
    return Furniture("plant", parts, spread, spread, pot + height)


def dining_group(rng: np.random.Generator, palette: Palette) -> Furniture:
    """A table with chairs along both sides, for the middle of a room."""
    board = table(rng, palette)
    reach = 0.3  # how far the chairs stand out
    parts: list[Part] = [part.moved((0, reach, 0)) for part in board.parts]
    seat = chair(rng, palette)
    places = max(1, int(board.width_m / 0.6))
    for x in (np.arange(places) - (places - 1) / 2) * board.width_m / places:
        if rng.random() < 0.85:
            slack = rng.uniform(0.0, 0.08)
            parts += [part.moved((float(x), slack, 0)) for part in seat.parts]
        if rng.random() < 0.85:
            parts += turned(seat, float(x), 2 * reach + board.depth_m - rng.uniform(0.0, 0.08))
    top = Surface((0, reach + board.depth_m / 2, board.height_m), board.width_m, board.depth_m)
    return Furniture("dining table", parts, board.width_m, board.depth_m + 2 * reach, 1.0, (top,))
