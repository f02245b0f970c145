"""Pictures that lie on a scene's objects, in the terms in which the ray-caster knows patterns."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from depthreg.worlds.scene import SceneObject
from depthreg.worlds.textures import LINEAR, TILE


@dataclass(frozen=True)
class Pictures:
    """All pictures of a scene. O objects.

    Attributes:
        texels: Of one picture after the other, (R, 3) uint8.
        start: Row where each object's picture starts, -1 where it has none, (O,) int32.
        texels_per_m: Density of each object's picture, (O,) float32; 0 where it has none.
        uv: Where the corners of the faces lie in their pictures, (F, 3, 2), of the objects with pictures alone.
    """

    texels: np.ndarray
    start: np.ndarray
    texels_per_m: np.ndarray
    uv: np.ndarray

    def lay(self, color: np.ndarray, tint: np.ndarray, object_id: np.ndarray, texel: np.ndarray) -> None:
        """Replace the colours of points on objects that have a picture.

        Args:
            color: Linear, of M points, (3, M); changed in place.
            tint: Multiplies the picture, (3, M).
            object_id: (M,).
            texel: Number of the texel within its texture, (M,).
        """
        start = self.start.take(object_id)
        there = np.flatnonzero(start >= 0)
        bytes_there = self.texels.take(start.take(there) + texel.take(there), axis=0)
        color[:, there] = LINEAR.take(bytes_there).T * tint.take(there, axis=1)


def gather_pictures(objects: Sequence[SceneObject]) -> Pictures | None:
    """The pictures of some objects; None where none has one, so that nothing need be looked up."""
    starts: dict[int, int] = {}  # by the texels' identity: objects share them
    texels: list[np.ndarray] = []
    start = np.full(len(objects), -1, dtype=np.int32)
    density = np.zeros(len(objects), dtype=np.float32)
    for number, thing in enumerate(objects):
        if thing.picture is None:
            continue
        key = id(thing.picture.texels)
        if key not in starts:
            starts[key] = sum(map(len, texels))
            texels.append(thing.picture.texels)
        start[number], density[number] = starts[key], TILE * thing.picture.tiles_per_m
    if not texels:
        return None
    uv = np.concatenate([thing.picture.uv for thing in objects if thing.picture is not None])
    return Pictures(np.concatenate(texels), start, density, uv)


def texture_rows(corners: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """What makes texture coordinates of a point on each face: they are affine functions of it.

    Args:
        corners: Of each face, (F, 3, 3).
        uv: The texture coordinates there, (F, 3, 2).

    Returns:
        Axis and offset of u, axis and offset of v, (8, F).
    """
    corners = corners.astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]  # (F, 2, 3)
    normal = np.cross(edges[:, 0], edges[:, 1])
    dual = np.stack([np.cross(edges[:, 1], normal), np.cross(normal, edges[:, 0])], axis=1)
    dual /= np.einsum("fk,fk->f", normal, normal).clip(1e-30)[:, None, None]
    axes = np.einsum("fek,fea->fak", dual, uv[:, 1:] - uv[:, :1])  # (F, 2, 3): gradients of u and v
    offset = uv[:, 0] - np.einsum("fak,fk->fa", axes, corners[:, 0])
    # Whole tiles don't matter, but cost float32 its digits.
    return np.concatenate([axes, (offset % 1)[..., None]], axis=-1).reshape(-1, 8).T
