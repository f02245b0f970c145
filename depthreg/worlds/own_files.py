"""Scene files of a user's own, as objects of a world: glTF, OBJ, PLY, STL, and what Blender saves."""

import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from depthreg.errors import InputError
from depthreg.rendering import blender
from depthreg.worlds.gltf_camera import gltf_camera
from depthreg.worlds.scene import RGB, Material, Picture, SceneObject
from depthreg.worlds.textures import palette_texels, picture_texels

_KINDS = (".glb", ".gltf", ".obj", ".ply", ".stl", ".blend")
_Y_UP_KINDS = (".glb", ".gltf", ".blend")  # by their standard; Blender's files come by way of glTF
# A world of right, forward and up, from axes of right, up and backward.
_WORLD_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
_GREY: RGB = (0.5, 0.5, 0.5)  # of what has no colour
_EXPORT_S = 600.0  # Blender may need that long for a large scene


@dataclass(frozen=True)
class SceneFile:
    """What a file holds, in world coordinates.

    Attributes:
        objects: At least one, each of at least one triangle.
        world_from_camera: Pose of its first camera (x right, y down, z forward), (4, 4) rigid; None without one.
    """

    objects: list[SceneObject]
    world_from_camera: np.ndarray | None


def read_scene_file(path: str, up: str, scale: float) -> SceneFile:
    """Read a scene; the same file is read once in a process.

    Args:
        path: Of a file of one of the kinds that the error message names.
        up: Which of the file's axes is up, "y" or "z"; in glTF it is always y.
        scale: Metres in one of the file's units.

    Raises:
        InputError: The file is missing, of another kind, can't be read or holds no triangle; or it is Blender's, and
            Blender isn't there.
    """
    place = Path(path).expanduser()
    if place.suffix.lower() not in _KINDS:
        raise InputError(f"world.path={path}: expected a scene file, {', '.join(_KINDS[:-1])} or {_KINDS[-1]}")
    if not place.is_file():
        raise InputError(f"world.path={path}: no such file; expected a scene ({', '.join(_KINDS)})")
    return _read(place, place.stat().st_mtime_ns, up, scale)


@lru_cache(maxsize=4)
def _read(path: Path, changed_ns: int, up: str, scale: float) -> SceneFile:
    """Read what there is at a path since a time."""
    kind = path.suffix.lower()
    content, camera = _exported(path) if kind == ".blend" else _loaded(path, path)
    world_from_file = _WORLD_FROM_Y_UP if kind in _Y_UP_KINDS or up == "y" else np.eye(4)
    world_from_file = np.diag([scale, scale, scale, 1.0]) @ world_from_file
    objects = []
    for node in content.graph.nodes_geometry:
        pose, name = content.graph[node]
        if isinstance(content.geometry[name], trimesh.Trimesh):
            objects += _objects(name, content.geometry[name], world_from_file @ pose, kind in _Y_UP_KINDS)
    if not objects:
        raise InputError(f"world.path={path}: it holds no triangle; expected a scene with at least one")
    return SceneFile(objects, None if camera is None else _rigid_pose(world_from_file @ camera))


def _loaded(path: Path, named: Path) -> tuple[trimesh.Scene, np.ndarray | None]:
    """The content and the camera's pose of a file that the user knows by the name `named`."""
    try:
        return trimesh.load(path, force="scene", process=False), gltf_camera(path)
    except Exception as error:  # of whatever kind a broken file provokes in the readers of six formats
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"world.path={named} can't be read: expected a sound {named.suffix} file ({reason})"
        ) from error


def _exported(path: Path) -> tuple[trimesh.Scene, np.ndarray | None]:
    """The content of Blender's own file, turned into glTF by Blender."""
    python = blender.find_python()
    with tempfile.TemporaryDirectory(prefix="depthreg-blender-") as folder:
        exported = Path(folder) / "scene.glb"
        job = {"task": "export", "blend": str(path.absolute()), "out": str(exported)}
        try:
            blender.ask(python, job, _EXPORT_S)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise InputError(f"world.path={path} can't be read: expected a sound .blend file ({reason})") from error
        return _loaded(exported, path)


def _objects(name: str, mesh: trimesh.Trimesh, world_from_mesh: np.ndarray, linear: bool) -> list[SceneObject]:
    """A mesh in its place and with its look; none where it has no triangle of some size."""
    vertices = trimesh.transform_points(mesh.vertices, world_from_mesh)
    corners = vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    faces = np.flatnonzero((area > 0) & np.isfinite(area))
    if not len(faces):
        return []
    color, picture = _look(mesh, faces, float(area[faces].sum()), linear)
    placed = trimesh.Trimesh(vertices, mesh.faces[faces], process=False)
    return [SceneObject(name, placed, Material(color), picture)]


def _look(mesh: trimesh.Trimesh, faces: np.ndarray, area_m2: float, linear: bool) -> tuple[RGB, Picture | None]:
    """Colour and picture of some faces of a mesh; `linear` says that the file's colours (not pictures) are linear."""
    visual = mesh.visual
    if visual.kind == "texture":
        image, color = _image(visual.material), _factor(visual.material)
        uv = visual.uv
        if image is not None and uv is not None and len(uv) == len(mesh.vertices):
            corners_uv = np.asarray(uv, np.float64)[mesh.faces[faces]]
            edges = corners_uv[:, 1:] - corners_uv[:, :1]
            tiles = np.abs(np.linalg.det(edges)).sum() / 2
            return color, Picture(picture_texels(image), corners_uv, float(np.sqrt(tiles / area_m2)))
        colors = visual.vertex_attributes.get("color")
        if colors is None or len(colors) != len(mesh.vertices):
            return color, None
        shades = trimesh.visual.color.to_rgba(colors)[mesh.faces[faces], :3].mean(axis=1)
        return color, _palette(shades, linear)
    if visual.kind in ("vertex", "face"):
        return (1.0, 1.0, 1.0), _palette(visual.face_colors[faces, :3].astype(float), linear)
    return _GREY, None


def _image(material: Any) -> np.ndarray | None:
    """A material's picture, (H, W, 3) uint8, or None."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return None if image is None else np.asarray(image.convert("RGB"))


def _factor(material: Any) -> RGB:
    """A material's linear base colour; of OBJ's, what is left to say beside a picture is nothing."""
    if hasattr(material, "baseColorFactor"):
        factor = material.baseColorFactor
    else:
        factor = None if getattr(material, "image", None) is not None else getattr(material, "diffuse", None)
    r, g, b = (1.0, 1.0, 1.0) if factor is None else (np.asarray(factor[:3]) / 255).tolist()
    return r, g, b


def _palette(shades: np.ndarray, linear: bool) -> Picture:
    """Faces of a colour each: (F, 3) from 0 to 255."""
    if linear:
        shades = 255 * (shades / 255) ** (1 / 2.2)
    texels, uv = palette_texels(np.rint(shades).astype(np.uint8))
    return Picture(texels, uv, 0.0)


def _rigid_pose(world_from_camera: np.ndarray) -> np.ndarray:
    """A rigid pose with axes of right, down and forward, from one of right, up and backward that may be scaled."""
    pose = world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    return pose
