"""Misalignments: how far they reach, what they show, and what they must not give away."""

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg.geometry import identity_affine, warp_affine
from depthreg.sensors.misalignment import margin_for, misalign_rgb, random_affines

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
