"""Cast rays with Embree: what perfect instruments would see of a scene."""

from dataclasses import dataclass, replace

import numpy as np

from depthreg.data.sample import Frame
from depthreg.rendering.camera import Camera, ScanPattern
from depthreg.rendering.scan import no_returns, scan_scene
from depthreg.rendering.shading import develop, shade, sky
from depthreg.rendering.surfaces import Surfaces, merge
from depthreg.worlds.scene import Light, Scene

_SKY_BEYOND_M = 250.0  # no sensor measures that far: depth counts as none
_RAYS_AT_ONCE = 32768  # what fits a core's cache
_BLUR_PX = 1  # the lens blur looks one pixel beyond the image


@dataclass(frozen=True)
class _View:
    """What a camera sees, with `border_px` more pixels on each side than its frame has."""

    linear: np.ndarray  # (3, H, W) float32 linear light
    depth_m: np.ndarray  # (H, W) float32, 0 = sky
    face: np.ndarray  # (H, W) int32, -1 = sky
    border_px: int


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
    left = _look(surfaces, scene.light, camera, rotation, camera.margin_px + _BLUR_PX)
    inner = np.s_[left.border_px : left.border_px + camera.height, left.border_px : left.border_px + camera.width]
    face = np.where(left.depth_m <= _SKY_BEYOND_M, left.face, -1)[inner]
    rgb_right = np.zeros((0, 0, 3), np.uint8)
    if right:
        other = _look(surfaces, scene.light, camera, rotation, _BLUR_PX, left)
        rgb_right = develop(other.linear, scene.light.exposure)
    lidar = scan_scene(scene, surfaces, camera, scan, world_from_camera) if scan else no_returns()
    return Frame(
        rgb=develop(left.linear, scene.light.exposure),
        margin_px=camera.margin_px,
        depth_m=_to_bins(np.where(face >= 0, left.depth_m[inner], 0), scene.depth_bin_m),
        object_id=np.where(face >= 0, surfaces.object_id[face], -1),
        normal=_facing_normals(surfaces.normal, face, camera, rotation),
        intrinsics=camera.intrinsics,
        rgb_right=rgb_right,
        baseline_m=camera.baseline_m,
        lidar=replace(lidar, depth_m=_to_bins(lidar.depth_m, scene.depth_bin_m)),
    )


def _look(
    surfaces: Surfaces, light: Light, camera: Camera, rotation: np.ndarray, border_px: int, left: _View | None = None
) -> _View:
    """What the camera sees.

    Args:
        surfaces: What there is, round the left camera.
        light: Light and sky.
        camera: What to look with.
        rotation: The camera's axes in the world, (3, 3) float32.
        border_px: How far to look beyond the frame.
        left: Where given, this is the right camera; what the left one saw already isn't shaded again.
    """
    pixels = camera.rays(border_px)
    height, width = pixels.shape[:2]
    pixels = pixels.reshape(-1, 3)
    position = np.zeros(3) if left is None else rotation[:, 0] * camera.baseline_m
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
        color = linear[:, part]
        missed = np.flatnonzero(face[part] < 0)
        color[:, missed] = sky(light, rays.take(missed, axis=0).T)
        if left is not None:
            row, column = np.divmod(hits.ray + start, width)
            disparity_px = camera.focal_px * camera.baseline_m / depth_m[part].take(hits.ray)
            shift = left.border_px - border_px
            known, same = _seen_before(left, row + shift, column + shift + disparity_px, hits.face)
            color[:, hits.ray[known]] = same
            hits = hits.take(np.flatnonzero(~known))
        color[:, hits.ray] = shade(surfaces, light, hits, 1 / camera.focal_px)
    return _View(
        linear.reshape(3, height, width), depth_m.reshape(height, width), face.reshape(height, width), border_px
    )


def _seen_before(view: _View, row: np.ndarray, column: np.ndarray, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours of points that a view shows too, at positions (row, column) (M,) in it.

    Returns:
        A mask (M,): both pixels beside the position show the point's own face (M,). And those points' colours (3, K).
    """
    width = view.face.shape[1]
    first = np.floor(column).astype(np.int32)
    inside = first.clip(0, width - 2)
    index, faces = row * width + inside, view.face.ravel()
    known = (faces.take(index) == face) & (faces.take(index + 1) == face) & (first == inside)
    index, weight = index[known], (column - first)[known].astype(np.float32)
    linear = view.linear.reshape(3, -1)
    before = linear.take(index, axis=1)
    return known, before + weight * (linear.take(index + 1, axis=1) - before)


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
