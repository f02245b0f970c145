"""Cast rays with Embree: what perfect instruments would see of a scene."""

from dataclasses import replace

import numpy as np

from depthreg.data.sample import Frame
from depthreg.rendering.camera import Camera, ScanPattern
from depthreg.rendering.scan import no_returns, scan_scene
from depthreg.rendering.shading import develop, shade, sky
from depthreg.rendering.surfaces import Surfaces, merge
from depthreg.worlds.scene import Light, Scene

_SKY_BEYOND_M = 250.0  # no sensor measures that far: depth counts as none
_RAYS_AT_ONCE = 32768  # what fits a core's cache
_BORDER_PX = 1  # the lens blur looks one pixel beyond the image


def render_frame(scene: Scene, camera: Camera, scan: ScanPattern | None, *, right: bool = True) -> Frame:
    """Render everything that perfect instruments would see.

    Args:
        scene: What there is.
        camera: The left colour camera, at the scene's camera pose.
        scan: The LiDAR's beams; none gives no returns.
        right: Whether to render the right camera's image; without, it has no pixels: (0, 0, 3).
    """
    world_from_camera = np.linalg.inv(scene.camera_from_world)
    rotation = world_from_camera[:3, :3].astype(np.float32)
    surfaces = merge(scene, world_from_camera[:3, 3])
    margin = camera.margin_px
    rgb, depth_m, face = _look(surfaces, scene.light, camera, rotation, np.zeros(3), margin)
    rgb_right = np.zeros((0, 0, 3), np.uint8)
    if right:
        rgb_right, _, _ = _look(surfaces, scene.light, camera, rotation, rotation[:, 0] * camera.baseline_m, 0)
    crop = np.s_[margin : margin + camera.height, margin : margin + camera.width]
    depth_m, face = depth_m[crop], face[crop]
    lidar = scan_scene(scene, surfaces, camera, scan, world_from_camera) if scan else no_returns()
    return Frame(
        rgb=rgb,
        margin_px=margin,
        depth_m=_to_bins(depth_m, scene.depth_bin_m),
        object_id=np.where(face >= 0, surfaces.object_id[face], -1),
        normal=_facing_normals(surfaces.normal, face, camera, rotation),
        intrinsics=camera.intrinsics,
        rgb_right=rgb_right,
        baseline_m=camera.baseline_m,
        lidar=replace(lidar, depth_m=_to_bins(lidar.depth_m, scene.depth_bin_m)),
    )


def _look(
    surfaces: Surfaces, light: Light, camera: Camera, rotation: np.ndarray, position: np.ndarray, margin_px: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, z-depth and face (-1 = sky) of each pixel, with margin.

    Args:
        surfaces: What there is.
        light: Light and sky.
        camera: What to look with.
        rotation: The camera's axes in the world, (3, 3).
        position: Where the camera is, (3,), relative to the surfaces' origin.
        margin_px: How far to look beyond the frame.
    """
    pixels = camera.rays(margin_px + _BORDER_PX)
    shape = pixels.shape[:2]
    pixels = pixels.reshape(-1, 3)
    linear = np.empty((3, len(pixels)), np.float32)
    depth_m = np.zeros(len(pixels), np.float32)
    face = np.full(len(pixels), -1, np.int32)
    for start in range(0, len(pixels), _RAYS_AT_ONCE):
        part = slice(start, start + _RAYS_AT_ONCE)
        rays = pixels[part] @ rotation.T
        depth_per_m = 1 / np.sqrt(np.einsum("nk,nk->n", rays, rays))
        rays *= depth_per_m[:, None]
        hits = surfaces.cast(position, rays)
        face[part][hits.ray] = hits.face
        depth_m[part][hits.ray] = hits.range_m * depth_per_m.take(hits.ray)
        linear[:, part][:, hits.ray] = shade(surfaces, light, hits, 1 / camera.focal_px)
        missed = np.flatnonzero(face[part] < 0)
        linear[:, part][:, missed] = sky(light, rays.take(missed, axis=0).T)
    far = depth_m > _SKY_BEYOND_M
    depth_m[far], face[far] = 0, -1
    inner = np.s_[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX]
    rgb = develop(linear.reshape(3, *shape), light.exposure)
    return rgb, depth_m.reshape(shape)[inner], face.reshape(shape)[inner]


def _facing_normals(normal: np.ndarray, face: np.ndarray, camera: Camera, rotation: np.ndarray) -> np.ndarray:
    """Unit normals (H, W, 3) in camera coordinates, facing the camera; 0 in the sky."""
    facing = (rotation.T @ normal)[:, face]  # (3, H, W)
    facing *= -np.sign(np.einsum("khw,hwk->hw", facing, camera.rays())) * (face >= 0)
    return np.ascontiguousarray(facing.transpose(1, 2, 0))


def _to_bins(depth_m: np.ndarray, bin_m: float | None) -> np.ndarray:
    """Depths at the centres of bins of `bin_m` (as they are without); 0 stays 0."""
    if bin_m is None:
        return depth_m
    return np.where(depth_m > 0, (np.floor(depth_m / bin_m) + 0.5) * bin_m, 0).astype(np.float32)
