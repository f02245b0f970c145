"""What stands and drives in a street: vehicles, people, trees, lamps, signs and houses, each as a list of parts.

Every thing stands on z = 0 round the origin of its own frame and faces along y.
"""

from functools import partial

import numpy as np
import trimesh

from depthreg.worlds.scene import RGB, Material
from depthreg.worlds.shapes import SHAPES, Part

CAR_PAINTS: tuple[RGB, ...] = (
    (0.02, 0.02, 0.022), (0.05, 0.052, 0.055), (0.16, 0.165, 0.17), (0.4, 0.41, 0.42), (0.72, 0.72, 0.7),
    (0.72, 0.72, 0.7), (0.02, 0.04, 0.12), (0.05, 0.12, 0.25), (0.3, 0.02, 0.02), (0.12, 0.11, 0.08), (0.04, 0.09, 0.06),
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


def _loft(stations: list[tuple[float, float, float, float]]) -> trimesh.Trimesh:
    """A closed hull through upright rectangles at y: (y, half width, bottom, top), back to front."""
    rings = [[(-w, y, low), (w, y, low), (w, y, high), (-w, y, high)] for y, w, low, high in stations]
    vertices = np.array(rings).reshape(-1, 3)
    faces = []
    for k in range(0, 4 * (len(stations) - 1), 4):
        for a in range(4):
            b = (a + 1) % 4
            faces += [(k + a, k + 4 + a, k + b), (k + b, k + 4 + a, k + 4 + b)]
    end = 4 * (len(stations) - 1)
    faces += [(0, 1, 2), (0, 2, 3), (end, end + 2, end + 1), (end, end + 3, end + 2)]
    return trimesh.Trimesh(vertices, faces, process=False)


def _car_body() -> trimesh.Trimesh:
    """Everything of a car below its windows, in a unit box."""
    return _loft(
        [
            (-0.5, 0.40, 0.35, 0.70), (-0.485, 0.45, 0.15, 0.97), (-0.44, 0.5, 0.08, 1.0), (0.15, 0.5, 0.08, 0.98),
            (0.22, 0.495, 0.08, 0.92), (0.42, 0.48, 0.1, 0.78), (0.475, 0.44, 0.15, 0.66), (0.5, 0.38, 0.25, 0.5),
        ]
    )  # fmt: skip


def _cabin(rear_top: float, front_top: float) -> trimesh.Trimesh:
    """The windows of a car in a unit box; the roof reaches from `rear_top` to `front_top`, and is narrower."""
    low = [(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)]
    high = [(-0.39, rear_top, 1), (0.39, rear_top, 1), (0.39, front_top, 1), (-0.39, front_top, 1)]
    return trimesh.convex.convex_hull(np.array(low + high))


def _roof(rear_top: float, front_top: float) -> trimesh.Trimesh:
    """The painted roof on top of `_cabin`, a little wider than it there, and its four pillars."""
    top = _loft([(rear_top - 0.02, 0.36, 0.9, 0.97), (rear_top + 0.03, 0.41, 0.93, 1.04), (front_top - 0.06, 0.41, 0.93, 1.04), (front_top + 0.02, 0.37, 0.9, 0.96)])
    pillars = []
    for side in (-1, 1):
        for foot, head in ((-0.5, rear_top), (0.5, front_top), (-0.02, (rear_top + front_top) / 2)):
            bottom = np.array([side * 0.5, foot, 0.0])
            upper = np.array([side * 0.395, head, 0.96])
            pillars.append(_bar(bottom, upper, 0.05))
    return trimesh.util.concatenate([top, *pillars])


def _bar(start: np.ndarray, stop: np.ndarray, width: float) -> trimesh.Trimesh:
    half = width / 2
    ring = np.array([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)])
    return trimesh.convex.convex_hull(np.concatenate([ring + start, ring + stop]))


def _wheel(corners: int) -> trimesh.Trimesh:
    """A disc that rolls along y."""
    return trimesh.creation.cylinder(radius=0.5, segment=[(-0.5, 0, 0.5), (0.5, 0, 0.5)], sections=corners)


def _limb(top_share: float) -> trimesh.Trimesh:
    """A six-sided limb, `top_share` as wide at its top as at its foot."""
    limb = trimesh.creation.cylinder(radius=0.5, segment=[(0, 0, 0), (0, 0, 1)], sections=6)
    limb.vertices[limb.vertices[:, 2] > 0.5, :2] *= top_share
    return limb


def _egg() -> trimesh.Trimesh:
    """A coarse ball."""
    egg = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    egg.apply_translation([0, 0, 0.5])
    return egg


def _gable() -> trimesh.Trimesh:
    """A roof with its ridge along y."""
    return trimesh.convex.convex_hull(np.array([(x, y, 0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)] + [(0, -0.5, 1), (0, 0.5, 1)]))


def _hip() -> trimesh.Trimesh:
    """A roof that slopes on all four sides."""
    return trimesh.convex.convex_hull(np.array([(x, y, 0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)] + [(0, -0.25, 1), (0, 0.25, 1)]))


def _upright_disc(corners: int) -> trimesh.Trimesh:
    """A thin plate with its face along y, standing on z = 0: a round or triangular sign."""
    disc = trimesh.creation.cylinder(radius=0.5, segment=[(0, -0.5, 0.5), (0, 0.5, 0.5)], sections=corners)
    return disc


def _leaves(seed: int, count: int, size: float, blobs: int, droop: float) -> trimesh.Trimesh:
    """A crown of loose triangles round the shells of some blobs, in a unit box: ragged outside, gaps between.

    Args:
        seed: Which crown.
        count: Triangles.
        size: Their side, relative to the box.
        blobs: How many balls of leaves make the crown.
        droop: How much wider the crown is at its foot, as conifers are, [0, 1].
    """
    rng = np.random.default_rng(seed)
    radius = rng.uniform(0.18, 0.28, blobs) if blobs > 1 else np.array([0.47])
    center = _unit(rng.standard_normal((blobs, 3))) * (0.48 - radius)[:, None] * rng.uniform(0.55, 1, (blobs, 1))
    which = rng.choice(blobs, 4 * count, p=radius**2 / (radius**2).sum())
    outward = _unit(rng.standard_normal((4 * count, 3)))
    middle = center[which] + outward * (radius[which] * rng.uniform(0.75, 1.08, 4 * count))[:, None]
    # Nobody sees the leaves inside other blobs.
    outside = (np.linalg.norm(middle[:, None] - center, axis=2) > 0.74 * radius).all(axis=1)
    middle, outward = middle[outside][:count], outward[outside][:count]
    # Leaves lie roughly along their shell: two axes across the outward direction, shaken.
    across = _unit(np.cross(outward, rng.standard_normal(outward.shape)))
    along = np.cross(outward, across) + 0.5 * outward * rng.standard_normal((len(outward), 1))
    reach = size * rng.uniform(0.6, 1.4, (len(outward), 1))
    offsets = along, across - 0.5 * along, -across - 0.5 * along
    corners = np.stack([middle + reach * offset for offset in offsets], axis=1).reshape(-1, 3) + (0, 0, 0.5)
    corners[:, :2] *= (1 - droop * (1.6 * corners[:, 2:] - 0.6)).clip(0.05)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


CROWNS = 5  # different crowns of each kind
LEAF_DETAIL = ((60, 0.15), (170, 0.09), (700, 0.045), (2600, 0.024))  # from far to near: how many leaves, how big
BODIES = {"hatchback": (-0.42, 0.12), "saloon": (-0.22, 0.14), "estate": (-0.46, 0.14), "van": (-0.49, 0.3)}

SHAPES |= {
    "car_body": _car_body,
    "wheel": partial(_wheel, 14),
    "far_wheel": partial(_wheel, 6),
    "limb": partial(_limb, 0.8),
    "leg": partial(_limb, 1.35),
    "egg": _egg,
    "gable": _gable,
    "hip": _hip,
    "disc": partial(_upright_disc, 14),
    "triangle": partial(_upright_disc, 3),
    **{f"{name}_cabin": partial(_cabin, *top) for name, top in BODIES.items()},
    **{f"{name}_roof": partial(_roof, *top) for name, top in BODIES.items()},
    **{
        f"{kind}{detail}{n}": partial(_leaves, n, int(share * count), size / share**0.5, blobs, droop)
        for n in range(CROWNS)
        for kind, share, blobs, droop in (("crown", 1.0, 14, 0.0), ("conifer", 0.7, 1, 0.95), ("bush", 0.4, 6, 0.0))
        for detail, (count, size) in enumerate(LEAF_DETAIL)
    },
}


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
    paint = Material(CAR_PAINTS[rng.integers(len(CAR_PAINTS))], gloss=0.55)
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
    grey = tuple((rng.choice([0.12, 0.3, 0.55, 0.7]) * rng.uniform(0.75, 1, 3)).tolist())
    body = Material(grey, "corrugated", (0.3, 0.3, 0.3), 0.6)
    cab = Material(CAR_PAINTS[rng.integers(len(CAR_PAINTS))], gloss=0.4)
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
    coat, trousers = (Material(tuple(rng.uniform(0.02, 0.3) * rng.uniform(0.4, 1, 3)), "fabric") for _ in range(2))
    skin, hair = Material((0.35, 0.2, 0.14)), Material(tuple(rng.uniform(0.01, 0.12) * np.array([1, 0.7, 0.4])))
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
    tint = tuple((rng.uniform(0.8, 1.25) * np.array(color)).tolist())
    leaf = Material(tint, "foliage", second, 2.5, seed=int(rng.integers(99)), variation=0.4)
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
    leaf = Material(color, "foliage", second, 1.5, seed=int(rng.integers(99)), variation=0.4)
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
    post = Part("rod", (0.07, 0.07, tall + 0.5), (0, 0, 0), STEEL)
    kind = rng.integers(4)
    if kind == 0:
        return [post, Part("disc", (0.62, 0.02, 0.62), (0, -0.05, tall), red), Part("disc", (0.46, 0.03, 0.46), (0, -0.055, tall + 0.08), WHITE)]
    if kind == 1:
        return [post, Part("triangle", (0.8, 0.02, 0.8), (0, -0.05, tall), red), Part("triangle", (0.5, 0.03, 0.5), (0, -0.055, tall + 0.15), WHITE)]
    if kind == 2:
        return [post, Part("disc", (0.6, 0.02, 0.6), (0, -0.05, tall), blue), Part("box", (0.1, 0.03, 0.34), (0, -0.055, tall + 0.13), WHITE)]
    size = rng.uniform(0.5, 1.1)
    return [post, Part("box", (size, 0.03, 0.6), (0, -0.05, tall), WHITE), Part("box", (0.8 * size, 0.04, 0.16), (0, -0.055, tall + 0.3), blue)]


def traffic_light(rng: np.random.Generator) -> list[Part]:
    """A signal on its post."""
    lamps = [((0.4, 0.02, 0.01), 0.62), ((0.12, 0.07, 0.01), 0.36), ((0.01, 0.1, 0.06), 0.1)]
    return [
        Part("rod", (0.12, 0.12, 3.3), (0, 0, 0), STEEL),
        Part("box", (0.3, 0.22, 0.9), (0, -0.12, 2.4), DARK_STEEL),
        *(Part("disc", (0.2, 0.02, 0.2), (0, -0.24, 2.4 + up), Material(color, gloss=0.3)) for color, up in lamps),
    ]


def bin_or_box(rng: np.random.Generator) -> list[Part]:
    """A dustbin or a cabinet at the kerb."""
    color = [(0.03, 0.05, 0.03), (0.05, 0.05, 0.055), (0.25, 0.25, 0.23), (0.3, 0.22, 0.02)][rng.integers(4)]
    wide, tall = rng.uniform(0.5, 1.1), rng.uniform(0.9, 1.4)
    return [Part("box", (0.5, wide, tall), (0, 0, 0), Material(color, "plaster", (0.1, 0.1, 0.1), 2.0, gloss=0.1))]
