"""The parts of registration, against brute force, least squares and constructed displacements."""

import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg.networks.registration import Matcher, edge_strength, fit_affine, local_correlation

AFFINE = torch.tensor([[1.02, -0.03, 4.0], [0.05, 0.97, -6.0]], dtype=torch.float64)


def seeded(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


def grid_points() -> Tensor:
    y, x = np.mgrid[:90:17, :150:23]
    return torch.from_numpy(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))


def displacements_of(affine: Tensor, points: Tensor) -> Tensor:
    homogeneous = np.column_stack([points.numpy(), np.ones(len(points))])
    return torch.from_numpy(homogeneous @ affine.numpy().T) - points


def test_the_correlation_compares_each_cell_with_its_surroundings() -> None:
    fixed, moving, radius = seeded(2, 3, 4, 5) - 0.5, seeded(2, 3, 4, 5).flip(-1) - 0.4, 2
    ours = local_correlation(fixed, moving, radius).numpy()
    f, m = fixed.numpy(), moving.numpy()
    expected = np.zeros((2, 25, 4, 5), np.float32)
    for b, y, x in np.ndindex(2, 4, 5):
        for dy, dx in np.ndindex(5, 5):
            v, u = y + dy - radius, x + dx - radius
            if 0 <= v < 4 and 0 <= u < 5:
                here, there = f[b, :, y, x], m[b, :, v, u]
                expected[b, 5 * dy + dx, y, x] = here @ there / np.linalg.norm(here) / np.linalg.norm(there)
    np.testing.assert_allclose(ours, expected, atol=1e-6)


def test_an_exact_affine_is_recovered_from_its_displacements() -> None:
    points = grid_points()
    weights = torch.rand(1, len(points), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    displacements = displacements_of(AFFINE, points)[None]
    fitted = fit_affine(points, displacements, weights / weights.sum(), stiffness=1e-12)
    torch.testing.assert_close(fitted[0], AFFINE, atol=1e-8, rtol=0)


def test_noisy_displacements_are_fitted_as_numpys_least_squares_fits_them() -> None:
    points = grid_points()
    rng = np.random.default_rng(2)
    displacements = displacements_of(AFFINE, points).numpy() + rng.normal(0, 2, (len(points), 2))
    weights = rng.random(len(points))
    root = np.sqrt(weights)[:, None]
    homogeneous = np.column_stack([points.numpy(), np.ones(len(points))])
    theirs = np.linalg.lstsq(root * homogeneous, root * (points.numpy() + displacements), rcond=None)[0].T
    ours = fit_affine(
        points,
        torch.from_numpy(displacements)[None],
        torch.from_numpy(weights / weights.sum())[None],
        stiffness=1e-12,
    )
    np.testing.assert_allclose(ours[0].numpy(), theirs, atol=1e-7)


def test_a_pure_translation_survives_any_stiffness() -> None:
    points = grid_points()
    shift = torch.tensor([5.0, -3.0], dtype=torch.float64).expand(1, len(points), 2)
    weights = torch.full((1, len(points)), 1 / len(points), dtype=torch.float64)
    fitted = fit_affine(points, shift, weights, stiffness=1.0)
    torch.testing.assert_close(fitted[0, :, :2], torch.eye(2, dtype=torch.float64))
    assert fitted[0, :, 2].tolist() == pytest.approx([5.0, -3.0])


@pytest.mark.parametrize("trusted", ["line", "one point"])
def test_points_that_leave_the_affine_open_still_give_a_finite_one(trusted: str) -> None:
    points = grid_points()
    chosen = points[:, 1] == 0 if trusted == "line" else torch.arange(len(points)) == 3
    weights = (chosen / chosen.sum())[None].double()
    displacements = displacements_of(AFFINE, points)[None].requires_grad_()
    fitted = fit_affine(points, displacements, weights)
    fitted.sum().backward()
    assert fitted.isfinite().all() and displacements.grad.isfinite().all()
    assert (fitted[0, :, :2] - torch.eye(2)).abs().max() < 0.2


def test_edge_strength_hardly_depends_on_the_images_gain() -> None:
    image = seeded(1, 3, 40, 50)
    torch.testing.assert_close(edge_strength(0.3 * image), edge_strength(image), atol=5e-3, rtol=0)


def test_edges_are_where_the_image_steps_and_nowhere_else() -> None:
    image = torch.zeros(1, 3, 20, 30)
    image[:, 1, :, 12:] = 0.5  # one channel steps from column 11 to column 12
    right, down = edge_strength(image)[0]
    assert (right[:, 11] > 0.5).all() and down.abs().max() == 0
    assert right[:, :11].abs().max() == 0 and right[:, 12:].abs().max() == 0


def test_a_matcher_answers_for_its_own_step_alone() -> None:
    matcher = Matcher(channels=8, hidden=16, stride=4, radius=2, window=3)
    before = torch.eye(2, 3)[None].requires_grad_()
    features = seeded(1, 8, 16, 20)
    affine, seen = matcher(features, features.flip(-1), before)
    affine.sum().backward()
    assert before.grad is None
    torch.testing.assert_close(seen.affine_before, before.detach())


def test_a_matcher_finds_a_shift_of_whole_cells() -> None:
    matcher = Matcher(channels=8, hidden=16, stride=4, radius=2, window=5).eval()
    torch.nn.init.zeros_(matcher.read[-1].weight)  # the correlation alone decides
    torch.nn.init.zeros_(matcher.read[-1].bias)
    rgb = torch.randn(1, 8, 24, 32, generator=torch.Generator().manual_seed(0))
    depth = rgb.roll((-1, 2), dims=(2, 3))  # depth[y, x] shows what rgb has at (x - 2, y + 1)
    _, seen = matcher(rgb, depth, torch.eye(2, 3)[None])
    inner = (seen.points_px > 20).all(-1) & (seen.points_px < torch.tensor([100.0, 70.0])).all(-1)
    best = seen.offsets_px[seen.scores[0, inner].argmax(dim=-1)]
    assert inner.any()
    assert best.unique(dim=0).tolist() == [[-8.0, 4.0]]
