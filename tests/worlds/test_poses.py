"""Poses against closed forms."""

import numpy as np
import pytest

from depthreg.worlds.poses import camera_from_world, lidar_from_camera


def _move(pose: np.ndarray, point: tuple[float, float, float]) -> np.ndarray:
    return (pose @ [*point, 1.0])[:3]


def test_a_level_camera_has_x_right_y_down_and_z_forward() -> None:
    pose = camera_from_world((1.0, 2.0, 3.0))
    np.testing.assert_allclose(_move(pose, (1 + 4, 2 + 6, 3 + 5)), [4, -5, 6], atol=1e-12)


def test_positive_yaw_looks_left_and_positive_pitch_looks_down() -> None:
    left_and_down = (-np.sin(0.5), np.cos(0.5), -np.tan(0.2))
    pose = camera_from_world((0, 0, 0), yaw_deg=np.degrees(0.5), pitch_deg=np.degrees(0.2))
    ahead = _move(pose, left_and_down)
    np.testing.assert_allclose(ahead, [0, 0, 1 / np.cos(0.2)], atol=1e-12)


def test_positive_roll_turns_the_camera_clockwise() -> None:
    # The camera's right side goes down, so what is level on the right rises in its image.
    right = _move(camera_from_world((0, 0, 0), roll_deg=10.0), (1, 0, 0))
    np.testing.assert_allclose(right, [np.cos(np.radians(10)), -np.sin(np.radians(10)), 0], atol=1e-12)


@pytest.mark.parametrize("pose", [camera_from_world((1, 2, 3), 40.0, 20.0, 10.0), lidar_from_camera()])
def test_poses_are_rigid(pose: np.ndarray) -> None:
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose) == pytest.approx(1.0)


def test_the_lidar_sits_where_kittis_calibration_puts_it() -> None:
    # The published translation from Velodyne to camera, in camera axes.
    np.testing.assert_allclose(_move(lidar_from_camera(), (-0.004, -0.076, -0.272)), np.zeros(3), atol=1e-12)


def test_the_lidar_has_x_forward_y_left_and_z_up() -> None:
    pose = lidar_from_camera((0.0, 0.0, 0.0))
    np.testing.assert_allclose(_move(pose, (2.0, 3.0, 5.0)), [5.0, -2.0, -3.0])


@pytest.mark.parametrize(
    ("turns_deg", "ahead"),
    [((0.0, 5.0, 0.0), (0.0, 1.0)), ((0.0, 0.0, 5.0), (-1.0, 0.0)), ((5.0, 0.0, 0.0), (0.0, 0.0))],
)
def test_a_turned_lidar_looks_down_left_or_rolls(
    turns_deg: tuple[float, float, float], ahead: tuple[float, float]
) -> None:
    camera_from_lidar = np.linalg.inv(lidar_from_camera(turns_deg=turns_deg))[:3, :3]
    sine = np.sin(np.deg2rad(5))
    # Its forward axis in the camera's right and down; rolling, its left axis goes up as its right side goes down.
    np.testing.assert_allclose(camera_from_lidar[:2, 0], sine * np.array(ahead), atol=1e-12)
    np.testing.assert_allclose(camera_from_lidar[1, 1], -sine * (turns_deg[0] > 0), atol=1e-12)
