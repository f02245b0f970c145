"""Unit solids that only streets need, added to `shapes.SHAPES`: parts of cars, roofs, limbs, signs, crowns."""

from functools import partial

import numpy as np
import trimesh

from depthreg.worlds.shapes import SHAPES

CROWNS = 5  # different crowns of each kind
LEAF_DETAIL = ((60, 0.15), (170, 0.09), (700, 0.045), (2600, 0.024))  # from far to near: how many leaves, how big
BODIES = {"hatchback": (-0.42, 0.12), "saloon": (-0.22, 0.14), "estate": (-0.46, 0.14), "van": (-0.49, 0.3)}


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
    top = _loft(
        [
            (rear_top - 0.02, 0.36, 0.9, 0.97),
            (rear_top + 0.03, 0.41, 0.93, 1.04),
            (front_top - 0.06, 0.41, 0.93, 1.04),
            (front_top + 0.02, 0.37, 0.9, 0.96),
        ]
    )
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


def _pitched(ridge: float) -> trimesh.Trimesh:
    """A roof with its ridge along y, `ridge` long: 1 makes gables, less makes all four sides slope."""
    eaves = [(x, y, 0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    return trimesh.convex.convex_hull(np.array([*eaves, (0, -ridge / 2, 1), (0, ridge / 2, 1)]))


def _upright_disc(corners: int) -> trimesh.Trimesh:
    """A thin plate with its face along y, standing on z = 0: a round or triangular sign."""
    return trimesh.creation.cylinder(radius=0.5, segment=[(0, -0.5, 0.5), (0, 0.5, 0.5)], sections=corners)


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
    corners = np.stack([middle + reach * offset for offset in offsets], axis=1).reshape(-1, 3)
    corners[:, 2] += 0.5
    corners[:, :2] *= (1 - droop * (1.6 * corners[:, 2:] - 0.6)).clip(0.05)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


SHAPES.update(
    {
        "car_body": _car_body,
        "wheel": partial(_wheel, 14),
        "far_wheel": partial(_wheel, 6),
        "limb": partial(_limb, 0.8),
        "leg": partial(_limb, 1.35),
        "egg": _egg,
        "gable": partial(_pitched, 1.0),
        "hip": partial(_pitched, 0.5),
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
)
