"""Misalignments: how far they reach, what they show, and what they must not give away."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from depthreg.errors import InputError
from depthreg.geometry import identity_affine, warp_affine
from depthreg.rendering import Camera, RandomOffset, render_frame
from depthreg.sensors.misalignment import fit_affine, margin_for, misalign_rgb, random_affines
from depthreg.worlds import DrivingWorld

SIZE = (61, 93)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def corner_shifts_px(affines: Tensor) -> np.ndarray:
    """Moved by OpenCV, so that our own geometry does not vouch for itself."""
    height, width = SIZE
    corners = np.array([[[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]]], np.float64)
    moved = np.stack([cv2.transform(corners, affine.double().numpy())[0] for affine in affines])
    return np.linalg.norm(moved - corners, axis=-1)  # (B, 4)


@pytest.mark.parametrize("limit_px", [0.7, 24.0])
def test_the_worst_corner_shift_is_uniform_up_to_its_limit(limit_px: float) -> None:
    worst = corner_shifts_px(random_affines(1500, SIZE, limit_px, generator())).max(axis=1) / limit_px
    assert worst.max() <= 1 + 1e-4
    for quantile in (0.1, 0.5, 0.9, 0.999):
        assert np.quantile(worst, quantile) == pytest.approx(quantile, abs=0.05)


def test_a_limit_of_zero_is_the_identity() -> None:
    assert torch.equal(random_affines(5, SIZE, 0.0, generator()), identity_affine(5))


def test_every_kind_of_misalignment_occurs_in_both_directions() -> None:
    deviation = random_affines(200, SIZE, 10.0, generator()) - identity_affine(200)
    rotation = deviation[:, 1, 0] - deviation[:, 0, 1]
    scale = deviation[:, 0, 0] + deviation[:, 1, 1]
    shear = deviation[:, 1, 0] + deviation[:, 0, 1]
    aspect = deviation[:, 0, 0] - deviation[:, 1, 1]
    for kind in (deviation[:, 0, 2], deviation[:, 1, 2], rotation, scale, shear, aspect):
        assert 0.3 < (kind > 0).float().mean() < 0.7
        assert kind.abs().max() > 1e-3


def test_the_generators_seed_decides() -> None:
    first, again, other = (random_affines(4, SIZE, 9.0, generator(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)


def smooth_with_margin(margin_px: int) -> Tensor:
    shape = (SIZE[0] + 2 * margin_px, SIZE[1] + 2 * margin_px, 3)
    noise = np.random.default_rng(0).random(shape, np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4)
    return torch.from_numpy((smooth - smooth.min()) / np.ptp(smooth)).permute(2, 0, 1)[None]


def test_the_misaligned_view_shows_at_a_of_x_what_the_depth_has_at_x() -> None:
    margin_px = margin_for(8.0)
    image = smooth_with_margin(margin_px)
    truth = image[..., margin_px:-margin_px, margin_px:-margin_px]
    for affine in random_affines(8, SIZE, 8.0, generator()).split(1):
        misaligned = misalign_rgb(image, affine, margin_px)
        aligned, seen = warp_affine(misaligned, affine)
        error = ((aligned - truth).abs() * seen).max()
        assert error < 0.02  # two bilinear interpolations of a smooth image
        if corner_shifts_px(affine).max() > 2:
            assert ((misaligned - truth).abs() * seen).max() > 4 * error


def test_a_shift_moves_the_view_the_stated_way() -> None:
    image = smooth_with_margin(6)
    shift = torch.tensor([[[1.0, 0, 4], [0, 1, -3]]])
    expected = image[..., 6 + 3 : 6 + 3 + SIZE[0], 6 - 4 : 6 - 4 + SIZE[1]]
    torch.testing.assert_close(misalign_rgb(image, shift, 6), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("limit_px", [0.5, 1.8, 7.4])  # up to four times the share of the width in use
def test_no_black_border_gives_the_answer_away(limit_px: float) -> None:
    margin_px = margin_for(limit_px)
    white = torch.ones(64, 1, SIZE[0] + 2 * margin_px, SIZE[1] + 2 * margin_px)
    for seed in range(4):
        affines = random_affines(64, SIZE, limit_px, generator(seed))
        assert misalign_rgb(white, affines, margin_px).min() > 0.999


K = np.array([[80.0, 0, 44], [0, 80, 31], [0, 0, 1]])


def moved_by(shift_m: tuple[float, float, float], turn_deg: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """`rgb_from_depth` of a colour camera that stands and looks elsewhere."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    pose[:3, 3] = shift_m
    return pose


def test_a_wall_parallel_to_the_image_is_seen_through_an_exact_affine() -> None:
    affine, parallax_px = fit_affine(np.full(SIZE, 4.0), K, moved_by((0.2, -0.1, 1.0), (0, 0, 3)))
    scale = 4 / 5  # it lies a metre farther from the colour camera
    cos, sin = scale * np.cos(np.deg2rad(3)), scale * np.sin(np.deg2rad(3))
    shift = [44 + 80 * 0.2 / 5 - cos * 44 + sin * 31, 31 - 80 * 0.1 / 5 - sin * 44 - cos * 31]
    np.testing.assert_allclose(affine, [[cos, -sin, shift[0]], [sin, cos, shift[1]]], atol=1e-4)
    assert parallax_px < 1e-6


@pytest.mark.parametrize("baseline_m", [0.06, -0.1])
def test_two_walls_are_apart_by_the_difference_of_their_disparities(baseline_m: float) -> None:
    depth_m = np.where(np.arange(SIZE[0])[:, None] % 2, 2.0, 2.5) * np.ones(SIZE)  # interleaved: no affine helps
    _, parallax_px = fit_affine(depth_m, K, moved_by((baseline_m, 0, 0)))
    apart_px = 80 * abs(baseline_m) * (1 / 2.0 - 1 / 2.5)
    assert apart_px < 1  # so that neither hides the other
    assert parallax_px == pytest.approx(apart_px / 2, rel=2e-3)  # the affine goes halfway between


def test_turning_alone_leaves_next_to_no_parallax_at_any_depth() -> None:
    depth_m = np.random.default_rng(0).uniform(1, 90, SIZE)
    turn_deg = (0.5, -0.4, 0.6)
    affine, parallax_px = fit_affine(depth_m, K, moved_by((0, 0, 0), turn_deg))
    homography = K @ Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix() @ np.linalg.inv(K)
    corners = np.array([[[0, 0], [92, 0], [0, 60], [92, 60]]], np.float64)
    expected = cv2.perspectiveTransform(corners, homography)
    np.testing.assert_allclose(cv2.transform(corners, affine.astype(np.float64)), expected, atol=0.3)
    assert 0 < parallax_px < 0.1


def test_what_something_nearer_hides_from_the_colour_camera_has_no_say() -> None:
    depth_m = np.full(SIZE, 8.0)
    depth_m[:, 40:50] = 1.0
    affine, parallax_px = fit_affine(depth_m, K, moved_by((0.1, 0, 0)))  # the post moves by 8 px, the wall by 1
    column = np.arange(SIZE[1])
    place = column + np.where(depth_m[0] == 1, 8.0, 1.0)
    behind_the_post = (depth_m[0] == 8) & (place >= 48) & (place <= 57)
    seen = ~behind_the_post & (place <= 92)
    (slope, shift), squares, *_ = np.polyfit(column[seen], place[seen], 1, full=True)
    np.testing.assert_allclose(affine[0], [slope, 0, shift], atol=1e-4)
    np.testing.assert_allclose(affine[1], [0, 1, 0], atol=1e-4)
    assert parallax_px == pytest.approx(np.sqrt(squares[0] / seen.sum()), rel=1e-6)


@pytest.mark.parametrize("depth_m", [np.zeros(SIZE), np.eye(*SIZE) * (np.arange(SIZE[1]) < 2)], ids=["sky", "2 points"])
def test_where_nothing_says_where_the_colour_lies_the_affine_is_the_identity(depth_m: np.ndarray) -> None:
    affine, parallax_px = fit_affine(depth_m, K, moved_by((0.1, 0, 0)))
    np.testing.assert_array_equal(affine, np.eye(2, 3))
    assert parallax_px == 0


def test_points_behind_the_colour_camera_have_no_say() -> None:
    depth_m = np.full(SIZE, 4.0)
    depth_m[::7] = 0.5
    affine, parallax_px = fit_affine(depth_m, K, moved_by((0, 0, -1)))
    np.testing.assert_allclose(affine[:, :2], np.eye(2) * 4 / 3, atol=1e-4)
    assert parallax_px < 1e-6


def test_an_offset_view_is_what_a_camera_standing_there_sees() -> None:
    scene, camera = DrivingWorld(styles=("city",))(0, 1), Camera(83, 37, focal_px=48.0, margin_px=4)
    pose = moved_by((0.3, -0.2, 0.1), (2, -3, 1))
    offset = render_frame(scene, camera, None, right=False, rgb_from_depth=pose).offset
    moved = replace(scene, camera_from_world=pose @ scene.camera_from_world)
    expected = render_frame(moved, camera, None, right=False).rgb
    assert offset is not None
    difference = np.abs(offset.rgb.astype(int) - expected)
    assert difference.mean() < 0.5 and (difference.max(axis=-1) > 40).mean() < 0.005


@pytest.mark.parametrize("index", [1, 2])
def test_the_best_affine_brings_an_offset_view_onto_the_depths_grid(index: int) -> None:
    camera, margin_px = Camera(161, 61, focal_px=94.0, margin_px=9), 9
    pose = moved_by((0.06, -0.05, 0.04), (1.0, -1.2, 0.8))
    frame = render_frame(DrivingWorld()(0, index), camera, None, right=False, rgb_from_depth=pose)
    assert frame.offset is not None
    affine, parallax_px = fit_affine(frame.depth_m, frame.intrinsics, pose)
    inner = np.s_[margin_px:-margin_px, margin_px:-margin_px]
    truth, view = frame.rgb[inner].astype(np.float32), frame.offset.rgb[inner].astype(np.float32)
    aligned = cv2.warpAffine(view, affine, (161, 61), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    rim = np.s_[4:-4, 4:-4]
    before, after = (np.corrcoef(image[rim].ravel(), truth[rim].ravel())[0, 1] for image in (view, aligned))
    assert after > 0.9 and 1 - after < 0.5 * (1 - before)
    assert 0 < parallax_px < 1


def test_the_best_affine_lines_up_the_two_cameras_of_a_real_car(real_data: Path) -> None:
    folder = real_data / "kitti_odom_04"  # depth belongs to a grey camera, which judges where the colour lands
    rig = json.loads((folder / "cameras.json").read_text())
    intrinsics = np.array([[rig["f"], 0, rig["cx"]], [0, rig["f"], rig["cy"]], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, 3] = np.linalg.solve(intrinsics, [rig["tx"], rig["ty"], rig["tz"]])
    for name in ("0000000005.png", "0000000025.png"):
        grey, color = (
            cv2.imread(str(folder / camera / "image" / name), cv2.IMREAD_GRAYSCALE) for camera in ("cam0", "cam2")
        )
        depth_m = cv2.imread(str(folder / "cam0" / "groundtruth_depth" / name), cv2.IMREAD_UNCHANGED) / 256
        affine, parallax_px = fit_affine(depth_m, intrinsics, pose)
        aligned = cv2.warpAffine(color, affine, color.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        known = depth_m > 0
        before, after = (np.corrcoef(image[known], grey[known])[0, 1] for image in (color, aligned))
        assert 1 - after < 0.4 * (1 - before)
        assert 0.3 < parallax_px < 1.2  # KITTI's lenses are 6 cm apart


@pytest.mark.parametrize("limits", [(-0.01, 0.5), (0.05, -1.0), (0.05, 45.0), (float("nan"), 0.5)])
def test_an_offset_that_cannot_be_meant_is_refused(limits: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="max_shift_m"):
        RandomOffset(*limits)


def test_a_random_offset_is_rigid_and_within_its_limits() -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([RandomOffset(0.05, 0.8)(rng) for _ in range(300)])
    rotation, shift_m = poses[:, :3, :3], poses[:, :3, 3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (300, 3, 3)), atol=1e-9
    )
    turn_deg = np.rad2deg(Rotation.from_matrix(rotation).as_rotvec())
    assert 0.045 < np.abs(shift_m).max() <= 0.05
    assert 0.7 < np.abs(turn_deg).max() <= 0.82
