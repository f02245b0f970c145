from collections.abc import Callable

import numpy as np
import trimesh

from depthreg.rendering import Camera, ScanPattern, hdl64, render_frame
from depthreg.worlds import DrivingWorld
from depthreg.worlds.scene import Scene

CAMERA = Camera(width=413, height=125, focal_px=240.0)
LIDAR_UP_M, LIDAR_BACK_M = 0.076, 0.272  # KITTI's rig


def test_ground_ranges_follow_the_closed_form(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    scan = hdl64()
    lidar = render_frame(make_scene(ground, up_m=1.65), CAMERA, scan, right=False).lidar
    down = -np.sin(np.deg2rad(scan.elevations_deg))[lidar.ring]
    assert len(lidar.ring) > 2000
    np.testing.assert_allclose(lidar.range_m, (1.65 + LIDAR_UP_M) / down, rtol=1e-4)
    np.testing.assert_allclose(lidar.cos_incidence, down, atol=1e-4)
    np.testing.assert_allclose(lidar.albedo, 0.5, atol=0.01)


def test_returns_lie_where_their_points_project(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    lidar = render_frame(make_scene(ground, up_m=1.65), CAMERA, hdl64(), right=False).lidar
    # A ground point's depth gives its row: focal * camera height / depth below the horizon.
    np.testing.assert_allclose(lidar.uv_px[:, 1], 62 + 240.0 * 1.65 / lidar.depth_m, atol=0.01)
    x = (lidar.uv_px[:, 0] - 206) / 240.0 * lidar.depth_m
    along = lidar.depth_m + LIDAR_BACK_M
    expected = np.sqrt((x + 0.004) ** 2 + along**2 + (1.65 + LIDAR_UP_M) ** 2)
    np.testing.assert_allclose(lidar.range_m, expected, rtol=1e-3)


def test_returns_stay_inside_the_image_and_within_range() -> None:
    frame = render_frame(DrivingWorld()(1, 2), CAMERA, hdl64(), right=False)
    lidar = frame.lidar
    assert (lidar.uv_px >= 0).all()
    assert (lidar.uv_px <= [412, 124]).all()
    assert (lidar.range_m <= 120.0).all()
    assert (lidar.depth_m > 0).all()
    assert (lidar.cos_incidence >= 0).all() and (lidar.cos_incidence <= 1).all()
    assert lidar.ring.dtype == np.int16
    assert {len(values) for values in vars(lidar).values()} == {len(lidar.ring)}


def test_returns_behind_a_pole_are_seen_through_it(
    make_scene: Callable[..., Scene], wall: Callable[..., trimesh.Trimesh]
) -> None:
    # The LiDAR looks over a low wall at what the lower camera can't see behind it.
    low = trimesh.creation.box(bounds=[(-3.0, 4.0, -5.0), (3.0, 4.1, 0.0)])
    frame = render_frame(make_scene(low, wall(20.0)), CAMERA, hdl64(), right=False)
    lidar = frame.lidar
    u, v = np.rint(lidar.uv_px).astype(int).T
    hidden = lidar.depth_m > frame.depth_m[v, u] + 5.0
    assert hidden.sum() >= 20
    np.testing.assert_allclose(lidar.depth_m[hidden], 20.0, atol=1e-3)
    np.testing.assert_allclose(frame.depth_m[v, u][hidden], 4.0, atol=1e-3)


def test_most_returns_agree_with_the_cameras_depth_and_only_some_are_see_through() -> None:
    frame = render_frame(DrivingWorld(styles=("city",))(0, 3), Camera(1242, 375, 721.5), hdl64(), right=False)
    u, v = np.rint(frame.lidar.uv_px).astype(int).T
    error = frame.lidar.depth_m / np.where(frame.depth_m > 0, frame.depth_m, np.inf)[v, u] - 1
    assert (np.abs(error) < 0.05).mean() > 0.9
    assert 0.001 < (error > 0.2).mean() < 0.1


def test_a_beam_that_meets_nothing_reports_nothing(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    upwards = ScanPattern((1.0, 2.0), azimuth_step_deg=0.2)
    assert len(render_frame(make_scene(ground, up_m=1.65), CAMERA, upwards, right=False).lidar.ring) == 0


def test_no_scanner_gives_no_returns(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    lidar = render_frame(make_scene(ground, up_m=1.65), CAMERA, None, right=False).lidar
    assert lidar.uv_px.shape == (0, 2)
    assert lidar.range_m.dtype == np.float32


def test_the_scan_is_as_dense_as_a_real_one() -> None:
    # A real HDL-64E fills 3.6 to 4.5 % of a KITTI image; ours has no drop-out, so it has somewhat more.
    frame = render_frame(DrivingWorld()(0, 0), Camera(1242, 375, 721.5), hdl64(), right=False)
    assert 0.03 < len(frame.lidar.ring) / (1242 * 375) < 0.05
