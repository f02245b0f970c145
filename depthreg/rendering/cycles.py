"""Render with Blender's Cycles: light that bounces, in a separate process; slow, to compare and to fine-tune with."""

import tempfile
import time
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from depthreg.data.sample import Frame, OffsetView
from depthreg.errors import InputError
from depthreg.rendering import blender
from depthreg.rendering.camera import Camera
from depthreg.rendering.raycast import render_frame
from depthreg.rendering.scanners import ScanPattern
from depthreg.rendering.shading import develop
from depthreg.rendering.surfaces import merge
from depthreg.rendering.transfer import write_scene
from depthreg.worlds.scene import Light, Scene

_BLUR_PX = 1  # the lens blur looks one pixel beyond the image
_SKY_BEYOND_M = 250.0  # no sensor measures that far: depth counts as none


@dataclass(frozen=True)
class Geometry:
    """What Cycles' rays through the pixels' centres hit, without margin."""

    depth_m: np.ndarray  # (H, W) float32 z-depth, 0 = sky
    normal: np.ndarray  # (H, W, 3) float32, unit, camera coordinates, facing the camera; 0 in the sky
    object_id: np.ndarray  # (H, W) int32, -1 = sky


@dataclass(frozen=True)
class _View:
    """One picture to take, with `border_px` more pixels on each side than the camera's frame has."""

    name: str
    camera: Camera
    border_px: int
    rotation: np.ndarray  # the camera's axes in the world, (3, 3)
    position: np.ndarray  # relative to the scene's origin, (3,)
    exact: bool = False  # rays through the pixels' centres, for what they hit

    def job(self, folder: Path) -> dict[str, Any]:
        """What the Blender process needs to know of it."""
        camera, border = self.camera, self.border_px
        return {
            "out": str(folder / f"{self.name}.exr"),
            "width": camera.width + 2 * border,
            "height": camera.height + 2 * border,
            "focal_px": camera.focal_px,
            "center_px": (camera.intrinsics[:2, 2].astype(float) + border).tolist(),
            "rotation": self.rotation.tolist(),
            "position": self.position.tolist(),
            "exact": self.exact,
        }


@dataclass(frozen=True)
class Cycles:
    """Blender's path tracer in the ray-caster's place.

    Colours come from Cycles: the left, the right and the offset view. Depth, ids, normals, albedo, gloss and the LiDAR
    are the ray-caster's, which has no noise; `geometry` renders Cycles' own, to compare.

    Args:
        samples: Paths a pixel.
        denoise: Whether Intel's Open Image Denoise cleans the pictures.
        seed: Of the paths; the same seed gives the same noise.
        threads: Of one Blender; all cores where not given. Every loader's worker has a Blender of its own.
        timeout_s: How long one frame may take.
        python: Python that has bpy; see `depthreg.rendering.blender.find_python`.

    Raises:
        InputError: A number isn't positive, or (when called) Blender's Python isn't there.
    """

    samples: int = 16
    denoise: bool = True
    seed: int = 0
    threads: int | None = field(default=None, repr=False)
    timeout_s: float = field(default=1800.0, repr=False)
    python: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.samples <= 0 or self.timeout_s <= 0 or (self.threads is not None and self.threads <= 0):
            raise InputError(f"rendering needs positive samples, threads and timeout_s: {self}")

    def __call__(
        self,
        scene: Scene,
        camera: Camera,
        scan: ScanPattern | None,
        *,
        right: bool = True,
        rgb_from_depth: np.ndarray | None = None,
    ) -> Frame:
        """Render a frame; the arguments are those of `depthreg.rendering.render_frame`."""
        python = blender.find_python(self.python)
        frame = render_frame(scene, camera, scan, right=right, rgb_from_depth=rgb_from_depth)
        rotation = np.linalg.inv(scene.camera_from_world)[:3, :3]
        wide_px = camera.margin_px + _BLUR_PX
        views = [_View("left", camera, wide_px, rotation, np.zeros(3))]
        if right:
            views.append(_View("right", camera, _BLUR_PX, rotation, rotation[:, 0] * frame.baseline_m))
        if rgb_from_depth is not None:
            depth_from_rgb = np.linalg.inv(rgb_from_depth)
            turned, moved = rotation @ depth_from_rgb[:3, :3], rotation @ depth_from_rgb[:3, 3]
            views.append(_View("offset", camera, wide_px, turned, moved))
        layers = self._render(python, scene, views)[0]
        pictures = [_picture(layer, view, scene.light) for layer, view in zip(layers, views, strict=True)]
        frame = replace(frame, rgb=pictures[0])
        if right:
            frame = replace(frame, rgb_right=pictures[1])
        if rgb_from_depth is not None:
            frame = replace(frame, offset=OffsetView(pictures[-1], rgb_from_depth))
        return frame

    def geometry(self, scene: Scene, camera: Camera) -> Geometry:
        """What Cycles itself finds at the pixels' centres."""
        python = blender.find_python(self.python)
        rotation = np.linalg.inv(scene.camera_from_world)[:3, :3]
        view = _View("exact", camera, 0, rotation, np.zeros(3), exact=True)
        layer = self._render(python, scene, [view])[0][0]
        depth_m = layer["Depth.Z"]
        seen = depth_m < _SKY_BEYOND_M
        owner = np.repeat(np.arange(len(scene.objects)), [len(o.mesh.faces) for o in scene.objects])
        face = np.where(seen, layer["face.X"], 0).astype(np.int32)
        normal = np.stack([layer[f"Normal.{axis}"] for axis in "XYZ"], axis=-1) @ rotation.astype(np.float32)
        normal *= -np.sign(np.einsum("hwk,hwk->hw", normal, camera.rays()) * seen)[..., None]
        return Geometry(np.where(seen, depth_m, 0), normal, np.where(seen, owner[face], -1).astype(np.int32))

    def infrared(
        self,
        scene: Scene,
        camera: Camera,
        lamp_right_m: float = 0.0,
        pattern: np.ndarray | None = None,
        pattern_width: float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the two cameras see in the dark under a lamp of the instrument's own, light that bounces included.

        Without a pattern this is a time-of-flight camera's amplitude; with dots, an active stereo pair.

        Args:
            scene: What there is; its sun, lamp and sky are out, but what shines by itself, as windows, goes on shining.
            camera: The left camera, without its margin; the right one stands `baseline_m` beside it.
            lamp_right_m: How far to the right of the left camera the lamp stands, on the line of both.
            pattern: Light that the lamp throws, (N, N) in [0, 1], repeated all over; all of it where not given.
            pattern_width: Width of one repeat, as the tangent of an angle: 1 m of a wall 1 m away.

        Returns:
            Left and right, (H, W) float32 linear light; 1 is a white wall, head-on, 1 m from the lamp.
        """
        python = blender.find_python(self.python)
        rotation = np.linalg.inv(scene.camera_from_world)[:3, :3]
        baseline_m = camera.baseline_m or scene.baseline_m
        left = _View("left", camera, 0, rotation, np.zeros(3))
        right = _View("right", camera, 0, rotation, rotation[:, 0] * baseline_m)
        lamp = {"position": (rotation[:, 0] * lamp_right_m).tolist(), "rotation": rotation.tolist()}
        lamp |= {"pattern_width": pattern_width}
        layers, _ = replace(self, denoise=False)._render(python, scene, [left, right], lamp, pattern)
        images = [np.mean([layer[f"Combined.{channel}"] for channel in "RGB"], axis=0) for layer in layers]
        return images[0], images[1]

    def frame_seconds(self, scene: Scene, camera: Camera) -> tuple[float, float]:
        """Wall and CPU time that a frame's left and right picture take, without starting Blender."""
        python = blender.find_python(self.python)
        rotation = np.linalg.inv(scene.camera_from_world)[:3, :3]
        baseline_m = camera.baseline_m or scene.baseline_m
        left = _View("left", camera, camera.margin_px + _BLUR_PX, rotation, np.zeros(3))
        self._render(python, scene, [replace(left, camera=Camera(8, 8, 8.0))])
        start_s = time.perf_counter()
        views = [left, _View("right", camera, _BLUR_PX, rotation, rotation[:, 0] * baseline_m)]
        _, cpu_s = self._render(python, scene, views)
        return time.perf_counter() - start_s, cpu_s

    def _render(
        self,
        python: Path,
        scene: Scene,
        views: list[_View],
        lamp: dict[str, Any] | None = None,
        pattern: np.ndarray | None = None,
    ) -> tuple[list[dict[str, np.ndarray]], float]:
        """The layers of each view, (H, W) float32 by names such as "Combined.R", and Blender's CPU time in seconds.

        A lamp with its pattern takes the place of all light in the scene.
        """
        with tempfile.TemporaryDirectory(prefix="depthreg-blender-") as name:
            folder = Path(name)
            surfaces = merge(scene, np.linalg.inv(scene.camera_from_world)[:3, 3])
            job = write_scene(folder / "scene.npz", scene, surfaces)
            options = {"samples": self.samples, "denoise": self.denoise, "seed": self.seed, "threads": self.threads}
            jobs = [view.job(folder) for view in views]
            if pattern is not None:
                np.save(folder / "pattern.npy", pattern)
            if lamp:
                lamp = {**lamp, "pattern": None if pattern is None else str(folder / "pattern.npy")}
            task = {"task": "render", **job, **options, "views": jobs, "lamp": lamp}
            answer = blender.ask(python, task, self.timeout_s)
            return [_read_layers(Path(view["out"])) for view in jobs], answer["cpu_s"]


def _read_layers(path: Path) -> dict[str, np.ndarray]:
    """The layers of an EXR file that Blender wrote; names lose their view layer's."""
    with import_module("OpenEXR").File(str(path), separate_channels=True) as file:
        return {name.split(".", 1)[1]: channel.pixels for name, channel in file.channels().items()}


def _picture(layers: dict[str, np.ndarray], view: _View, light: Light) -> np.ndarray:
    """Fog, then the camera's own response, (H, W, 3) uint8 without the blur's border."""
    linear = np.stack([layers[f"Combined.{channel}"] for channel in "RGB"])
    if light.fog_per_m > 0:
        range_m = layers["Depth.Z"] * np.linalg.norm(view.camera.rays(view.border_px), axis=-1)
        clear = np.where(layers["Depth.Z"] < _SKY_BEYOND_M, np.exp(-light.fog_per_m * range_m), 1)
        haze = np.array(light.sky_horizon_rgb, np.float32)[:, None, None]
        linear = (haze + clear * (linear - haze)).astype(np.float32)
    return develop(np.ascontiguousarray(linear), light.exposure)
