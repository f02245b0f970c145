"""What a rotating LiDAR beside the camera reports."""

import numpy as np

from depthreg.data.sample import LidarReturns
from depthreg.rendering.camera import Camera, ScanPattern
from depthreg.rendering.surfaces import Surfaces
from depthreg.worlds.scene import Scene

_BEAM_RAD = 2e-3  # divergence of an HDL-64E
_MIN_DEPTH_M = 0.1


def no_returns() -> LidarReturns:
    """The scan of a rig without a LiDAR."""
    values = np.zeros(0, np.float32)
    return LidarReturns(
        uv_px=np.zeros((0, 2), np.float32),
        depth_m=values,
        range_m=values,
        cos_incidence=values,
        albedo=values,
        gloss=values,
        far_range_m=values,
        near_share=values,
        ring=np.zeros(0, np.int16),
    )


def _azimuth_limits_deg(camera: Camera, lidar_from_camera: np.ndarray) -> tuple[float, float]:
    """Azimuths between which a LiDAR sees whatever lies in the camera's image, from 1 m on."""
    rays = camera.rays()
    edge = np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]])
    points = np.concatenate([edge, 1000 * edge]) @ lidar_from_camera[:3, :3].T + lidar_from_camera[:3, 3]
    azimuth = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
    return azimuth.min(), azimuth.max()


def scan_scene(
    scene: Scene, surfaces: Surfaces, camera: Camera, scan: ScanPattern, world_from_camera: np.ndarray
) -> LidarReturns:
    """Returns of a LiDAR that lie in the camera's image; whether the camera sees them doesn't matter.

    Args:
        scene: Says how the LiDAR is mounted.
        surfaces: The scene's tables round the camera's position.
        camera: Whose image the returns are projected into.
        scan: The LiDAR's beams.
        world_from_camera: The camera's pose, (4, 4).
    """
    camera_from_lidar = np.linalg.inv(scene.lidar_from_camera).astype(np.float32)
    rotation = world_from_camera[:3, :3].astype(np.float32)
    lidar_rays, ring = scan.rays(*_azimuth_limits_deg(camera, scene.lidar_from_camera))
    rays = lidar_rays @ camera_from_lidar[:3, :3].T  # in camera axes
    hits = surfaces.cast(rotation @ camera_from_lidar[:3, 3], rays @ rotation.T)

    points = camera_from_lidar[:3, 3] + hits.range_m[:, None] * rays[hits.ray]
    depth_m = points[:, 2]
    uv_px = points[:, :2] / depth_m.clip(_MIN_DEPTH_M)[:, None] * camera.focal_px + camera.intrinsics[:2, 2]
    inside = (uv_px >= 0).all(axis=1) & (uv_px <= [camera.width - 1, camera.height - 1]).all(axis=1)
    keep = inside & (depth_m > _MIN_DEPTH_M) & (hits.range_m <= scan.max_range_m)
    color, gloss = surfaces.albedo(hits, _BEAM_RAD)
    return LidarReturns(
        uv_px=uv_px[keep].astype(np.float32),
        depth_m=depth_m[keep],
        range_m=hits.range_m[keep],
        cos_incidence=hits.cos_incidence[keep],
        albedo=color[:, keep].mean(axis=0).clip(0, 1),
        gloss=gloss[keep],
        far_range_m=hits.range_m[keep],
        near_share=np.ones(keep.sum(), np.float32),
        ring=ring[hits.ray[keep]],
    )
