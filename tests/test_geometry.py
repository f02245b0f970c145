"""The affine convention and the pinhole camera, against OpenCV, kornia, NumPy and closed forms."""

import cv2
import kornia
import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg import geometry

SIZE = (37, 53)  # height, width
AFFINES = torch.tensor(
    [
        [[1.0, 0, 0], [0, 1, 0]],
        [[1.0, 0, 3.3], [0, 1, -2.6]],
        [[0.97, -0.11, 2.0], [0.08, 1.05, -4.5]],
        [[-1.0, 0.2, 50.0], [0.1, 0.6, 9.0]],
    ]
)
K = torch.tensor([[60.0, 0, 27.5], [0, 55.0, 17.25], [0, 0, 1]])


def smooth_images(count: int, channels: int = 3) -> Tensor:
    noise = np.random.default_rng(0).random((count * channels, *SIZE), np.float32)
    blurred = np.stack([cv2.GaussianBlur(plane, (0, 0), 3) for plane in noise])
    return torch.from_numpy(blurred).unflatten(0, (count, channels))


def square(affines: Tensor) -> np.ndarray:
    last = np.broadcast_to([0.0, 0, 1], (len(affines), 1, 3))
    return np.concatenate([affines.numpy(), last], axis=1)


def test_warp_agrees_with_opencv() -> None:
    images = smooth_images(len(AFFINES))
    warped, seen = geometry.warp_affine(images, AFFINES)
    for image, affine, ours, mask in zip(images, AFFINES, warped, seen, strict=True):
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        theirs = cv2.warpAffine(image.permute(1, 2, 0).numpy(), affine.numpy(), SIZE[::-1], flags=flags)
        error = np.abs(ours.permute(1, 2, 0).numpy() - theirs)[mask[0].numpy()]
        assert error.max() < 5e-3  # some OpenCV builds interpolate in 1/32 px


def test_warp_agrees_with_kornia() -> None:
    images = smooth_images(len(AFFINES))
    source_to_result = torch.from_numpy(np.linalg.inv(square(AFFINES))[:, :2].astype(np.float32))
    theirs = kornia.geometry.warp_affine(images, source_to_result, SIZE, align_corners=True)
    torch.testing.assert_close(geometry.warp_affine(images, AFFINES)[0], theirs, atol=1e-4, rtol=0)


def test_the_identity_warp_sees_everything_and_changes_nothing() -> None:
    images = smooth_images(2)
    warped, seen = geometry.warp_affine(images, geometry.identity_affine(2))
    torch.testing.assert_close(warped, images, atol=1e-5, rtol=0)
    assert seen.all()


def test_the_mask_is_where_the_warp_looks_inside_the_image() -> None:
    shift = torch.tensor([[[1.0, 0, 3], [0, 1, -2]]])
    _, seen = geometry.warp_affine(torch.ones(1, 1, *SIZE), shift)
    by_hand = torch.zeros(SIZE, dtype=torch.bool)
    by_hand[2:, :-3] = True
    torch.testing.assert_close(seen[0, 0], by_hand)


def test_a_whole_shift_moves_pixels_and_the_size_may_change() -> None:
    images = smooth_images(1)
    shift = torch.tensor([[[1.0, 0, 5], [0, 1, 7]]])
    warped, seen = geometry.warp_affine(images, shift, (11, 13))
    torch.testing.assert_close(warped, images[..., 7:18, 5:18], atol=1e-5, rtol=0)
    assert seen.all()


def test_the_slope_of_a_warp_by_its_affine_is_right() -> None:
    image = torch.rand(1, 1, 5, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    # No sampling position near a pixel centre, where bilinear interpolation has a kink.
    affine = torch.tensor([[[0.9, 0.05, 0.43], [0.03, 0.88, 0.37]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a: geometry.warp_affine(image, a)[0], affine, eps=1e-7, atol=1e-5)


def test_inverse_and_composition_agree_with_numpy() -> None:
    inverse = geometry.invert_affine(AFFINES)
    np.testing.assert_allclose(square(inverse), np.linalg.inv(square(AFFINES)), atol=1e-4)
    composed = geometry.compose_affines(AFFINES, AFFINES.flip(0))
    np.testing.assert_allclose(square(composed), square(AFFINES) @ square(AFFINES.flip(0)), atol=1e-4)


def test_composition_applies_the_inner_affine_first() -> None:
    points = geometry.image_corners(*SIZE).expand(len(AFFINES), -1, -1)
    inner, outer = AFFINES, AFFINES.flip(0)
    at_once = geometry.transform_points(geometry.compose_affines(outer, inner), points)
    in_turn = geometry.transform_points(outer, geometry.transform_points(inner, points))
    torch.testing.assert_close(at_once, in_turn)


@pytest.mark.parametrize(("angle_deg", "scale"), [(0.0, 1.0), (7.5, 0.93), (-33.0, 1.4)])
def test_an_affine_is_taken_apart_into_what_it_was_made_of(angle_deg: float, scale: float) -> None:
    height, width = SIZE
    centre = ((width - 1) / 2, (height - 1) / 2)
    matrix = cv2.getRotationMatrix2D(centre, -angle_deg, scale)  # OpenCV counts against our x-to-y direction
    matrix[:, 2] += (4.0, -2.5)
    parts = geometry.decompose_affine(torch.from_numpy(matrix)[None], SIZE)
    assert parts["rotation_deg"].item() == pytest.approx(angle_deg, abs=1e-9)
    assert parts["scale"].item() == pytest.approx(scale)
    assert parts["shear"].item() == pytest.approx(0, abs=1e-12)
    assert parts["translation_px"][0].tolist() == pytest.approx([4.0, -2.5])


def test_shear_is_the_off_diagonal_of_what_rotation_leaves() -> None:
    angle, shear = np.radians(12.0), 0.3
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = rotation @ np.array([[1.0, shear], [0, 1.0]])
    affine = torch.from_numpy(np.column_stack([linear, [0.0, 0]]))[None]
    assert geometry.decompose_affine(affine, SIZE)["shear"].item() == pytest.approx(shear)


def test_the_corner_error_of_a_translation_is_its_length() -> None:
    affine = geometry.identity_affine(1)
    moved = affine + torch.tensor([[0, 0, 3.0], [0, 0, -4.0]])
    assert geometry.corner_errors_px(affine, moved, SIZE).tolist() == [[5.0] * 4]


def test_mirrored_images_are_warped_by_the_mirrored_affine() -> None:
    images = smooth_images(len(AFFINES))
    mirrored_after, seen_after = (x.flip(-1) for x in geometry.warp_affine(images, AFFINES))
    flipped = geometry.flip_affine(AFFINES, SIZE[1])
    mirrored_before, seen_before = geometry.warp_affine(images.flip(-1), flipped)
    both = seen_after & seen_before
    assert both.sum() > 0.9 * seen_after.sum()
    torch.testing.assert_close(mirrored_before * both, mirrored_after * both, atol=1e-4, rtol=0)


def test_a_mirrored_camera_sees_a_mirrored_world() -> None:
    points = torch.tensor([[1.0, -0.5, 4.0], [-2.0, 0.3, 9.0]])
    u, v = geometry.project(points, K)[0].unbind(-1)
    mirrored_points = points * torch.tensor([-1.0, 1, 1])
    mirrored_uv, _ = geometry.project(mirrored_points, geometry.flip_intrinsics(K, SIZE[1]))
    torch.testing.assert_close(mirrored_uv, torch.stack([SIZE[1] - 1 - u, v], dim=-1))


def test_projection_agrees_with_opencv() -> None:
    points = torch.rand(19, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 1.0])
    uv, depth_m = geometry.project(points, K)
    theirs, _ = cv2.projectPoints(points.numpy(), np.zeros(3), np.zeros(3), K.numpy(), None)
    np.testing.assert_allclose(uv.numpy(), theirs[:, 0], rtol=1e-4)
    torch.testing.assert_close(depth_m, points[:, 2])


def test_unprojection_agrees_with_kornia_and_is_undone_by_projection() -> None:
    depth_m = 1 + 9 * torch.rand(2, *SIZE, generator=torch.Generator().manual_seed(0))
    points = geometry.unproject(depth_m, K.expand(2, 3, 3))
    theirs = kornia.geometry.depth.depth_to_3d(depth_m[:, None], K.expand(2, 3, 3))  # (B, 3, H, W)
    torch.testing.assert_close(points, theirs.permute(0, 2, 3, 1), atol=1e-4, rtol=1e-4)
    uv, back_m = geometry.project(points.flatten(1, 2), K)
    torch.testing.assert_close(uv, geometry.pixel_grid(*SIZE).reshape(1, -1, 2).expand(2, -1, -1).float())
    torch.testing.assert_close(back_m, depth_m.flatten(1))


def test_mixed_precision_does_not_round_pixel_positions() -> None:
    ramp = torch.arange(601.0).expand(1, 1, 3, 601) / 600  # bfloat16 would only know every fourth pixel there
    affine = torch.tensor([[[0.9, 0.0, 21.3], [0, 1, 0]]])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        warped, _ = geometry.warp_affine(ramp, geometry.compose_affines(affine, geometry.identity_affine(1)))
    expected = (0.9 * torch.arange(601.0) + 21.3) / 600
    torch.testing.assert_close(warped[0, 0, 1].float(), expected, atol=1e-4, rtol=0)
