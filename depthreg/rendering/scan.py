"""What a LiDAR beside the camera would report if it were perfect.

Neglected: the scene's own motion during the sweep, beams that meet more than two surfaces, things thinner than a beam's
half that stand between two beams, and the few centimetres between a rotating laser and the axis that it turns about.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from depthreg.data.sample import LidarReturns
from depthreg.rendering.camera import Camera
from depthreg.rendering.scanners import ScanPattern
from depthreg.rendering.surfaces import Hits, Surfaces
from depthreg.worlds.scene import Scene

_MIN_DEPTH_M = 0.1
_EDGE_M = 0.25  # less than this between two parts of a beam shifts its range by some centimetres only
_BISECTIONS = 2  # after them, an edge's place in the beam is known to an eighth of its radius


@dataclass(frozen=True)
class _Beams:
    """Beams of one sweep on a grid of R rings and C columns, ring by ring: N = R * C. World axes.

    Vectors are (3, N), because NumPy is quick along the last axis only.
    """

    grid: tuple[int, int]  # R, C
    angles_rad: tuple[np.ndarray, np.ndarray]  # from each to its neighbour below, (R - 1, 1), and beside it, (1, 1)
    first_ring: int
    start: np.ndarray  # (3, N) float32, where each pulse leaves; metres from the camera
    rays: np.ndarray  # (3, N) float32, unit
    misplaced_m: np.ndarray  # (3, N) float32, by how much of its motion the scanner errs
    slip_rad: np.ndarray  # (N,) float32, by what angle about its axis it errs in the direction
    left: np.ndarray  # (3, 3) float32, `left @ ray` is how a ray moves where it is turned about that axis


@dataclass(frozen=True)
class _Echoes:
    """What beams meet; (N,) float32 each."""

    range_m: np.ndarray  # inf = nothing
    cos_incidence: np.ndarray
    albedo: np.ndarray
    gloss: np.ndarray

    def take(self, some: np.ndarray) -> "_Echoes":
        """Some of them, by their numbers."""
        return _Echoes(*(values.take(some) for values in vars(self).values()))


class _Places(NamedTuple):
    """Where returns of n beams lie."""

    rays: np.ndarray  # (3, n) float32, as the scanner states them
    uv_px: np.ndarray  # (2, n) float32
    depth_m: np.ndarray  # (n,) float32
    inside: np.ndarray  # (n,) bool, whether that is in the camera's image


def no_returns() -> LidarReturns:
    """The scan of a rig without a LiDAR."""
    shapes = {"uv_px": (0, 2), "ray": (0, 3)}
    values = {field.name: np.zeros(shapes.get(field.name, 0), np.float32) for field in fields(LidarReturns)}
    return LidarReturns(**values | {"ring": np.zeros(0, np.int16)})


def scan_scene(
    scene: Scene, surfaces: Surfaces, camera: Camera, scan: ScanPattern, world_from_camera: np.ndarray
) -> LidarReturns:
    """Returns of a LiDAR that lie in the camera's image; whether the camera sees them doesn't matter.

    Args:
        scene: Says how the LiDAR is mounted, and how fast it moves.
        surfaces: The scene's tables round the camera's position.
        camera: Whose image the returns are projected into.
        scan: The LiDAR's beams.
        world_from_camera: The camera's pose, (4, 4).
    """
    rotation = world_from_camera[:3, :3].astype(np.float32)
    beams = _aim(scene, camera, scan, rotation)
    hits = surfaces.cast(beams.start.T, beams.rays.T)
    near = far = _echoes(surfaces, hits, beams.rays.shape[1], scan)
    near_share = np.ones(beams.rays.shape[1], np.float32)
    split, nearest_m, towards = _candidates(near, beams)
    # Rim rays are the costly ones: none for what can't be reported, as too far away or outside the image.
    shown = nearest_m <= scan.max_range_m
    shown[shown] = _project(beams, split[shown], nearest_m[shown], camera, rotation).inside
    split, towards = split[shown], towards[:, shown]
    if len(split):
        split, other, other_share = _split(surfaces, near, beams, split, towards, scan)
        near, far, near_share = _sort(near, split, other, other_share, scan.max_range_m)
    return _returns(beams, near, far, near_share, camera, scan, rotation)


def _limits_deg(camera: Camera, lidar_from_camera: np.ndarray) -> np.ndarray:
    """Least and largest azimuth and elevation at which a LiDAR sees what lies in the camera's image, (2, 2).

    That is from 1 m on for azimuths, and from 2 m on for elevations.
    """
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 17), np.linspace(0, camera.height - 1, 17))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(camera.intrinsics).T
    points = np.stack([rays, 2 * rays, 1000 * rays]) @ lidar_from_camera[:3, :3].T + lidar_from_camera[:3, 3]
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    elevation = np.arctan2(points[1:, :, 2], np.hypot(points[1:, :, 0], points[1:, :, 1]))
    return np.rad2deg([[azimuth.min(), azimuth.max()], [elevation.min(), elevation.max()]])


def _aim(scene: Scene, camera: Camera, scan: ScanPattern, rotation: np.ndarray) -> _Beams:
    """Where the beams start and go; `rotation` turns camera axes into the world's."""
    camera_from_lidar = np.linalg.inv(scene.lidar_from_camera).astype(np.float32)
    world_from_lidar = rotation @ camera_from_lidar[:3, :3]
    (left, right), (low, high) = _limits_deg(camera, scene.lidar_from_camera)
    firings = scan.firings(left - scan.azimuth_step_deg, right + scan.azimuth_step_deg)
    elevation_deg = np.asarray(scan.elevations_deg)
    # Lasers that sit higher than the LiDAR's origin look further down at the same point, 2 m away at least.
    lowest = low - np.rad2deg(max(scan.laser_up_m, default=0) / 2)
    rings = np.flatnonzero((elevation_deg >= lowest) & (elevation_deg <= high))
    steps_rad = -np.diff(np.deg2rad(elevation_deg[rings])).astype(np.float32)
    up, grid = world_from_lidar[:, 2], (len(rings), firings.slip_rad.shape[1])
    moved_m = np.multiply.outer(np.asarray(scene.velocity_m_per_s, dtype=np.float32), firings.time_s[rings])
    origin_m = (rotation @ camera_from_lidar[:3, 3])[:, None] + up[:, None] * firings.up_m[rings]  # (3, R)
    return _Beams(
        grid=grid,
        angles_rad=(steps_rad[:, None], np.deg2rad([[scan.azimuth_step_deg]], dtype=np.float32)),
        first_ring=int(rings[0]) if len(rings) else 0,
        start=(origin_m[..., None] + moved_m).reshape(3, -1),
        rays=world_from_lidar @ np.moveaxis(firings.rays, -1, 0).take(rings, axis=1).reshape(3, -1),
        # Compensated points are moved to where the vehicle was when the pulse left; a residual stays as it was fired.
        misplaced_m=(-scan.motion_residual * moved_m).reshape(3, -1),
        slip_rad=firings.slip_rad[rings].reshape(-1),
        left=np.cross(up, np.eye(3, dtype=np.float32)).T,
    )


def _echoes(surfaces: Surfaces, hits: Hits, count: int, scan: ScanPattern) -> _Echoes:
    """What `count` rays met, of which some hit something."""
    color, gloss = surfaces.albedo(hits, scan.divergence_mrad / 1000)
    values = np.zeros((4, count), np.float32)
    values[0] = np.inf
    for row, of_hits in zip(
        values, (hits.range_m, hits.cos_incidence, color.mean(axis=0).clip(0, 1), gloss), strict=True
    ):
        row[hits.ray] = of_hits
    return _Echoes(*values)


def _gap(
    range_m: np.ndarray, cos: np.ndarray, other_m: np.ndarray, other_cos: np.ndarray, angle_rad: float | np.ndarray
) -> np.ndarray:
    """Whether rays at an angle meet different surfaces, rather than one slanted one, bool; elementwise."""
    cos = np.maximum(cos, other_cos).clip(0.01)
    slanted_m = 2 * angle_rad * np.minimum(range_m, other_m) * np.sqrt(1 - cos**2) / cos
    return np.abs(range_m - other_m) > _EDGE_M + slanted_m


def _candidates(echoes: _Echoes, beams: _Beams) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Beams that an edge may split: those whose neighbour meets something else.

    Returns:
        Their numbers (n,), how near the nearer of the two is (n,), and the unit vectors (3, n) from their rays towards
        that neighbour. A beam with edges on several sides looks at one of them, sideways rather than up or down.
    """
    range_m, cos = echoes.range_m.reshape(beams.grid), echoes.cos_incidence.reshape(beams.grid)
    number = np.arange(beams.grid[0] * beams.grid[1]).reshape(beams.grid)
    neighbour = np.full(number.size, -1)
    for axis, angle_rad in enumerate(beams.angles_rad):
        first, second = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        with np.errstate(invalid="ignore"):  # two beams into the sky: inf - inf is no gap
            apart = _gap(range_m[first], cos[first], range_m[second], cos[second], angle_rad)
        here, there = number[first][apart], number[second][apart]
        neighbour[here], neighbour[there] = there, here
    split = np.flatnonzero(neighbour >= 0)
    rays = beams.rays.take(split, axis=1)
    neighbour = neighbour.take(split)
    towards = beams.rays.take(neighbour, axis=1) - rays
    towards -= np.einsum("kn,kn->n", towards, rays) * rays
    nearest_m = np.minimum(echoes.range_m.take(split), echoes.range_m.take(neighbour))
    return split, nearest_m, towards / np.linalg.norm(towards, axis=0).clip(1e-9)


def _split(
    surfaces: Surfaces, echoes: _Echoes, beams: _Beams, split: np.ndarray, towards: np.ndarray, scan: ScanPattern
) -> tuple[np.ndarray, _Echoes, np.ndarray]:
    """Which beams an edge does split: what their other part meets, and how much of the beam that is.

    A ray at the beam's rim tells whether there is an edge, bisection where.

    Args:
        surfaces: What there is.
        echoes: What the beams' centres meet.
        beams: All of them.
        split: Numbers of the beams to look at (n,).
        towards: On which side to look, (3, n).
        scan: Says how wide the beams are.

    Returns:
        Numbers of the beams that are split (k,), what the other part meets, and its share of the light, (k,) up to 0.5.
    """
    radius = scan.divergence_mrad / 2000
    start, rays, towards = beams.start.take(split, axis=1), beams.rays.take(split, axis=1), radius * towards
    hits = surfaces.cast(start.T, (rays + towards).T)
    rim_m, rim_cos = np.full(len(split), np.inf, np.float32), np.zeros(len(split), np.float32)
    rim_m[hits.ray], rim_cos[hits.ray] = hits.range_m, hits.cos_incidence
    with np.errstate(invalid="ignore"):
        apart = _gap(echoes.range_m.take(split), echoes.cos_incidence.take(split), rim_m, rim_cos, radius)
    rim = _echoes(surfaces, hits.take(np.flatnonzero(apart[hits.ray])), len(split), scan)
    kept = np.flatnonzero(apart)
    split, rim = split.take(kept), rim.take(kept)
    start, rays, towards = (values.take(kept, axis=1) for values in (start, rays, towards))
    edge = _find_edge(surfaces, start, rays, towards, echoes.range_m.take(split), rim.range_m)
    # Beyond a chord at that share of the radius lies this share of a disc.
    return split, rim, (np.arccos(edge) - edge * np.sqrt(1 - edge**2)) / np.pi


def _find_edge(
    surfaces: Surfaces,
    start: np.ndarray,
    rays: np.ndarray,
    towards: np.ndarray,
    center_m: np.ndarray,
    rim_m: np.ndarray,
) -> np.ndarray:
    """Where between rays (0) and rays + towards (1) what they meet changes from one range to another, (k,)."""
    edge, width = np.full(len(rim_m), 0.5, np.float32), 0.5
    for _ in range(_BISECTIONS):
        width /= 2
        hits = surfaces.cast(start.T, (rays + edge * towards).T)
        nearness = np.zeros(len(edge), np.float32)  # 1/m, so that the sky is a number like others
        nearness[hits.ray] = 1 / hits.range_m
        at_center = np.abs(nearness - 1 / center_m) < np.abs(nearness - 1 / rim_m)
        edge += np.where(at_center, width, -width).astype(np.float32)
    return edge


def _sort(
    echoes: _Echoes, split: np.ndarray, other: _Echoes, other_share: np.ndarray, max_range_m: float
) -> tuple[_Echoes, _Echoes, np.ndarray]:
    """The nearer and the farther part of all beams, and the nearer part's share of the light."""
    near, far = (_Echoes(*(values.copy() for values in vars(echoes).values())) for _ in range(2))
    near_share = np.ones(len(echoes.range_m), np.float32)
    mine = echoes.take(split)
    mine_first = mine.range_m <= other.range_m
    for name in vars(echoes):
        ours, theirs = getattr(mine, name), getattr(other, name)
        getattr(near, name)[split] = np.where(mine_first, ours, theirs)
        getattr(far, name)[split] = np.where(mine_first, theirs, ours)
    near_share[split] = np.where(mine_first, 1 - other_share, other_share)
    lost = far.range_m > max_range_m  # into the sky: that light never comes back
    far.range_m[lost], far.albedo[lost] = near.range_m[lost], 0
    return near, far, near_share


def _project(beams: _Beams, some: np.ndarray, range_m: np.ndarray, camera: Camera, rotation: np.ndarray) -> _Places:
    """Where the camera sees what some beams, by their numbers (n,), meet at these ranges (n,)."""
    rays = beams.rays.take(some, axis=1)
    rays += beams.slip_rad.take(some) * (beams.left @ rays)
    start = beams.start.take(some, axis=1) + beams.misplaced_m.take(some, axis=1)
    points = rotation.T @ (start + range_m * rays)
    depth_m = points[2]
    u_px, v_px = uv_px = points[:2] / depth_m.clip(_MIN_DEPTH_M) * camera.focal_px + camera.intrinsics[:2, 2:]
    inside = (u_px >= 0) & (u_px <= camera.width - 1) & (v_px >= 0) & (v_px <= camera.height - 1)
    return _Places(rays, uv_px, depth_m, inside & (depth_m > _MIN_DEPTH_M))


def _returns(
    beams: _Beams,
    near: _Echoes,
    far: _Echoes,
    near_share: np.ndarray,
    camera: Camera,
    scan: ScanPattern,
    rotation: np.ndarray,
) -> LidarReturns:
    """Returns within the scanner's range and the camera's image."""
    found = np.flatnonzero((near.range_m >= scan.min_range_m) & (near.range_m <= scan.max_range_m))
    places = _project(beams, found, near.range_m.take(found), camera, rotation)
    inside = np.flatnonzero(places.inside)
    kept = found.take(inside)
    near, far = near.take(kept), far.take(kept)
    return LidarReturns(
        uv_px=np.ascontiguousarray(places.uv_px.take(inside, axis=1).T),
        depth_m=places.depth_m.take(inside),
        range_m=near.range_m,
        cos_incidence=near.cos_incidence,
        albedo=near.albedo,
        gloss=near.gloss,
        far_range_m=far.range_m,
        near_share=near_share.take(kept),
        ring=(beams.first_ring + kept // beams.grid[1]).astype(np.int16),
        far_cos_incidence=far.cos_incidence,
        far_albedo=far.albedo,
        far_gloss=far.gloss,
        ray=np.ascontiguousarray((rotation.T @ places.rays.take(inside, axis=1)).T),
    )
