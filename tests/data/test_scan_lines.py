"""Oracles: simulated scans, whose lasers are known; KITTI's raw scans, which are stored laser by laser."""

import cv2
import numpy as np
import pytest

from depthreg.data.scan_lines import is_scan, keep_lines, scan_lines
from depthreg.rendering import Camera, hdl64, render_frame
from depthreg.worlds import DrivingWorld

CAMERA = Camera(width=1242, height=375, focal_px=721.5)


@pytest.fixture(scope="module")
def scan():
    """A simulated scan's depth and, pixel by pixel, the laser that gave it, -1 for none."""
    lidar = render_frame(DrivingWorld()(1, 2), CAMERA, hdl64(), right=False).lidar
    return rasterise(lidar.uv_px.T, lidar.depth_m, lidar.ring, (CAMERA.height, CAMERA.width))


def rasterise(uv_px, depth_m, ring, size):
    depth, laser = np.zeros(size, np.float32), np.full(size, -1)
    far_to_near = np.argsort(-depth_m)
    column, row = np.rint(uv_px[:, far_to_near]).astype(int)
    depth[row, column], laser[row, column] = depth_m[far_to_near], ring[far_to_near]
    return depth, laser


def agreement(laser, line):
    """Share of the returns that the most frequent pairing of lasers with lines explains, either way."""
    pairs = np.zeros((laser.max() + 1, line.max() + 1), int)
    np.add.at(pairs, (laser[laser >= 0], line[laser >= 0]), 1)
    return min(pairs.max(axis=0).sum(), pairs.max(axis=1).sum()) / pairs.sum()


def test_lines_are_the_lasers_of_a_simulated_scan(scan):
    depth_m, laser = scan
    line = scan_lines(depth_m, CAMERA.intrinsics)
    np.testing.assert_array_equal(line >= 0, depth_m > 0)
    assert agreement(laser, line) > 0.95
    assert abs(line.max() + 1 - len(np.unique(laser[laser >= 0]))) <= 2


def test_thinning_keeps_every_fourth_laser_and_leaves_the_rest_as_it_is(scan):
    depth_m, laser = scan
    kept_m = keep_lines(depth_m, CAMERA.intrinsics, 16)
    assert set(np.unique(kept_m[kept_m > 0])) <= set(np.unique(depth_m))
    of_kept, of_all = (np.bincount(laser[where], minlength=64) for where in (kept_m > 0, depth_m > 0))
    whole = of_kept > 0.8 * np.maximum(of_all, 1)
    gone = of_kept < 0.2 * of_all
    seen = of_all > 20
    assert (whole | gone)[seen].mean() > 0.9
    assert np.median(np.diff(np.flatnonzero(whole & seen))) == 4


@pytest.mark.parametrize("lines", [32, 16, 8, 4])
def test_so_many_lines_are_so_large_a_share_of_the_returns(scan, lines):
    depth_m, _ = scan
    share = (keep_lines(depth_m, CAMERA.intrinsics, lines) > 0).sum() / (depth_m > 0).sum()
    assert share == pytest.approx(lines / 64, rel=0.25)


def test_all_lines_are_the_scan_itself_and_no_returns_stay_none(scan):
    depth_m, _ = scan
    np.testing.assert_array_equal(keep_lines(depth_m, CAMERA.intrinsics, 64), depth_m)
    nothing = np.zeros((37, 53), np.float32)
    np.testing.assert_array_equal(keep_lines(nothing, CAMERA.intrinsics, 8), nothing)
    assert not is_scan(nothing, CAMERA.intrinsics)


def test_a_number_that_does_not_divide_64_is_refused(scan):
    with pytest.raises(ValueError, match="divide 64, got 5"):
        keep_lines(scan[0], CAMERA.intrinsics, 5)


def test_points_anywhere_are_no_scan(scan):
    depth_m, _ = scan
    anywhere_m = 20 * (np.random.default_rng(0).random(depth_m.shape) < 0.04).astype(np.float32)
    assert is_scan(depth_m, CAMERA.intrinsics)
    assert not is_scan(anywhere_m, CAMERA.intrinsics)
    assert not is_scan(np.ones_like(depth_m), CAMERA.intrinsics)


@pytest.mark.parametrize("stem", ["0000000005", "0000000021", "0000000037"])
def test_lines_are_the_lasers_of_a_real_scan(real_data, stem):
    folder = real_data / "kitti_odom_04"
    calibration = dict(line.split(":", 1) for line in (folder / "calib.txt").read_text().splitlines())
    projection, pose = (np.array(calibration[key].split(), float).reshape(3, 4) for key in ("P2", "Tr"))
    points = np.fromfile(folder / f"velodyne_fov/{stem}.bin", np.float32).reshape(-1, 4)[:, :3].T
    azimuth = np.arctan2(points[1], points[0])
    ring = np.append(0, np.cumsum((azimuth[:-1] < 0) & (azimuth[1:] >= 0)))  # a laser's turn starts straight ahead
    u, v, z = projection[:, :3] @ (pose[:, :3] @ points + pose[:, 3:]) + projection[:, 3:]
    depth_m = cv2.imread(str(folder / f"cam2/velodyne_raw/{stem}.png"), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
    inside = (u / z > -0.5) & (u / z < depth_m.shape[1] - 0.5) & (v / z > -0.5) & (v / z < depth_m.shape[0] - 0.5)
    _, laser = rasterise(np.stack([u / z, v / z])[:, inside], z[inside], ring[inside], depth_m.shape)
    laser[depth_m == 0] = -1
    line = scan_lines(depth_m, projection[:, :3])
    assert agreement(laser, line) > 0.94
    assert line.max() + 1 == len(np.unique(laser[laser >= 0])) == 46
