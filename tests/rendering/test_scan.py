from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from depthreg.rendering import SCANNERS, Camera, ScanPattern, hdl64, render_frame
from depthreg.worlds import DrivingWorld
from depthreg.worlds.scene import Scene

MakeScene = Callable[..., Scene]
MakeWall = Callable[[float], trimesh.Trimesh]

CAMERA = Camera(width=413, height=125, focal_px=240.0)
LIDAR_UP_M, LIDAR_BACK_M = 0.076, 0.272  # KITTI's rig


def test_ground_ranges_follow_the_closed_form(make_scene: MakeScene, ground: trimesh.Trimesh) -> None:
    scan = hdl64()
    lidar = render_frame(make_scene(ground, up_m=1.65), CAMERA, scan, right=False).lidar
    down = -np.sin(np.deg2rad(scan.elevations_deg))[lidar.ring]
    assert len(lidar.ring) > 2000
    up_m = 1.65 + LIDAR_UP_M + np.asarray(scan.laser_up_m)[lidar.ring]
    np.testing.assert_allclose(lidar.range_m, up_m / down, rtol=1e-4)
    np.testing.assert_allclose(lidar.cos_incidence, down, atol=1e-4)
    np.testing.assert_allclose(lidar.albedo, 0.5, atol=0.01)


def test_returns_lie_where_their_points_project(make_scene: MakeScene, ground: trimesh.Trimesh) -> None:
    scan = hdl64()
    lidar = render_frame(make_scene(ground, up_m=1.65), CAMERA, scan, right=False).lidar
    # A ground point's depth gives its row: focal * camera height / depth below the horizon.
    np.testing.assert_allclose(lidar.uv_px[:, 1], 62 + 240.0 * 1.65 / lidar.depth_m, atol=0.01)
    x = (lidar.uv_px[:, 0] - 206) / 240.0 * lidar.depth_m
    along = lidar.depth_m + LIDAR_BACK_M
    up_m = 1.65 + LIDAR_UP_M + np.asarray(scan.laser_up_m)[lidar.ring]
    expected = np.sqrt((x + 0.004) ** 2 + along**2 + up_m**2)
    np.testing.assert_allclose(lidar.range_m, expected, rtol=1e-3)


def test_a_return_at_another_range_moves_along_its_ray(make_scene: MakeScene, ground: trimesh.Trimesh) -> None:
    scan = hdl64()
    lidar = render_frame(make_scene(ground, up_m=1.65), CAMERA, scan, right=False).lidar
    uv1 = np.column_stack([lidar.uv_px, np.ones(len(lidar.ring))])
    points = uv1 @ np.linalg.inv(CAMERA.intrinsics).T * lidar.depth_m[:, None]
    start = points - lidar.range_m[:, None] * lidar.ray
    up_m = LIDAR_UP_M + np.asarray(scan.laser_up_m)[lidar.ring]
    lasers = np.column_stack([np.full(len(up_m), -0.004), -up_m, np.full(len(up_m), -LIDAR_BACK_M)])
    np.testing.assert_allclose(start, lasers, atol=2e-3)


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


def test_returns_behind_a_pole_are_seen_through_it(make_scene: MakeScene, wall: MakeWall) -> None:
    # The LiDAR looks over a low wall at what the lower camera can't see behind it.
    low = trimesh.creation.box(bounds=[(-3.0, 4.0, -5.0), (3.0, 4.1, 0.0)])
    frame = render_frame(make_scene(low, wall(20.0)), CAMERA, hdl64(), right=False)
    lidar = frame.lidar
    u, v = np.rint(lidar.uv_px).astype(int).T
    hidden = lidar.depth_m > frame.depth_m[v, u] + 5.0
    assert hidden.sum() >= 20
    np.testing.assert_allclose(lidar.depth_m[hidden], 20.0, atol=0.02)  # azimuths are reported in ticks
    np.testing.assert_allclose(frame.depth_m[v, u][hidden], 4.0, atol=1e-3)


def test_most_returns_agree_with_the_cameras_depth_and_only_some_are_see_through() -> None:
    frame = render_frame(DrivingWorld(styles=("city",))(0, 3), Camera(1242, 375, 721.5), hdl64(), right=False)
    u, v = np.rint(frame.lidar.uv_px).astype(int).T
    error = frame.lidar.depth_m / np.where(frame.depth_m > 0, frame.depth_m, np.inf)[v, u] - 1
    assert (np.abs(error) < 0.05).mean() > 0.9
    assert 0.001 < (error > 0.2).mean() < 0.1


def test_a_beam_that_meets_nothing_reports_nothing(make_scene: MakeScene, ground: trimesh.Trimesh) -> None:
    upwards = ScanPattern((2.0, 1.0), azimuth_step_deg=0.2)
    assert len(render_frame(make_scene(ground, up_m=1.65), CAMERA, upwards, right=False).lidar.ring) == 0


def test_no_scanner_gives_no_returns(make_scene: MakeScene, ground: trimesh.Trimesh) -> None:
    lidar = render_frame(make_scene(ground, up_m=1.65), CAMERA, None, right=False).lidar
    assert lidar.uv_px.shape == (0, 2)
    assert lidar.range_m.dtype == np.float32


def test_the_scan_is_as_dense_as_a_real_one() -> None:
    # A real HDL-64E fills 3.6 to 4.5 % of a KITTI image; ours has no drop-out, so it has somewhat more.
    frame = render_frame(DrivingWorld()(0, 0), Camera(1242, 375, 721.5), hdl64(), right=False)
    assert 0.03 < len(frame.lidar.ring) / (1242 * 375) < 0.05


def share_of_disc_beyond(chord: float) -> float:
    """By counting points."""
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 400_000))
    inside = x**2 + y**2 < 1
    return (x[inside] > chord).mean()


def split_beam(make_scene: MakeScene, edge_deg: float, *behind: trimesh.Trimesh) -> tuple[float, ...]:
    """Range, far range and near share of the one beam straight ahead; a wall covers all that is left of an angle."""
    x_m = -0.004 - np.tan(np.deg2rad(edge_deg)) * (10.0 + LIDAR_BACK_M)
    near = trimesh.creation.box(bounds=[(-50.0, 10.0, -20.0), (x_m, 10.1, 20.0)])
    scan = ScanPattern((0.0,), azimuth_step_deg=0.2, divergence_mrad=2.0)
    lidar = render_frame(make_scene(near, *behind), CAMERA, scan, right=False).lidar
    ahead = np.flatnonzero(np.abs(lidar.ray[:, 0]) < 1e-5)
    return tuple(float(values[ahead[0]]) for values in (lidar.range_m, lidar.far_range_m, lidar.near_share))


@pytest.mark.parametrize("edge", [-0.95, -0.5, 0.0, 0.5, 0.95])
def test_an_edge_splits_a_beam_in_the_shares_of_its_disc(make_scene: MakeScene, wall: MakeWall, edge: float) -> None:
    edge_deg = np.rad2deg(edge * 0.001)  # in radii of the beam; the near wall covers what lies left (above)
    range_m, far_range_m, near_share = split_beam(make_scene, edge_deg, wall(14.0))
    assert (range_m, far_range_m) == pytest.approx((10.0 + LIDAR_BACK_M, 14.0 + LIDAR_BACK_M), abs=1e-3)
    assert near_share == pytest.approx(share_of_disc_beyond(edge), abs=0.09)  # the edge's place is known to an eighth


@pytest.mark.parametrize("edge", [-1.1, 1.1])
def test_a_beam_beside_an_edge_stays_whole(make_scene: MakeScene, wall: MakeWall, edge: float) -> None:
    range_m, far_range_m, near_share = split_beam(make_scene, np.rad2deg(edge * 0.001), wall(14.0))
    assert range_m == far_range_m == pytest.approx((14.0 if edge > 0 else 10.0) + LIDAR_BACK_M, abs=1e-3)
    assert near_share == 1


def test_a_beam_half_into_the_sky_brings_the_other_half_back(make_scene: MakeScene) -> None:
    for edge, share in ((-0.5, 0.8), (0.5, 0.2)):
        range_m, far_range_m, near_share = split_beam(make_scene, np.rad2deg(edge * 0.001))
        assert range_m == far_range_m == pytest.approx(10.0 + LIDAR_BACK_M, abs=1e-3)
        assert near_share == pytest.approx(share, abs=0.1)


def test_slanted_surfaces_split_no_beam(make_scene: MakeScene, ground: trimesh.Trimesh) -> None:
    along = trimesh.creation.box(bounds=[(2.0, -50.0, -30.0), (3.0, 400.0, 30.0)])  # a wall beside the road
    for thing in (ground, along):
        lidar = render_frame(make_scene(thing, up_m=1.65), CAMERA, hdl64(), right=False).lidar
        assert len(lidar.ring) > 1000 and (lidar.near_share == 1).all()
        np.testing.assert_array_equal(lidar.range_m, lidar.far_range_m)


def test_few_beams_of_a_street_are_split_and_the_far_part_is_never_nearer() -> None:
    lidar = render_frame(DrivingWorld()(1, 2), CAMERA, hdl64(), right=False).lidar
    split = lidar.near_share < 1
    assert 0.005 < split.mean() < 0.15
    assert (lidar.far_range_m >= lidar.range_m).all() and (lidar.near_share > 0).all()


@pytest.mark.parametrize(("residual", "off_m"), [(0.0, 0.0), (0.5, 0.25), (1.0, 0.5)])
def test_points_carry_the_stated_share_of_the_motion_during_a_sweep(
    make_scene: MakeScene, wall: MakeWall, residual: float, off_m: float
) -> None:
    # 10 m/s towards a wall; a raster's first row fires 0.05 s before the picture, so from half a metre farther away.
    scan = ScanPattern(
        (0.1, -0.1), 0.2, raster=True, view_deg=60.0, sweep_s=0.1, motion_residual=residual, divergence_mrad=0.0
    )
    scene = replace(make_scene(wall(20.0)), velocity_m_per_s=(0.0, 10.0, 0.0))
    lidar = render_frame(scene, CAMERA, scan, right=False).lidar
    first = lidar.ring == 0
    ahead = first & (np.abs(lidar.ray[:, 0]) < 0.01)
    np.testing.assert_allclose(lidar.range_m[ahead], 20.5 + LIDAR_BACK_M, atol=5e-3)
    np.testing.assert_allclose(lidar.depth_m[first], 20.0 + off_m, atol=1e-3)
    np.testing.assert_allclose(lidar.depth_m[~first], 20.0, atol=1e-3)  # the middle row fires with the camera


@pytest.mark.parametrize("name", SCANNERS)
def test_every_scanner_fills_a_street(name: str) -> None:
    lidar = render_frame(DrivingWorld()(0, 0), CAMERA, SCANNERS[name], right=False).lidar
    lines = len(np.unique(lidar.ring))
    assert lines >= min(len(SCANNERS[name].elevations_deg) // 3, 40)
    assert len(lidar.ring) > 100 * lines
    np.testing.assert_allclose(np.linalg.norm(lidar.ray, axis=1), 1, atol=1e-4)


def test_another_start_of_the_sweep_moves_the_returns(make_scene: MakeScene, wall: MakeWall) -> None:
    scan = ScanPattern((0.0,), azimuth_step_deg=0.2)
    frames = [render_frame(make_scene(wall(20.0)), CAMERA, replace(scan, start=s), right=False) for s in (0.0, 0.25)]
    middle = [min(frame.lidar.uv_px[:, 0], key=lambda u: abs(u - 206.2)) for frame in frames]
    shift_px = 240.0 * np.deg2rad(0.05) * (20 + LIDAR_BACK_M) / 20  # to the left
    assert (middle[0] - middle[1]) % (4 * shift_px) == pytest.approx(shift_px, abs=0.01)
