"""Cast rays with Embree: what perfect instruments would see of a scene."""

from dataclasses import dataclass, replace

import numpy as np

from depthreg.data.sample import Frame, OffsetView
from depthreg.rendering.camera import Camera
from depthreg.rendering.scan import no_returns, scan_scene
from depthreg.rendering.scanners import ScanPattern
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
    albedo: np.ndarray  # (H, W) float32, mean over colours; 0 in the sky, and in all of a right view
    gloss: np.ndarray  # (H, W) float32, likewise
    border_px: int

    def inner(self, values: np.ndarray, camera: Camera) -> np.ndarray:
        """Values (H, W) of the camera's frame alone, without the border."""
        return values[self.border_px : self.border_px + camera.height, self.border_px : self.border_px + camera.width]


def render_frame(
    scene: Scene,
    camera: Camera,
    scan: ScanPattern | None,
    *,
    right: bool = True,
    rgb_from_depth: np.ndarray | None = None,
) -> Frame:
    """Render everything that perfect instruments would see.

    Args:
        scene: What there is.
        camera: The left colour camera, at the scene's camera pose.
        scan: The LiDAR's beams; none gives no returns.
        right: Whether to render the right camera's image; without, it has no pixels: (0, 0, 3).
        rgb_from_depth: Where given, a second colour camera is rendered from its own position: the rigid transform
            (4, 4) from this camera's coordinates into its own.
    """
    camera = replace(camera, baseline_m=camera.baseline_m or scene.baseline_m)
    world_from_camera = np.linalg.inv(scene.camera_from_world)
    rotation = world_from_camera[:3, :3].astype(np.float32)
    surfaces = merge(scene, world_from_camera[:3, 3])
    left = _look(surfaces, scene.light, camera, rotation, camera.margin_px + _BLUR_PX)
    face = left.inner(np.where(left.depth_m <= _SKY_BEYOND_M, left.face, -1), camera)
    rgb_right, depth_right_m = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32)
    if right:
        other = _look(surfaces, scene.light, camera, rotation, _BLUR_PX, left=left)
        rgb_right = develop(other.linear, scene.light.exposure)
        depth_right_m = _within_reach(other.inner(other.depth_m, camera))
    lidar = scan_scene(scene, surfaces, camera, scan, world_from_camera) if scan else no_returns()
    offset = None
    if rgb_from_depth is not None:
        offset = _offset_view(surfaces, scene.light, camera, rotation, rgb_from_depth)
    return Frame(
        rgb=develop(left.linear, scene.light.exposure),
        margin_px=camera.margin_px,
        depth_m=_to_bins(_within_reach(left.inner(left.depth_m, camera)), scene.depth_bin_m),
        # The sky's face is number -1, the last one.
        object_id=np.append(surfaces.object_id, np.int32(-1)).take(face),
        normal=np.append(surfaces.normal.T @ rotation, np.zeros((1, 3), np.float32), axis=0).take(face, axis=0),
        albedo=np.where(face >= 0, left.inner(left.albedo, camera), 0),
        gloss=np.where(face >= 0, left.inner(left.gloss, camera), 0),
        intrinsics=camera.intrinsics,
        rgb_right=rgb_right,
        depth_right_m=depth_right_m,
        baseline_m=camera.baseline_m or 0.0,
        lidar=replace(lidar, depth_m=_to_bins(lidar.depth_m, scene.depth_bin_m)),
        offset=offset,
    )


def _within_reach(depth_m: np.ndarray) -> np.ndarray:
    """Depth with what lies too far for any sensor counted as sky."""
    return np.where(depth_m <= _SKY_BEYOND_M, depth_m, 0)


def _offset_view(
    surfaces: Surfaces, light: Light, camera: Camera, rotation: np.ndarray, rgb_from_depth: np.ndarray
) -> OffsetView:
    """What a colour camera sees that stands where `rgb_from_depth` says; `rotation` is the depth camera's."""
    depth_from_rgb = np.linalg.inv(rgb_from_depth).astype(np.float32)
    position = rotation @ depth_from_rgb[:3, 3]
    border_px = camera.margin_px + _BLUR_PX
    view = _look(surfaces, light, camera, rotation @ depth_from_rgb[:3, :3], border_px, position)
    return OffsetView(develop(view.linear, light.exposure), rgb_from_depth)


def _look(
    surfaces: Surfaces,
    light: Light,
    camera: Camera,
    rotation: np.ndarray,
    border_px: int,
    position: np.ndarray | None = None,
    left: _View | None = None,
) -> _View:
    """What the camera sees.

    Args:
        surfaces: What there is, round the left camera.
        light: Light and sky.
        camera: What to look with.
        rotation: The camera's axes in the world, (3, 3) float32.
        border_px: How far to look beyond the frame.
        position: Where the camera stands in world axes, relative to the surfaces' origin (3,); there where not given.
        left: Where given, this is the right camera; what the left one saw already isn't shaded again.
    """
    pixels = camera.rays(border_px)
    size, width = pixels.shape[:2], pixels.shape[1]
    pixels = pixels.reshape(-1, 3)
    baseline_m = camera.baseline_m or 0.0
    if position is None:
        position = np.zeros(3) if left is None else rotation[:, 0] * baseline_m
    linear = np.empty((3, len(pixels)), np.float32)
    depth_m = np.zeros(len(pixels), np.float32)
    face = np.full(len(pixels), -1, np.int32)
    albedo, gloss = np.zeros((2, len(pixels)), np.float32)
    for start in range(0, len(pixels), _RAYS_AT_ONCE):
        part = slice(start, start + _RAYS_AT_ONCE)
        rays = rotation @ pixels[part].T  # (3, N)
        depth_per_m = 1 / np.sqrt(np.einsum("kn,kn->n", rays, rays))
        rays *= depth_per_m
        hits = surfaces.cast(position, rays.T)
        face[part][hits.ray] = hits.face
        depth_m[part][hits.ray] = hits.range_m * depth_per_m.take(hits.ray)
        color = linear[:, part]
        missed = np.flatnonzero(face[part] < 0)
        color[:, missed] = sky(light, rays.take(missed, axis=1))
        if left is not None:
            row, column = np.divmod(hits.ray + start, width)
            disparity_px = camera.focal_px * baseline_m / depth_m[part].take(hits.ray)
            shift = left.border_px - border_px
            known, same = _seen_before(left, row + shift, column + shift + disparity_px, hits.face)
            color[:, hits.ray[known]] = same
            hits = hits.take(np.flatnonzero(~known))
        paint, polish = surfaces.albedo(hits, 1 / camera.focal_px)
        if left is None:
            albedo[part][hits.ray], gloss[part][hits.ray] = paint.mean(axis=0), polish
        color[:, hits.ray] = shade(surfaces, light, hits, paint, polish)
    return _View(
        linear=linear.reshape(3, *size),
        depth_m=depth_m.reshape(size),
        face=face.reshape(size),
        albedo=albedo.reshape(size),
        gloss=gloss.reshape(size),
        border_px=border_px,
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


def _to_bins(depth_m: np.ndarray, bin_m: float | None) -> np.ndarray:
    """Depths at the centres of bins of `bin_m` (as they are without); 0 stays 0."""
    if bin_m is None:
        return depth_m
    return np.where(depth_m > 0, (np.floor(depth_m / bin_m) + 0.5) * bin_m, 0).astype(np.float32)
