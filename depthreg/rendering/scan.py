"""What a LiDAR beside the camera would report if it were perfect.

Neglected: the scene's own motion during the sweep, beams that meet more than two surfaces, things thinner than a beam's
half that stand between two beams, and the few centimetres between a rotating laser and the axis that it turns about.
"""

from dataclasses import dataclass, fields

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
    """Beams of one sweep on a grid of R rings and C columns, ring by ring: N = R * C. World axes."""

    grid: tuple[int, int]  # R, C
    angles_rad: tuple[np.ndarray, np.ndarray]  # from each to its neighbour below, (R - 1, 1), and beside it, (1, 1)
    first_ring: int
    start: np.ndarray  # (N, 3) float32, where each pulse leaves; metres from the camera
    rays: np.ndarray  # (N, 3) float32, unit
    misplaced_m: np.ndarray  # (N, 3) float32, by how much of its motion the scanner errs
    slip_rad: np.ndarray  # (N,) float32, by what angle about its axis it errs in the direction
    left: np.ndarray  # (3, 3) float32, `ray @ left` is how a ray moves where it is turned about that axis


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
    hits = surfaces.cast(beams.start, beams.rays)
    near = far = _echoes(surfaces, hits, len(beams.rays), scan)
    near_share = np.ones(len(beams.rays), np.float32)
    split, towards = _candidates(near, beams)
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
    up, grid = world_from_lidar[:, 2], (len(rings), len(firings.slip_rad))
    moved_m = firings.time_s[rings][..., None] * np.asarray(scene.velocity_m_per_s, dtype=np.float32)
    start = rotation @ camera_from_lidar[:3, 3] + firings.up_m[rings, None, None] * up + moved_m
    return _Beams(
        grid=grid,
        angles_rad=(steps_rad[:, None], np.deg2rad([[scan.azimuth_step_deg]], dtype=np.float32)),
        first_ring=int(rings[0]) if len(rings) else 0,
        start=start.reshape(-1, 3),
        rays=firings.rays[rings].reshape(-1, 3) @ world_from_lidar.T,
        # Compensated points are moved to where the vehicle was when the pulse left; a residual stays as it was fired.
        misplaced_m=(-scan.motion_residual * moved_m).reshape(-1, 3),
        slip_rad=np.tile(firings.slip_rad, grid[0]),
        left=np.cross(up, np.eye(3, dtype=np.float32)),
    )


def _echoes(surfaces: Surfaces, hits: Hits, count: int, scan: ScanPattern) -> _Echoes:
    """What `count` rays met, of which some hit something."""
    color, gloss = surfaces.albedo(hits, scan.divergence_mrad / 1000)
    values = np.zeros((4, count), np.float32)
    values[0] = np.inf
    values[:, hits.ray] = hits.range_m, hits.cos_incidence, color.mean(axis=0).clip(0, 1), gloss
    return _Echoes(*values)


def _gap(
    range_m: np.ndarray, cos: np.ndarray, other_m: np.ndarray, other_cos: np.ndarray, angle_rad: float | np.ndarray
) -> np.ndarray:
    """Whether rays at an angle meet different surfaces, rather than one slanted one, bool; elementwise."""
    cos = np.maximum(cos, other_cos).clip(0.01)
    slanted_m = 2 * angle_rad * np.minimum(range_m, other_m) * np.sqrt(1 - cos**2) / cos
    return np.abs(range_m - other_m) > _EDGE_M + slanted_m


def _candidates(echoes: _Echoes, beams: _Beams) -> tuple[np.ndarray, np.ndarray]:
    """Beams that an edge may split: those whose neighbour meets something else.

    Returns:
        Their numbers (n,), and the unit vectors (n, 3) from their rays towards that neighbour. A beam with edges on
        several sides looks at one of them, sideways rather than up or down.
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
    rays = beams.rays.take(split, axis=0)
    towards = beams.rays.take(neighbour[split], axis=0) - rays
    towards -= np.einsum("nk,nk->n", towards, rays)[:, None] * rays
    return split, towards / np.linalg.norm(towards, axis=1, keepdims=True).clip(1e-9)


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
        towards: On which side to look, (n, 3).
        scan: Says how wide the beams are.

    Returns:
        Numbers of the beams that are split (k,), what the other part meets, and its share of the light, (k,) up to 0.5.
    """
    radius = scan.divergence_mrad / 2000
    start, rays, towards = beams.start.take(split, axis=0), beams.rays.take(split, axis=0), radius * towards
    hits = surfaces.cast(start, rays + towards)
    rim_m, rim_cos = np.full(len(split), np.inf, np.float32), np.zeros(len(split), np.float32)
    rim_m[hits.ray], rim_cos[hits.ray] = hits.range_m, hits.cos_incidence
    with np.errstate(invalid="ignore"):
        apart = _gap(echoes.range_m.take(split), echoes.cos_incidence.take(split), rim_m, rim_cos, radius)
    rim = _echoes(surfaces, hits.take(np.flatnonzero(apart[hits.ray])), len(split), scan)
    kept = np.flatnonzero(apart)
    split, rim = split.take(kept), rim.take(kept)
    start, rays, towards = (values.take(kept, axis=0) for values in (start, rays, towards))
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
    edge, width = np.full(len(rays), 0.5, np.float32), 0.5
    for _ in range(_BISECTIONS):
        width /= 2
        hits = surfaces.cast(start, rays + edge[:, None] * towards)
        nearness = np.zeros(len(rays), np.float32)  # 1/m, so that the sky is a number like others
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
    rays = beams.rays.take(found, axis=0)
    rays += beams.slip_rad.take(found)[:, None] * (rays @ beams.left)
    start = beams.start.take(found, axis=0) + beams.misplaced_m.take(found, axis=0)
    points = (start + near.range_m.take(found)[:, None] * rays) @ rotation
    depth_m = points[:, 2]
    uv_px = points[:, :2] / depth_m.clip(_MIN_DEPTH_M)[:, None] * camera.focal_px + camera.intrinsics[:2, 2]
    inside = (uv_px >= 0).all(axis=1) & (uv_px <= [camera.width - 1, camera.height - 1]).all(axis=1)
    inside = np.flatnonzero(inside & (depth_m > _MIN_DEPTH_M))
    kept = found.take(inside)
    near, far = near.take(kept), far.take(kept)
    return LidarReturns(
        uv_px=uv_px.take(inside, axis=0),
        depth_m=depth_m.take(inside),
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
        ray=rays.take(inside, axis=0) @ rotation,
    )
