"""A scene as tables: one merged mesh for Embree, and what each face and each object looks like."""

from dataclasses import dataclass

import numpy as np

from depthreg.rendering.embree import RayTree
from depthreg.rendering.pictures import Pictures, gather_pictures, texture_rows
from depthreg.worlds.scene import Light, Material, Scene
from depthreg.worlds.textures import LEVEL_START, PATTERNS, TEXELS, TILE, texture_start

_LIFT_M = 2e-3  # shadow rays start this far off their surface, or it would shade itself
_LAMP_AT_M = 2.0  # a lamp's brightness is stated at this distance


@dataclass(frozen=True)
class Hits:
    """Where rays first meet a surface. M hits; vectors are (3, M), because NumPy is quick along the last axis only
    (and `take` along it keeps that layout, where indexing doesn't).

    Attributes:
        ray: Which ray, (M,) int64.
        face: (M,) int32.
        range_m: Distance from the ray's origin, (M,) float32.
        direction: Of the ray, unit, world axes, (3, M) float32.
        point: Relative to the scene's origin, (3, M) float32.
        normal: Unit, world axes, facing the ray's origin, (3, M) float32.
        cos_incidence: 1 = head-on, (M,) float32 in [0, 1].
    """

    ray: np.ndarray
    face: np.ndarray
    range_m: np.ndarray
    direction: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    cos_incidence: np.ndarray

    def take(self, some: np.ndarray) -> "Hits":
        """Some of the hits, by their numbers."""
        return Hits(*(values.take(some, axis=-1) for values in vars(self).values()))


@dataclass(frozen=True)
class Surfaces:
    """All surfaces of a scene, relative to `origin_m`, so that float32 suffices. F faces, O objects.

    Attributes:
        tree: Embree's tree over all faces.
        origin_m: World position of the tables' origin, (3,).
        normal: Unit normals in world axes that face the origin, (3, F) float32.
        object_id: (F,) int32.
        texture: What makes texture coordinates (in tiles) of a point, and brightness, (9, F) float32: axis and offset
            of u, axis and offset of v, brightness.
        texels_per_m: Density of each object's finest texture level, (O,) float32.
        texture_start: Row of `TEXELS` where each object's texture starts, (O,) int32.
        paint: Colour, difference to the second colour, gloss of each object, (7, O) float32.
        pictures: What lies on objects in place of a pattern; None where nothing does.
    """

    tree: RayTree
    origin_m: np.ndarray
    normal: np.ndarray
    object_id: np.ndarray
    texture: np.ndarray
    texels_per_m: np.ndarray
    texture_start: np.ndarray
    paint: np.ndarray
    pictures: Pictures | None = None

    def cast(self, origin: np.ndarray, rays: np.ndarray) -> Hits:
        """First hits of rays.

        Args:
            origin: Where all rays start, (3,), or each of them, (N, 3), relative to `origin_m`.
            rays: Unit directions in world axes, (N, 3) float32.
        """
        origin, rays = origin.astype(np.float32, copy=False).T, np.ascontiguousarray(rays.T)
        faces, ranges_m = self.tree.first_hits(origin, rays)
        ray = np.flatnonzero(faces >= 0)
        face, range_m, direction = faces.take(ray), ranges_m.take(ray), rays.take(ray, axis=1)
        normal = self.normal.take(face, axis=1)
        cos = np.einsum("kn,kn->n", normal, direction)
        normal *= -np.sign(cos)
        start = origin[:, None] if origin.ndim == 1 else origin.take(ray, axis=1)
        point = start + range_m * direction
        return Hits(ray, face, range_m, direction, point, normal, np.abs(cos).clip(max=1))

    def sunlight(self, hits: Hits, light: Light) -> np.ndarray:
        """Share of the sun's (or the lamp's) light that arrives at hits, (M,) float32.

        That is the cosine between normal and light, 0 where the surface turns away or something is in between; a lamp's
        light also falls with the square of the distance.
        """
        start = hits.point + _LIFT_M * hits.normal
        if light.lamp_m is None:
            towards = light.sun_direction.astype(np.float32)[:, None]
            reach_m = np.full(1, np.inf, dtype=np.float32)
            arriving = (towards[:, 0] @ hits.normal).clip(0)
        else:
            to_lamp = (light.lamp_m - self.origin_m).astype(np.float32)[:, None] - start
            reach_m = np.sqrt(np.einsum("kn,kn->n", to_lamp, to_lamp)).clip(_LIFT_M)
            towards = to_lamp / reach_m
            arriving = (_LAMP_AT_M / reach_m) ** 2 * np.einsum("kn,kn->n", hits.normal, towards).clip(0)
        facing = np.flatnonzero(arriving)
        towards, reach_m = np.broadcast_to(towards, start.shape), np.broadcast_to(reach_m, len(arriving))
        shaded = self.tree.blocked(start.take(facing, axis=1), towards[:, facing], reach_m[facing])
        arriving[facing[shaded]] = 0
        return arriving

    def albedo(self, hits: Hits, pixel_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """Colour (3, M) and gloss (M,) of the surfaces hit, averaged over what one pixel sees of them.

        Args:
            hits: Where to look.
            pixel_rad: Angle that a pixel (or a LiDAR's beam) covers.
        """
        table, obj = self.texture.take(hits.face, axis=1), self.object_id.take(hits.face)
        # A slanted pixel footprint is long but narrow: the geometric mean of both neither blurs nor flickers much.
        footprint_m = pixel_rad * hits.range_m / np.sqrt(hits.cos_incidence.clip(0.02))
        texels = (footprint_m * self.texels_per_m.take(obj)).clip(1, TILE)
        level = np.frexp(texels)[1] - 1  # the whole part of its binary logarithm
        size = np.right_shift(TILE, level)
        u = np.einsum("kn,kn->n", hits.point, table[0:3]) + table[3]
        v = np.einsum("kn,kn->n", hits.point, table[4:7]) + table[7]
        column, row = (np.floor(t * size).astype(np.int32) & (size - 1) for t in (u, v))
        number = LEVEL_START.take(level) + row * size + column
        texel = TEXELS.take(self.texture_start.take(obj) + number, axis=0)
        mix, shade, gloss = np.multiply(texel[:, :3].T, np.float32(1 / 255), order="C")
        paint = self.paint.take(obj, axis=1)
        color = (paint[:3] + mix * paint[3:6]) * (2 * shade * table[8])
        if self.pictures is not None:
            self.pictures.lay(color, paint[:3], obj, number)
        return color, gloss * paint[6]


def _texture_axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit axes (F, 3) across and up each face; x and y on level ground."""
    level = np.abs(normal[:, 2]) > 0.98
    x, y, z = normal.T
    steep = np.hypot(x, y).clip(1e-9)  # the cosine of the angle between `up` and upright
    across = np.stack([-y / steep, x / steep, np.zeros_like(x)], axis=1)
    across[level] = [1.0, 0.0, 0.0]
    up = np.stack([-x * z / steep, -y * z / steep, steep], axis=1)
    up[level] = [0.0, 1.0, 0.0]
    return across, up


def _texture_table(
    normal: np.ndarray, object_id: np.ndarray, materials: list[Material], origin_m: np.ndarray
) -> np.ndarray:
    tiles_per_m = np.array([1 / (m.scale_m * PATTERNS[m.pattern].repeats) for m in materials])
    anchor = origin_m - np.array([m.origin_m for m in materials])
    # Low-discrepancy steps spread the seeds' shifts over the tile; seed 0 starts at the pattern's origin.
    shift = np.outer([m.seed for m in materials], [0.7548776662, 0.5698402910])
    table = np.empty((9, len(normal)), dtype=np.float32)
    for number, axis in enumerate(_texture_axes(normal)):
        axis = axis * tiles_per_m[object_id, None]
        offset = np.einsum("nk,nk->n", anchor[object_id], axis) + shift[object_id, number]
        table[4 * number : 4 * number + 3] = axis.T
        table[4 * number + 3] = offset % 1
    variation = np.array([m.variation for m in materials])
    table[8] = 1 + variation[object_id] * np.random.default_rng(0).uniform(-1, 1, len(normal))
    return table


def merge(scene: Scene, origin_m: np.ndarray) -> Surfaces:
    """Merge a scene's objects into tables around `origin_m` (3,)."""
    vertices = [np.asarray(o.mesh.vertices) for o in scene.objects]
    faces = [np.asarray(o.mesh.faces) for o in scene.objects]
    first = np.cumsum([0] + [len(v) for v in vertices[:-1]])
    object_id = np.repeat(np.arange(len(faces), dtype=np.int32), [len(f) for f in faces])
    corners = np.concatenate([f + offset for f, offset in zip(faces, first, strict=True)]).astype(np.int32)
    points = (np.concatenate(vertices) - origin_m).astype(np.float32)

    a, b, c = points[corners.T]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-12)
    away = np.einsum("nk,nk->n", normal, a) > 0
    materials = [o.material for o in scene.objects]
    paint = np.array([(*m.color, *m.second_color, m.gloss) for m in materials], dtype=np.float32).T
    paint[3:6] -= paint[:3]
    texture = _texture_table(normal, object_id, materials, origin_m)
    texels_per_m = np.array([TILE / (m.scale_m * PATTERNS[m.pattern].repeats) for m in materials], dtype=np.float32)
    laid = gather_pictures(scene.objects)
    if laid is not None:
        rows = np.flatnonzero(laid.start[object_id] >= 0)
        texture[:8, rows] = texture_rows(points[corners[rows]], laid.uv)
        texels_per_m = np.where(laid.start >= 0, laid.texels_per_m, texels_per_m)
    return Surfaces(
        tree=RayTree(points, corners),
        origin_m=origin_m,
        normal=np.where(away, -normal.T, normal.T),
        object_id=object_id,
        texture=texture,
        texels_per_m=texels_per_m,
        texture_start=np.array([texture_start(m.pattern) for m in materials], dtype=np.int32),
        paint=np.ascontiguousarray(paint),
        pictures=laid,
    )
