"""Simple solids, put together into scene objects.

Every unit solid stands on the floor: x and y in [-0.5, 0.5], z in [0, 1]. A thing is a list of parts in its
own frame; `assemble` stands it somewhere in the world.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import trimesh

from depthreg.worlds.scene import Material, SceneObject

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """A solid of one material, in the frame of the thing that it belongs to."""

    shape: str  # a key of SHAPES
    size_m: Vector  # along its own x, y, z
    at_m: Vector  # middle of its base
    material: Material
    yaw_deg: float = 0.0  # about its own upright axis, counter-clockwise from above

    def moved(self, by_m: Vector) -> "Part":
        """The same part elsewhere."""
        x, y, z = self.at_m
        return replace(self, at_m=(x + by_m[0], y + by_m[1], z + by_m[2]))


def _box() -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[(-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)])


def _cylinder(sections: int = 24) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius=0.5, segment=[(0, 0, 0), (0, 0, 1)], sections=sections)


def _sphere(subdivisions: int = 3) -> trimesh.Trimesh:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    sphere.apply_translation([0, 0, 0.5])
    return sphere


def _frustum(base_width: float, top_width: float) -> trimesh.Trimesh:
    frustum = _cylinder()
    widths = np.where(frustum.vertices[:, 2] > 0.5, top_width, base_width)
    frustum.vertices[:, :2] *= widths[:, None]
    return frustum


def _wedge() -> trimesh.Trimesh:
    """A ramp that rises along y."""
    corners = [(x, y, z) for x in (-0.5, 0.5) for y, z in ((-0.5, 0), (0.5, 0), (0.5, 1))]
    return trimesh.convex.convex_hull(np.array(corners))


def _bowl() -> trimesh.Trimesh:
    """A thin shell, open at the top."""
    profile = [(0, 0), (0.3, 0), (0.45, 0.4), (0.5, 1), (0.47, 1), (0.42, 0.45), (0.27, 0.08), (0, 0.08)]
    return trimesh.creation.revolve(np.array(profile), sections=20)


def _bottle() -> trimesh.Trimesh:
    profile = [(0, 0), (0.5, 0), (0.5, 0.55), (0.42, 0.66), (0.18, 0.78), (0.18, 0.96), (0.24, 1), (0, 1)]
    return trimesh.creation.revolve(np.array(profile), sections=16)


def _foliage(leaves: int = 60) -> trimesh.Trimesh:
    """Pointed leaves that grow outwards and upwards from the middle of the base."""
    rng = np.random.default_rng(0)
    azimuth, lift = rng.uniform(0, 2 * np.pi, leaves), rng.uniform(0.1, 1.4, leaves)
    outwards = np.stack([np.cos(azimuth) * np.cos(lift), np.sin(azimuth) * np.cos(lift), np.sin(lift)], axis=1)
    sideways = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(leaves)], axis=1)
    reach = rng.uniform(0.5, 1.0, leaves)[:, None]
    tip, widest = outwards * reach, outwards * reach * 0.6 + [0, 0, 0.08]
    corners = np.stack([outwards * reach * 0.2, widest - 0.07 * sideways, tip, widest + 0.07 * sideways], axis=1)
    faces = (4 * np.arange(leaves)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    return trimesh.Trimesh(corners.reshape(-1, 3) * (0.5, 0.5, 1.0), faces, process=False)


SHAPES = {
    "box": _box,
    "cylinder": _cylinder,
    "rod": lambda: _cylinder(8),
    "sphere": _sphere,
    "ball": lambda: _sphere(2),
    "cone": lambda: _frustum(1.0, 0.05),
    "shade": lambda: _frustum(1.0, 0.65),
    "pot": lambda: _frustum(0.75, 1.0),
    "wedge": _wedge,
    "bowl": _bowl,
    "bottle": _bottle,
    "foliage": _foliage,
}


@cache
def unit_mesh(shape: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a unit solid; shared by all callers, so not to be written to."""
    mesh = SHAPES[shape]()
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    vertices.setflags(write=False)
    faces.setflags(write=False)
    return vertices, faces


def _stand(points: np.ndarray, at_m: Vector, yaw_deg: float) -> np.ndarray:
    """Turn points (V, 3) about the upright axis, then move them."""
    if yaw_deg:
        cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
        points = points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return points + np.asarray(at_m)


def join(parts: list[Part], at_m: Vector = (0, 0, 0), yaw_deg: float = 0.0) -> trimesh.Trimesh:
    """One mesh of all parts, whatever their materials, that stands at `at_m` and is turned by `yaw_deg`."""
    vertices, faces, first = [], [], 0
    for part in parts:
        unit_vertices, unit_faces = unit_mesh(part.shape)
        vertices.append(_stand(unit_vertices * part.size_m, part.at_m, part.yaw_deg))
        faces.append(unit_faces + first)
        first += len(unit_vertices)
    standing = _stand(np.concatenate(vertices), at_m, yaw_deg)
    return trimesh.Trimesh(standing, np.concatenate(faces), process=False)


def assemble(name: str, parts: list[Part], at_m: Vector = (0, 0, 0), yaw_deg: float = 0.0) -> list[SceneObject]:
    """Stand a thing in the world.

    Args:
        name: Class of the thing, "table".
        parts: Its solids, in its own frame.
        at_m: Where the origin of its frame goes.
        yaw_deg: Turn about the upright axis, counter-clockwise from above.

    Returns:
        One object for each material, in the order in which the materials appear.
    """
    by_material: dict[Material, list[Part]] = {}
    for part in parts:
        by_material.setdefault(part.material, []).append(part)
    return [SceneObject(name, join(same, at_m, yaw_deg), material) for material, same in by_material.items()]
