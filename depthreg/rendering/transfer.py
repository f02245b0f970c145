"""A scene as plain arrays, for a renderer in another process; the same tables that the ray-caster reads."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from depthreg.rendering.shading import sky
from depthreg.rendering.surfaces import Surfaces
from depthreg.worlds.scene import Light, Scene, SceneObject
from depthreg.worlds.textures import TEXELS, TILE, texture_start

_LAMP_AT_M = 2.0  # a lamp's brightness is stated at this distance
_SKY_SIZE = (1024, 2048)


def write_scene(path: Path, scene: Scene, surfaces: Surfaces) -> dict[str, Any]:
    """Write what there is, round the surfaces' origin, into an NPZ file.

    The file holds `vertices` (V, 3), `faces` (F, 3), texture coordinates `uv` (F, 3, 2) in tiles, the faces' colours
    `first` and `second` (F, 3), their `gloss` and `brightness` (F,), the number `image` (F,) of each face's texture,
    the textures `image0`... (H, W, 3) uint8 from their lowest row on, and the `sky` as an equirectangular picture.

    Returns:
        What fits a line of JSON: the light, and which images are patterns.
    """
    meshes = [o.mesh for o in scene.objects]
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    vertices = (np.concatenate([mesh.vertices for mesh in meshes]) - surfaces.origin_m).astype(np.float32)
    images: dict[str | int, np.ndarray] = {}  # by a pattern's name or by the picture's identity
    image = np.zeros(len(scene.objects), np.int32)
    for number, thing in enumerate(scene.objects):
        key = thing.material.pattern if thing.picture is None else id(thing.picture.texels)
        if key not in images:
            images[key] = _tile(thing)
        image[number] = list(images).index(key)
    materials = [o.material for o in scene.objects]
    owner = surfaces.object_id
    arrays: dict[str, Any] = {
        "vertices": vertices,
        "faces": faces.astype(np.int32),
        "uv": _texture_coordinates(vertices[faces], surfaces.texture),
        "first": np.array([m.color for m in materials], np.float32)[owner],
        "second": np.array([m.second_color for m in materials], np.float32)[owner],
        "gloss": np.array([m.gloss for m in materials], np.float32)[owner],
        "brightness": surfaces.texture[8],
        "image": image[owner],
        "sky": _panorama(scene.light),
    }
    arrays |= {f"image{number}": tile for number, tile in enumerate(images.values())}
    np.savez(path, **arrays)
    is_pattern = [isinstance(key, str) for key in images]
    return {"scene": str(path), "is_pattern": is_pattern, "light": _light(scene.light, surfaces.origin_m)}


def _texture_coordinates(corners: np.ndarray, table: np.ndarray) -> np.ndarray:
    """(F, 3, 2) float32, in tiles, of the faces' corners (F, 3, 3); `table` is `Surfaces.texture`."""
    axes = np.stack([table[0:3], table[4:7]])  # (2, 3, F)
    return np.einsum("fck,akf->fca", corners, axes) + table[[3, 7]].T[:, None]


def _tile(thing: SceneObject) -> np.ndarray:
    """A pattern's mix, shade and gloss, or a picture, at its finest, (TILE, TILE, 3) uint8."""
    texels = TEXELS[texture_start(thing.material.pattern) :, :3] if thing.picture is None else thing.picture.texels
    return texels[: TILE**2].reshape(TILE, TILE, 3)


def _panorama(light: Light) -> np.ndarray:
    """The sky all around, (H, W, 3) float32 from straight down up; its middle column looks along x."""
    height, width = _SKY_SIZE
    elevation = ((np.arange(height) + 0.5) / height - 0.5)[:, None] * np.pi
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
    )
    colors = sky(light, rays.reshape(3, -1).astype(np.float32))
    return np.ascontiguousarray(colors.T.reshape(height, width, 3))


def _light(light: Light, origin_m: np.ndarray) -> dict[str, Any]:
    """The light with its lamp relative to the origin, in plain numbers."""
    plain = {key: np.asarray(value).tolist() for key, value in asdict(light).items() if value is not None}
    lamp_m = None if light.lamp_m is None else (np.array(light.lamp_m) - origin_m).tolist()
    return {**plain, "lamp_m": lamp_m, "lamp_at_m": _LAMP_AT_M}
