"""Where the camera stands and how the LiDAR is mounted on it, as rigid 4 x 4 transforms in metres."""

import numpy as np
from scipy.spatial.transform import Rotation

# Columns: the camera's right, down and forward in a world of right, forward and up.
_WORLD_FROM_LEVEL_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# Rows: the LiDAR's forward, left and up in a camera of right, down and forward.
_LIDAR_AXES_IN_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

KITTI_LIDAR_IN_CAMERA_M = (-0.004, -0.076, -0.272)  # the rig's published translation, to its first camera
KITTI_LIDAR_IN_COLOUR_CAMERA_M = (0.056, -0.075, -0.272)  # that camera is 6 cm to the left of it: P2 of its calibration


def camera_from_world(
    position_m: tuple[float, float, float],
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
) -> np.ndarray:
    """Pose of a camera in the world, (4, 4).

    Args:
        position_m: Its optical centre in the world.
        yaw_deg: Turn to the left; 0 looks along the world's y.
        pitch_deg: How far it looks down.
        roll_deg: Clockwise turn about the optical axis, as seen from behind the camera.
    """
    turn = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    tilt = Rotation.from_euler("XZ", [-pitch_deg, roll_deg], degrees=True).as_matrix()
    world_from_camera = turn @ _WORLD_FROM_LEVEL_CAMERA @ tilt
    return _rigid(world_from_camera.T, -world_from_camera.T @ np.asarray(position_m))


def lidar_from_camera(
    lidar_in_camera_m: tuple[float, float, float] = KITTI_LIDAR_IN_CAMERA_M,
    turns_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """Transform into a LiDAR (x forward, y left, z up) that looks roughly the camera's way, (4, 4).

    Args:
        lidar_in_camera_m: The LiDAR's origin in camera coordinates.
        turns_deg: How it is turned against the camera about its own axes, forward, left and up, in this order:
            its right side down, its nose down, its nose to the left.
    """
    axes = Rotation.from_euler("xyz", turns_deg, degrees=True).as_matrix().T @ _LIDAR_AXES_IN_CAMERA
    return _rigid(axes, -axes @ np.asarray(lidar_in_camera_m))


def _rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose
