"""Scene files of a user's own, as objects of a world: glTF, OBJ, PLY, STL, and what Blender saves."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from depthreg.errors import InputError
from depthreg.rendering import blender
from depthreg.worlds.gltf_camera import gltf_camera
from depthreg.worlds.scene import RGB, Material, Picture, SceneObject
from depthreg.worlds.textures import GAMMA, palette_texels, picture_texels

_KINDS = (".glb", ".gltf", ".obj", ".ply", ".stl", ".blend")
_Y_UP_KINDS = (".glb", ".gltf", ".blend")  # by their standard; Blender's files come by way of glTF
# A world of right, forward and up, from axes of right, up and backward.
_WORLD_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
_GREY: RGB = (0.5, 0.5, 0.5)  # of what has no colour
_WHITE: RGB = (1.0, 1.0, 1.0)
_REASON_LENGTH = 200  # characters of what another library says of a broken file
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
    world_from_file = _WORLD_FROM_Y_UP if kind in _Y_UP_KINDS or up == "y" else np.eye(4)
    world_from_file = np.diag([scale, scale, scale, 1.0]) @ world_from_file
    looks = _Looks(linear=kind in _Y_UP_KINDS)
    with _naming(path):
        content, camera = _exported(path) if kind == ".blend" else _loaded(path)
        for node in content.graph.nodes_geometry:
            pose, name = content.graph[node]
            if isinstance(content.geometry[name], trimesh.Trimesh):
                looks.add(name, content.geometry[name], world_from_file @ pose)
    objects = looks.finished()
    if not objects:
        raise InputError(f"world.path={path}: it holds no triangle; expected a scene with at least one")
    return SceneFile(objects, None if camera is None else _rigid_pose(world_from_file @ camera))


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Say in one sentence which file is broken."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # of whatever kind a broken file provokes in the readers of six formats
        reason = " ".join(str(error).split())[:_REASON_LENGTH] or type(error).__name__
        raise InputError(f"world.path={path} can't be read: expected a sound {path.suffix} file ({reason})") from error


def _loaded(path: Path) -> tuple[trimesh.Scene, np.ndarray | None]:
    """The content of a file, and the pose of its camera."""
    return trimesh.load(path, force="scene", process=False), gltf_camera(path)


def _exported(path: Path) -> tuple[trimesh.Scene, np.ndarray | None]:
    """The same of Blender's own file, which Blender turns into glTF."""
    python = blender.find_python()
    with tempfile.TemporaryDirectory(prefix="depthreg-blender-") as folder:
        exported = Path(folder) / "scene.glb"
        job = {"task": "export", "blend": str(path.absolute()), "out": str(exported)}
        blender.ask(python, job, _EXPORT_S)
        return _loaded(exported)


class _Looks:
    """Gathers objects; those that show the same image share its texels, those with colours for faces one palette.

    Args:
        linear: Whether the file's colours are linear, as glTF's are; its pictures never are.
    """

    def __init__(self, linear: bool) -> None:
        self.linear = linear
        self.objects: list[SceneObject] = []
        self.shades: dict[int, np.ndarray] = {}  # of the faces, (F, 3) uint8, of the objects with these numbers
        self.texels: dict[int, np.ndarray] = {}  # by an image's identity
        self.images: list[Any] = []  # kept, or another image might get such an identity

    def add(self, name: str, mesh: trimesh.Trimesh, world_from_mesh: np.ndarray) -> None:
        """Put a mesh in its place; one without a triangle of some size is left out."""
        vertices = trimesh.transform_points(mesh.vertices, world_from_mesh)
        corners = vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        faces = np.flatnonzero((area > 0) & np.isfinite(area))
        if not len(faces):
            return
        color, shades = _colors(mesh, faces)
        picture = self._picture(mesh, faces, float(area[faces].sum()))
        if shades is not None and picture is None:
            self.shades[len(self.objects)] = _encoded(shades) if self.linear else shades
        placed = trimesh.Trimesh(vertices, mesh.faces[faces], process=False)
        self.objects.append(SceneObject(name, placed, Material(color), picture))

    def finished(self) -> list[SceneObject]:
        """All objects."""
        if self.shades:
            texels, uv = palette_texels(np.concatenate(list(self.shades.values())))
            ends = np.cumsum([len(shades) for shades in self.shades.values()])[:-1]
            for number, part in zip(self.shades, np.split(uv, ends), strict=True):
                self.objects[number] = replace(self.objects[number], picture=Picture(texels, part, 0.0))
        return self.objects

    def _picture(self, mesh: trimesh.Trimesh, faces: np.ndarray, area_m2: float) -> Picture | None:
        """The image on some faces, where there is one and it is said how it lies."""
        material, uv = getattr(mesh.visual, "material", None), getattr(mesh.visual, "uv", None)
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if image is None or uv is None or len(uv) != len(mesh.vertices):
            return None
        if id(image) not in self.texels:
            self.texels[id(image)] = picture_texels(np.asarray(image.convert("RGB")))
            self.images.append(image)
        corners_uv = np.nan_to_num(np.asarray(uv, np.float64))[mesh.faces[faces]]
        tiles = np.abs(np.linalg.det(corners_uv[:, 1:] - corners_uv[:, :1])).sum() / 2
        return Picture(self.texels[id(image)], corners_uv, float(np.sqrt(tiles / area_m2)))


def _colors(mesh: trimesh.Trimesh, faces: np.ndarray) -> tuple[RGB, np.ndarray | None]:
    """Linear colour of a whole mesh, and what it is multiplied by on some faces, (F, 3) uint8, or None."""
    visual = mesh.visual
    if visual.kind in ("vertex", "face"):
        return _WHITE, visual.face_colors[faces, :3]
    if visual.kind != "texture":
        return _GREY, None
    color, of_vertices = _material_color(visual.material), visual.vertex_attributes.get("color")
    if of_vertices is None or len(of_vertices) != len(mesh.vertices):
        return color, None
    rgba = trimesh.visual.color.to_rgba(of_vertices)
    return color, rgba[mesh.faces[faces], :3].mean(axis=1).astype(np.uint8)


def _material_color(material: Any) -> RGB:
    """A material's linear base colour; beside a picture, OBJ's isn't meant."""
    if hasattr(material, "baseColorFactor"):
        factor = material.baseColorFactor
    else:
        factor = None if getattr(material, "image", None) is not None else getattr(material, "diffuse", None)
    return _WHITE if factor is None else tuple((np.asarray(factor[:3]) / 255).tolist())


def _encoded(linear: np.ndarray) -> np.ndarray:
    """Linear colours as the bytes of a picture, both uint8."""
    return np.rint(255 * (linear / 255) ** (1 / GAMMA)).astype(np.uint8)


def _rigid_pose(world_from_camera: np.ndarray) -> np.ndarray:
    """A rigid pose with axes of right, down and forward, from one of right, up and backward that may be scaled."""
    pose = world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    return pose
