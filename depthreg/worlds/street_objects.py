"""What stands and drives in a street: vehicles, people, trees, lamps and signs, each as a list of parts.

Every thing stands on z = 0 round the origin of its own frame and faces along y.
"""

from collections.abc import Sequence

import numpy as np

from depthreg.worlds.scene import RGB, Material
from depthreg.worlds.shapes import Part
from depthreg.worlds.street_shapes import BODIES, CROWNS

CAR_PAINTS: tuple[RGB, ...] = (
    (0.02, 0.02, 0.022), (0.05, 0.052, 0.055), (0.16, 0.165, 0.17), (0.4, 0.41, 0.42), (0.72, 0.72, 0.7),
    (0.72, 0.72, 0.7), (0.02, 0.04, 0.12), (0.05, 0.12, 0.25), (0.3, 0.02, 0.02), (0.12, 0.11, 0.08),
    (0.04, 0.09, 0.06),
)  # fmt: skip
GLASS = Material((0.015, 0.018, 0.02), gloss=0.9)
TYRE = Material((0.012, 0.012, 0.013))
RIM = Material((0.3, 0.3, 0.31), gloss=0.3)
STEEL = Material((0.24, 0.25, 0.25), "plaster", (0.15, 0.12, 0.09), 3.0, gloss=0.1)
DARK_STEEL = Material((0.04, 0.045, 0.045), gloss=0.15)
WHITE = Material((0.7, 0.7, 0.68), gloss=0.1)
RED_LAMP = Material((0.35, 0.01, 0.01), gloss=0.5)
CLEAR_LAMP = Material((0.6, 0.6, 0.58), gloss=0.6)
LEAVES: tuple[tuple[RGB, RGB], ...] = (
    ((0.035, 0.07, 0.018), (0.09, 0.13, 0.03)),
    ((0.05, 0.085, 0.02), (0.12, 0.15, 0.035)),
    ((0.025, 0.05, 0.018), (0.055, 0.085, 0.03)),
    ((0.08, 0.09, 0.02), (0.17, 0.13, 0.03)),  # autumn begins
)
_CANVAS: tuple[RGB, ...] = (
    (0.11, 0.1, 0.1),
    (0.3, 0.28, 0.26),
    (0.55, 0.54, 0.5),
    (0.65, 0.65, 0.63),
    (0.06, 0.1, 0.2),
)
_CLOTHES: tuple[RGB, ...] = (
    (0.02, 0.02, 0.03), (0.03, 0.04, 0.09), (0.12, 0.11, 0.1), (0.25, 0.03, 0.03), (0.25, 0.22, 0.16),
    (0.35, 0.35, 0.34),
)  # fmt: skip


def pick(rng: np.random.Generator, colors: Sequence[RGB]) -> RGB:
    """One of some colours."""
    return colors[int(rng.integers(len(colors)))]


def tinted(rng: np.random.Generator, color: RGB, spread: float = 0.2) -> RGB:
    """A colour a little lighter or darker, warmer or colder; `spread` is a share of it."""
    scale = rng.uniform(1 - spread, 1 + spread) * rng.uniform(1 - spread / 4, 1 + spread / 4, 3)
    red, green, blue = (np.array(color) * scale).clip(0, 1).tolist()
    return red, green, blue


def _wheels(track_m: float, axles_m: list[float], size_m: float, width_m: float, far: bool) -> list[Part]:
    """Tyres, and where it isn't far the rims in them, at both ends of each axle."""
    parts = []
    for x, y in ((side * track_m / 2, y) for side in (-1, 1) for y in axles_m):
        parts.append(Part("far_wheel" if far else "wheel", (width_m, size_m, size_m), (x, y, 0), TYRE))
        if not far:
            rim = (width_m + 0.02, 0.6 * size_m, 0.6 * size_m)
            parts.append(Part("wheel", rim, (x, y, 0.2 * size_m), RIM))
    return parts


def car(rng: np.random.Generator, far: bool) -> list[Part]:
    """A hatchback, saloon, estate car or van, without its small parts when far."""
    kind = str(rng.choice(list(BODIES), p=[0.4, 0.25, 0.25, 0.1]))
    width, length, height = rng.uniform(1.68, 1.85), rng.uniform(3.9, 4.7), rng.uniform(1.42, 1.55)
    waist = 0.92
    if kind == "van":
        length, height, waist = length + 0.4, rng.uniform(1.8, 2.1), 1.05
    paint = Material(pick(rng, CAR_PAINTS), gloss=0.55)
    cabin, cabin_at = (0.92 * width, 0.72 * length, height - waist), (0, -0.13 * length, waist - 0.03)
    rear = -0.485 * length
    parts = [
        Part("car_body", (width, length, waist - 0.12), (0, 0, 0.15), paint),
        Part(f"{kind}_cabin", cabin, cabin_at, GLASS),
        Part(f"{kind}_roof", cabin, cabin_at, paint),
        Part("box", (0.52, 0.04, 0.12), (0, rear - 0.04, 0.56), WHITE),
    ]
    parts += _wheels(width - 0.2, [-0.3 * length, 0.31 * length], 0.64, 0.23, far)
    parts += [Part("box", (0.22, 0.12, 0.24), (x * 0.39 * width, rear, 0.66), RED_LAMP) for x in (-1, 1)]
    if far:
        return parts
    parts.append(Part("box", (0.86 * width, 0.3, 0.2), (0, rear + 0.1, 0.28), DARK_STEEL))
    for side in (-1, 1):
        parts.append(Part("box", (0.3, 0.25, 0.13), (side * 0.33 * width, 0.435 * length, 0.58), CLEAR_LAMP))
        parts.append(Part("box", (0.16, 0.1, 0.12), (side * 0.53 * width, 0.2 * length, waist), paint))
        parts.append(Part("box", (0.02, 0.9 * length, 0.1), (side * 0.495 * width, 0, 0.2), DARK_STEEL))
    return parts


def lorry(rng: np.random.Generator, far: bool) -> list[Part]:
    """A lorry with a box body."""
    length, height = rng.uniform(6.5, 11), rng.uniform(3.1, 3.8)
    body = Material(tinted(rng, pick(rng, _CANVAS), 0.3), "corrugated", (0.3, 0.3, 0.3), 0.6)
    cab = Material(pick(rng, CAR_PAINTS), gloss=0.4)
    rear, front = -length / 2, length / 2
    parts = [
        Part("box", (2.45, length - 2.3, height - 1.05), (0, -1.15, 1.05), body),
        Part("box", (1.0, length - 0.6, 0.35), (0, 0, 0.6), DARK_STEEL),
        Part("box", (2.3, 2.0, 1.2), (0, front - 1.0, 0.5), cab),
        Part("box", (2.25, 1.9, 0.9), (0, front - 1.05, 1.7), GLASS),
        Part("box", (2.3, 1.7, 0.35), (0, front - 1.1, 2.55), cab),
        Part("box", (2.3, 0.12, 0.15), (0, rear + 0.05, 0.5), DARK_STEEL),
        Part("box", (0.5, 0.04, 0.12), (0, rear - 0.02, 0.7), WHITE),
    ]
    parts += [Part("box", (0.35, 0.06, 0.16), (x, rear, 0.75), RED_LAMP) for x in (-0.95, 0.95)]
    return parts + _wheels(2.1, [rear + 1.3, rear + 2.5, front - 1.1], 0.95, 0.3, far)


def person(rng: np.random.Generator) -> list[Part]:
    """Someone who stands or walks, 1.5 to 1.9 m tall."""
    tall, step = rng.uniform(1.5, 1.9), rng.uniform(0, 0.22)
    coat, trousers = (Material(tinted(rng, pick(rng, _CLOTHES), 0.5), "fabric") for _ in range(2))
    skin, hair = Material(tinted(rng, (0.35, 0.2, 0.14), 0.4)), Material(tinted(rng, (0.06, 0.04, 0.025), 0.9))
    parts = [
        Part("limb", (0.46, 0.3, 0.38 * tall), (0, 0, 0.45 * tall), coat),
        Part("egg", (0.44, 0.28, 0.14 * tall), (0, 0, 0.74 * tall), coat),
        Part("egg", (0.18, 0.21, 0.14 * tall), (0, 0, 0.855 * tall), skin),
        Part("egg", (0.2, 0.21, 0.1 * tall), (0, -0.02, 0.905 * tall), hair),
    ]
    for side in (-1, 1):
        parts.append(Part("leg", (0.13, 0.15, 0.48 * tall), (side * 0.1, side * step, 0), trousers))
        parts.append(Part("limb", (0.11, 0.12, 0.36 * tall), (side * 0.24, -side * step, 0.43 * tall), coat))
    return parts


def tree(rng: np.random.Generator, detail: int) -> list[Part]:
    """A broad-leaved tree or a conifer, 5 to 13 m tall; `detail` is an index of `LEAF_DETAIL`."""
    color, second = LEAVES[rng.integers(len(LEAVES))]
    leaf = Material(tinted(rng, color), "foliage", second, 2.5, seed=int(rng.integers(99)), variation=0.6)
    bark = Material((0.1, 0.08, 0.06), "bark", (0.2, 0.18, 0.15), 1.5, seed=int(rng.integers(99)))
    tall, turn, which = rng.uniform(5.5, 13), rng.uniform(0, 360), rng.integers(CROWNS)
    conifer = rng.random() < 0.15
    wide, clear = (0.36, 0.07) if conifer else (rng.uniform(0.55, 0.85), rng.uniform(0.2, 0.3))
    crown = f"{'conifer' if conifer else 'crown'}{detail}{which}"
    trunk = 0.02 * tall + 0.08
    return [
        Part("limb", (trunk, trunk, (0.4 if conifer else 0.65) * tall), (0, 0, -0.5), bark),
        Part(crown, (wide * tall, wide * tall, (1 - clear) * tall), (0, 0, clear * tall), leaf, turn),
    ]


def bush(rng: np.random.Generator, detail: int) -> list[Part]:
    """A shrub, 0.7 to 2.2 m tall; `detail` is an index of `LEAF_DETAIL`."""
    color, second = LEAVES[rng.integers(len(LEAVES))]
    leaf = Material(color, "foliage", second, 1.5, seed=int(rng.integers(99)), variation=0.6)
    tall = rng.uniform(0.7, 2.2)
    wide = tall * rng.uniform(0.9, 1.5)
    crown = f"bush{min(detail, 2)}{rng.integers(CROWNS)}"
    return [Part(crown, (wide, wide, tall), (0, 0, -0.08 * tall), leaf, rng.uniform(0, 360))]


def lamp_post(rng: np.random.Generator) -> list[Part]:
    """A street lamp whose arm reaches 1.6 m to the right."""
    tall = rng.uniform(5.5, 8.5)
    return [
        Part("shade", (0.17, 0.17, tall), (0, 0, 0), STEEL),
        Part("box", (1.6, 0.07, 0.07), (0.75, 0, tall - 0.1), STEEL),
        Part("box", (0.6, 0.22, 0.12), (1.5, 0, tall - 0.12), DARK_STEEL),
    ]


def pole(rng: np.random.Generator) -> list[Part]:
    """A wooden or steel mast."""
    wood = Material((0.13, 0.1, 0.075), "bark", (0.2, 0.17, 0.14), 2.0)
    return [Part("rod", (0.2, 0.2, rng.uniform(6, 9)), (0, 0, 0), wood if rng.random() < 0.5 else STEEL)]


def sign(rng: np.random.Generator) -> list[Part]:
    """A traffic sign on its post: round, triangular or a plate, facing back along the street."""
    tall = rng.uniform(2.2, 2.7)
    red, blue = Material((0.5, 0.02, 0.02), gloss=0.1), Material((0.02, 0.08, 0.4), gloss=0.1)
    wide = rng.uniform(0.5, 1.1)
    # A plate and what is painted on it: shape, width, height above the plate's foot, material.
    kinds = [
        (("disc", 0.62, 0.62, 0.0, red), ("disc", 0.46, 0.46, 0.08, WHITE)),
        (("triangle", 0.8, 0.8, 0.0, red), ("triangle", 0.5, 0.5, 0.15, WHITE)),
        (("disc", 0.6, 0.6, 0.0, blue), ("box", 0.1, 0.34, 0.13, WHITE)),
        (("box", wide, 0.6, 0.0, WHITE), ("box", 0.8 * wide, 0.16, 0.3, blue)),
    ]
    parts = [Part("rod", (0.07, 0.07, tall + 0.5), (0, 0, 0), STEEL)]
    for shape, width, height, up, material in kinds[rng.integers(len(kinds))]:
        thick = 0.03 if up else 0.02
        parts.append(Part(shape, (width, thick, height), (0, -0.05 - 0.005 * (up > 0), tall + up), material))
    return parts


def traffic_light(rng: np.random.Generator) -> list[Part]:
    """A signal on its post."""
    lamps = [((0.4, 0.02, 0.01), 0.62), ((0.12, 0.07, 0.01), 0.36), ((0.01, 0.1, 0.06), 0.1)]
    return [
        Part("rod", (0.12, 0.12, 3.3), (0, 0, 0), STEEL),
        Part("box", (0.3, 0.22, 0.9), (0, -0.12, 2.4), DARK_STEEL),
        *(Part("disc", (0.2, 0.02, 0.2), (0, -0.24, 2.4 + up), Material(color, gloss=0.3)) for color, up in lamps),
    ]


def gantry(rng: np.random.Generator, half_m: float) -> list[Part]:
    """A bridge of signs that spans `half_m` to either side."""
    blue = Material((0.02, 0.07, 0.32), "concrete", (0.6, 0.6, 0.6), 0.8, gloss=0.1)
    boards = [Part("box", (rng.uniform(2.5, 4), 0.12, 2.0), (x * half_m, -0.3, 5.4), blue) for x in (0.3, 0.7)]
    return [
        *(Part("box", (0.35, 0.35, 7.0), (side * half_m, 0, 0), STEEL) for side in (-1, 1)),
        *(Part("box", (2 * half_m, 0.2, 0.25), (0, 0, up), STEEL) for up in (5.6, 6.7)),
        *boards,
    ]


def bin_or_box(rng: np.random.Generator) -> list[Part]:
    """A dustbin or a cabinet at the kerb."""
    color = pick(rng, [(0.03, 0.05, 0.03), (0.05, 0.05, 0.055), (0.25, 0.25, 0.23), (0.3, 0.22, 0.02)])
    wide, tall = rng.uniform(0.5, 1.1), rng.uniform(0.9, 1.4)
    return [Part("box", (0.5, wide, tall), (0, 0, 0), Material(color, "plaster", (0.1, 0.1, 0.1), 2.0, gloss=0.1))]
