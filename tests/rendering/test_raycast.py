from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from depthreg.data.sample import Frame
from depthreg.rendering import Camera, hdl64, render_frame
from depthreg.worlds import DrivingWorld
from depthreg.worlds.scene import Material, Scene

CAMERA = Camera(width=61, height=37, focal_px=50.0)


def _render(scene: Scene, camera: Camera = CAMERA) -> Frame:
    return render_frame(scene, camera, None, right=False)


def test_ground_depth_follows_the_closed_form(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    frame = _render(make_scene(ground, up_m=1.5))
    rows = np.arange(20, 37)
    expected = 1.5 * 50.0 / (rows - 18)  # camera height * focal length / rows below the horizon
    np.testing.assert_allclose(frame.depth_m[20:], np.repeat(expected[:, None], 61, axis=1), rtol=1e-4)
    np.testing.assert_allclose(frame.normal[20:], np.broadcast_to([0, -1, 0], (17, 61, 3)), atol=1e-5)


def test_a_balls_nearest_point_and_outline_are_where_geometry_says(make_scene: Callable[..., Scene]) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    ball.apply_translation([0, 10, 0])
    frame = _render(make_scene(ball))
    assert frame.depth_m[18, 30] == pytest.approx(8.0, abs=0.01)
    tangent_px = 50.0 * 2.0 / np.sqrt(10.0**2 - 2.0**2)  # the outline is where rays touch the ball
    assert (frame.depth_m > 0).sum() == pytest.approx(np.pi * tangent_px**2, rel=0.04)


def test_depth_ids_and_normals_agree_with_trimeshs_own_ray_query() -> None:
    scene = DrivingWorld(styles=("suburb",))(3, 1)
    camera = Camera(width=83, height=29, focal_px=48.0)
    frame = _render(scene, camera)

    world_from_camera = np.linalg.inv(scene.camera_from_world)
    rays = camera.rays().reshape(-1, 3) @ world_from_camera[:3, :3].T
    origins = np.broadcast_to(world_from_camera[:3, 3], rays.shape)
    mesh = trimesh.util.concatenate([o.mesh for o in scene.objects])
    owner = np.repeat(np.arange(len(scene.objects)), [len(o.mesh.faces) for o in scene.objects])
    points, ray, face = mesh.ray.intersects_location(origins, rays, multiple_hits=False)
    depth, ids = np.zeros(len(rays)), np.full(len(rays), -1)
    depth[ray] = (points @ scene.camera_from_world[:3, :3].T + scene.camera_from_world[:3, 3])[:, 2]
    ids[ray] = owner[face]
    normals = np.zeros((len(rays), 3))
    normals[ray] = np.abs(mesh.face_normals[face] @ world_from_camera[:3, :3])
    near = depth < 240

    # Rays that graze an edge may fall on either side of it.
    assert np.isclose(frame.depth_m.ravel(), depth, rtol=1e-3)[near].mean() > 0.995
    assert (frame.object_id.ravel() == ids)[near].mean() > 0.995
    assert np.isclose(np.abs(frame.normal.reshape(-1, 3)), normals, atol=2e-3).all(1)[near].mean() > 0.99


def test_normals_are_unit_and_face_the_camera() -> None:
    frame = _render(DrivingWorld()(0, 4))
    seen = frame.object_id >= 0
    assert seen.any()
    np.testing.assert_allclose(np.linalg.norm(frame.normal[seen], axis=1), 1, atol=1e-4)
    assert ((frame.normal * CAMERA.rays()).sum(-1)[seen] <= 1e-5).all()


def test_sky_is_zero_depth_no_object_and_no_normal(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    frame = _render(make_scene(ground, up_m=1.5))
    assert (frame.depth_m[:18] == 0).all()
    assert (frame.object_id[:18] == -1).all()
    assert (frame.normal[:18] == 0).all()


def test_binned_depth_lies_at_bin_centres(
    make_scene: Callable[..., Scene], wall: Callable[..., trimesh.Trimesh]
) -> None:
    scene = make_scene(wall(14.5), depth_bin_m=6.0)
    frame = render_frame(scene, CAMERA, hdl64(), right=False)
    assert (frame.depth_m == 15.0).all()  # the middle of 12 to 18 m
    assert len(frame.lidar.depth_m) > 100
    assert (frame.lidar.depth_m == 15.0).all()
    assert frame.lidar.range_m.min() < 14.9  # ranges are as measured, not binned


def test_the_right_image_of_a_wall_is_the_left_shifted_by_its_disparity(
    make_scene: Callable[..., Scene], wall: Callable[..., trimesh.Trimesh]
) -> None:
    material = Material((0.8, 0.7, 0.6), "checker", (0.1, 0.1, 0.1), scale_m=4.0)
    scene = make_scene(wall(10.0), material=material, sun=(0, -1, 0))
    # Off the pixels' grid, so that no square's border falls on a pixel's centre.
    frame = render_frame(scene, Camera(61, 37, focal_px=50.0, center_px=(30.3, 18.4), baseline_m=1.6), None)
    shift = int(50.0 * 1.6 / 10.0)
    assert frame.rgb.std() > 20
    np.testing.assert_allclose(frame.rgb_right[:, :-shift].astype(int), frame.rgb[:, shift:].astype(int), atol=2)


def test_without_the_right_camera_its_image_has_no_pixels(
    make_scene: Callable[..., Scene], ground: trimesh.Trimesh
) -> None:
    assert _render(make_scene(ground, up_m=1.5)).rgb_right.shape == (0, 0, 3)


def test_a_margin_only_adds_pixels_round_the_same_image() -> None:
    scene = DrivingWorld()(2, 5)
    plain, wide = _render(scene), _render(scene, Camera(61, 37, focal_px=50.0, margin_px=6))
    assert wide.rgb.shape == (49, 73, 3)
    np.testing.assert_array_equal(wide.rgb[6:-6, 6:-6], plain.rgb)
    np.testing.assert_array_equal(wide.depth_m, plain.depth_m)
    np.testing.assert_array_equal(wide.object_id, plain.object_id)
    np.testing.assert_array_equal(wide.intrinsics, plain.intrinsics)


def test_a_boxs_shadow_falls_where_the_sun_says(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    # 1 m high, sun at 45 deg from the left: the shadow reaches 1 m to the right of the box.
    box = trimesh.creation.box(bounds=[(-1.0, 6.0, 0.0), (0.0, 14.0, 1.0)])
    scene = make_scene(ground, box, sun=(-1, 0, 1), ambient_rgb=(0, 0, 0), up_m=4.0)
    frame = _render(scene, Camera(121, 91, focal_px=100.0))
    row = int(45 + 100.0 * 4.0 / 10.0)  # the ground 10 m ahead
    x = (np.arange(121) - 60) / 100.0 * 10.0
    on_ground = frame.object_id[row] == 0
    dark = frame.rgb[row, :, 0] < 30
    clear = np.abs(x - 1.0) > 0.15  # the lens blurs the shadow's edge
    assert (x[on_ground & dark] > -0.1).all()
    np.testing.assert_array_equal(dark[on_ground & clear], ((x > 0) & (x < 1.0))[on_ground & clear])


def test_colour_is_albedo_times_light_then_gamma(make_scene: Callable[..., Scene], ground: trimesh.Trimesh) -> None:
    material = Material((0.6, 0.3, 0.1))
    scene = make_scene(ground, material=material, sun=(1, 0, 1), ambient_rgb=(0.1, 0.2, 0.3), up_m=1.5)
    linear = np.array([0.6, 0.3, 0.1]) * (np.cos(np.pi / 4) + np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(_render(scene).rgb[36, 30], 255 * linear ** (1 / 2.2), atol=1)


def test_fog_fades_colour_by_beer_lambert(
    make_scene: Callable[..., Scene], wall: Callable[..., trimesh.Trimesh]
) -> None:
    scene = make_scene(wall(100.0), material=Material((0.0, 0.0, 0.0)))
    light = replace(scene.light, fog_per_m=0.01, sky_horizon_rgb=(0.8, 0.8, 0.8))
    frame = _render(replace(scene, light=light))
    expected = 255 * (0.8 * (1 - np.exp(-0.01 * 100.0))) ** (1 / 2.2)
    np.testing.assert_allclose(frame.rgb[18, 30], expected, atol=1)


def test_far_patterns_fade_to_their_mean_instead_of_flickering(
    make_scene: Callable[..., Scene], wall: Callable[..., trimesh.Trimesh]
) -> None:
    material = Material((0.8, 0.8, 0.8), "checker", (0.1, 0.1, 0.1), scale_m=0.3)
    near, far = (
        _render(make_scene(wall(ahead), material=material, sun=(0, -1, 0))).rgb.astype(float) for ahead in (2.0, 140.0)
    )
    assert near.std() > 40
    assert far.std() < 8
    assert cv2.mean(far)[0] == pytest.approx(255 * (0.45 * 1.15) ** (1 / 2.2), rel=0.08)


def test_the_right_image_is_what_a_camera_moved_by_the_baseline_sees() -> None:
    scene, camera = DrivingWorld(styles=("city",))(0, 1), Camera(211, 83, focal_px=120.0, margin_px=4, baseline_m=0.54)
    to_the_right = np.eye(4)
    to_the_right[0, 3] = -camera.baseline_m  # world points lie that much farther left
    moved = replace(scene, camera_from_world=to_the_right @ scene.camera_from_world)
    right = render_frame(scene, camera, None).rgb_right.astype(int)
    expected = _render(moved, replace(camera, margin_px=0)).rgb.astype(int)
    difference = np.abs(right - expected)
    assert difference.mean() < 2.5  # what the left camera saw is interpolated between its pixels
    assert (difference.max(axis=-1) > 40).mean() < 0.01


def test_a_view_of_nothing_but_sky_renders(make_scene: Callable[..., Scene]) -> None:
    behind = trimesh.creation.box(bounds=[(-1, -9, -1), (1, -8, 1)])
    frame = render_frame(make_scene(behind), CAMERA, hdl64())
    assert (frame.depth_m == 0).all()
    assert (frame.object_id == -1).all()
    assert len(frame.lidar.ring) == 0
    assert (frame.rgb[:18].mean(axis=(1, 2)) > 100).all()  # a clear sky is bright


def test_faces_that_lie_along_the_line_of_sight_have_unit_normals_too(make_scene: Callable[..., Scene]) -> None:
    # The camera stands in the plane of the box's side: of its normal's sign there, 0, no normal may be made.
    box = trimesh.creation.box(bounds=[(0.0, 4.0, -3.0), (2.0, 9.0, 3.0)])
    frame = _render(make_scene(box))
    lengths = np.linalg.norm(frame.normal[frame.object_id >= 0], axis=-1)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
