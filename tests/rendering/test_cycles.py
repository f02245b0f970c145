"""Cycles against closed forms, and against the ray-caster, which shares no code with it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.ndimage import maximum_filter, minimum_filter

from depthreg.errors import InputError
from depthreg.rendering import Camera, Cycles, render_frame
from depthreg.worlds import BlocksWorld, DrivingWorld, HouseholdWorld
from depthreg.worlds.scene import Material, Scene

CAMERA = Camera(width=53, height=37, focal_px=45.0, center_px=(24.2, 19.7), margin_px=3, baseline_m=0.8)


@pytest.fixture
def cycles(blender_python: Path) -> Cycles:
    """As few paths as these pictures need; they have no noise to remove."""
    return Cycles(samples=4, denoise=False, threads=1, python=str(blender_python))


def test_ground_depth_follows_the_closed_form(
    cycles: Cycles, make_scene: Callable[..., Scene], ground: trimesh.Trimesh
) -> None:
    geometry = cycles.geometry(make_scene(ground, up_m=1.5), CAMERA)
    rows = np.arange(20, 37)
    expected = 1.5 * 45.0 / (rows - 19.7)  # camera height * focal length / rows below the horizon
    np.testing.assert_allclose(geometry.depth_m[20:], np.repeat(expected[:, None], 53, axis=1), rtol=1e-4)
    np.testing.assert_allclose(geometry.normal[20:], np.broadcast_to([0, -1, 0], (17, 53, 3)), atol=1e-5)
    assert (geometry.depth_m[:19] == 0).all()
    assert (geometry.object_id[:19] == -1).all() and (geometry.object_id[20:] == 0).all()


@pytest.mark.parametrize("world", [DrivingWorld(styles=("city",)), HouseholdWorld(), BlocksWorld()])
def test_both_renderers_find_the_same_surfaces(
    cycles: Cycles, world: Callable[[int, int], Scene], blender_python: Path
) -> None:
    scene = replace(world(1, 2), depth_bin_m=None)
    camera = Camera(width=211, height=83, focal_px=120.0, center_px=(101.3, 44.8))
    found, expected = cycles.geometry(scene, camera), render_frame(scene, camera, None, right=False)
    # Away from edges: all pixels around show the same object.
    one_object = maximum_filter(expected.object_id, 3) == minimum_filter(expected.object_id, 3)
    away = one_object & (expected.depth_m > 0)
    assert away.mean() > 0.2
    assert (np.abs(found.depth_m - expected.depth_m)[away] <= 2e-3).mean() >= 0.999
    assert (found.object_id == expected.object_id)[one_object].mean() >= 0.999
    assert (np.abs(found.normal - expected.normal).max(axis=-1) < 1e-3)[one_object].mean() >= 0.999


def test_colour_is_albedo_times_light_then_gamma(
    cycles: Cycles, make_scene: Callable[..., Scene], ground: trimesh.Trimesh
) -> None:
    material = Material((0.6, 0.3, 0.1))
    scene = make_scene(ground, material=material, sun=(1, 0, 1), ambient_rgb=(0.1, 0.2, 0.3), up_m=1.5)
    linear = np.array([0.6, 0.3, 0.1]) * (np.cos(np.pi / 4) + np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(cycles(scene, CAMERA, None, right=False).rgb[39, 30], 255 * linear ** (1 / 2.2), atol=1)


def test_a_lamps_light_falls_with_the_square_of_the_distance(
    cycles: Cycles, make_scene: Callable[..., Scene], wall: Callable[[float], trimesh.Trimesh]
) -> None:
    scene = make_scene(wall(4.0), material=Material((0.5, 0.5, 0.5)), ambient_rgb=(0, 0, 0))
    light = replace(scene.light, lamp_m=(0.0, 1.0, 0.0), sun_rgb=(1.0, 0.6, 0.3))
    frame = cycles(replace(scene, light=light), CAMERA, None, right=False)
    rays = CAMERA.rays(3)
    distance_m = np.sqrt((4 * rays[..., 0]) ** 2 + (4 * rays[..., 1]) ** 2 + 3**2)
    irradiance = (2 / distance_m) ** 2 * 3 / distance_m  # `sun_rgb` is stated at 2 m
    linear = 0.5 * irradiance[..., None] * [1.0, 0.6, 0.3]
    np.testing.assert_allclose(frame.rgb, 255 * linear ** (1 / 2.2), atol=1.5)


def test_a_flash_lights_a_wall_by_lamberts_law_and_the_square_of_the_distance(
    cycles: Cycles, make_scene: Callable[..., Scene], wall: Callable[[float], trimesh.Trimesh]
) -> None:
    scene = make_scene(wall(2.5), material=Material((0.4, 0.4, 0.4)))  # its sun shines on the wall by day
    for amplitude, beside_m in zip(cycles.infrared(scene, CAMERA), (0.0, 0.8), strict=True):
        x_m, y_m = 2.5 * CAMERA.rays()[..., 0] + beside_m, 2.5 * CAMERA.rays()[..., 1]
        distance_m = np.sqrt(x_m**2 + y_m**2 + 2.5**2)
        np.testing.assert_allclose(amplitude, 0.4 * 2.5 / distance_m**3, rtol=0.01)


def test_projected_dots_let_a_matcher_find_a_blank_wall(
    cycles: Cycles, make_scene: Callable[..., Scene], wall: Callable[[float], trimesh.Trimesh]
) -> None:
    camera = Camera(width=160, height=96, focal_px=150.0, baseline_m=0.2)
    dots = np.zeros((64, 64), np.float32)
    dots[*np.random.default_rng(0).integers(1, 63, (2, 300))] = 1
    scene = make_scene(wall(2.5), material=Material((0.5, 0.5, 0.5)))
    views = replace(cycles, samples=32).infrared(scene, camera, 0.1, cv2.GaussianBlur(dots, (3, 3), 0.7), 0.8)
    left, right = (np.uint8(255 * (view / 0.08).clip(0, 1) ** 0.5) for view in views)
    matcher = cv2.StereoSGBM.create(numDisparities=32, blockSize=7, P1=400, P2=1600, uniquenessRatio=10)
    found_px = matcher.compute(left, right)[10:-10, 40:-10] / 16
    assert (np.abs(found_px - 150 * 0.2 / 2.5) < 0.5).mean() > 0.95


def test_fog_fades_colour_by_beer_lambert(
    cycles: Cycles, make_scene: Callable[..., Scene], wall: Callable[[float], trimesh.Trimesh]
) -> None:
    scene = make_scene(wall(90.0), material=Material((0.0, 0.0, 0.0)))
    light = replace(scene.light, fog_per_m=0.01, sky_horizon_rgb=(0.8, 0.8, 0.8))
    frame = cycles(replace(scene, light=light), CAMERA, None, right=False)
    range_m = 90 * np.linalg.norm(CAMERA.rays(3)[5, 8])
    np.testing.assert_allclose(frame.rgb[5, 8], 255 * (0.8 * (1 - np.exp(-0.01 * range_m))) ** (1 / 2.2), atol=1)


def test_all_three_views_stand_where_they_should_and_show_the_same_texture(cycles: Cycles) -> None:
    scene, rgb_from_depth = DrivingWorld(styles=("suburb",), coarse_leaves=True)(0, 1), np.eye(4)
    rgb_from_depth[:3, 3] = [0.3, -0.2, 0.05]
    camera = Camera(width=211, height=83, focal_px=120.0, margin_px=5)
    found, expected = (
        renderer(scene, camera, None, rgb_from_depth=rgb_from_depth) for renderer in (cycles, render_frame)
    )
    assert found.offset and expected.offset
    for ours, theirs in [
        (found.rgb, expected.rgb),
        (found.rgb_right, expected.rgb_right),
        (found.offset.rgb, expected.offset.rgb),
    ]:
        assert ours.shape == theirs.shape
        assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.93
    assert np.corrcoef(found.rgb.ravel(), np.roll(expected.rgb, 3, axis=1).ravel())[0, 1] < 0.93
    np.testing.assert_array_equal(found.depth_m, expected.depth_m)


def test_the_same_seed_gives_the_same_picture_and_another_one_other_noise(cycles: Cycles) -> None:
    scene = HouseholdWorld()(0, 0)
    first, second, other = (replace(cycles, seed=seed)(scene, CAMERA, None, right=False).rgb for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, second)
    assert (first != other).mean() > 0.05


def test_a_frames_time_is_measured_without_starting_blender(
    cycles: Cycles, make_scene: Callable[..., Scene], ground: trimesh.Trimesh
) -> None:
    wall_s, cpu_s = cycles.frame_seconds(make_scene(ground, up_m=1.5), CAMERA)
    assert 0 < cpu_s < 1.5 * wall_s + 0.1  # one thread


@pytest.mark.parametrize("option", [{"samples": 0}, {"timeout_s": -1.0}, {"threads": 0}])
def test_numbers_that_cant_be_meant_are_refused(option: dict[str, float]) -> None:
    with pytest.raises(InputError, match="positive"):
        Cycles(**option)  # type: ignore[arg-type]
