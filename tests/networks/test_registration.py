"""The parts of registration, against brute force, least squares and constructed displacements."""

import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg.networks.registration import Matcher, edge_strength, fit_affine, local_correlation, weigh

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
    weights = torch.rand(1, len(points), 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    displacements = displacements_of(AFFINE, points)[None]
    fitted = fit_affine(points, displacements, weights / weights.sum(dim=1), stiffness=1e-12)
    torch.testing.assert_close(fitted[0], AFFINE, atol=1e-8, rtol=0)


def test_noisy_displacements_are_fitted_as_numpys_least_squares_fits_them() -> None:
    points = grid_points()
    rng = np.random.default_rng(2)
    displacements = displacements_of(AFFINE, points).numpy() + rng.normal(0, 2, (len(points), 2))
    weights = rng.random((len(points), 2))
    homogeneous = np.column_stack([points.numpy(), np.ones(len(points))])
    moved = points.numpy() + displacements
    roots = np.sqrt(weights).T[..., None]
    theirs = [
        np.linalg.lstsq(root * homogeneous, root[:, 0] * to, rcond=None)[0]
        for root, to in zip(roots, moved.T, strict=True)
    ]
    ours = fit_affine(
        points,
        torch.from_numpy(displacements)[None],
        torch.from_numpy(weights / weights.sum(axis=0))[None],
        stiffness=1e-12,
    )
    np.testing.assert_allclose(ours[0].numpy(), theirs, atol=1e-7)


def test_a_pure_translation_survives_any_stiffness() -> None:
    points = grid_points()
    shift = torch.tensor([5.0, -3.0], dtype=torch.float64).expand(1, len(points), 2)
    weights = torch.full((1, len(points), 2), 1 / len(points), dtype=torch.float64)
    fitted = fit_affine(points, shift, weights, stiffness=1.0)
    torch.testing.assert_close(fitted[0, :, :2], torch.eye(2, dtype=torch.float64))
    assert fitted[0, :, 2].tolist() == pytest.approx([5.0, -3.0])


@pytest.mark.parametrize("trusted", ["line", "one point"])
def test_points_that_leave_the_affine_open_still_give_a_finite_one(trusted: str) -> None:
    points = grid_points()
    chosen = points[:, 1] == 0 if trusted == "line" else torch.arange(len(points)) == 3
    weights = (chosen / chosen.sum())[None, :, None].double().expand(-1, -1, 2)
    displacements = displacements_of(AFFINE, points)[None].requires_grad_()
    fitted = fit_affine(points, displacements, weights)
    fitted.sum().backward()
    assert fitted.isfinite().all() and displacements.grad.isfinite().all()
    assert (fitted[0, :, :2] - torch.eye(2)).abs().max() < 0.2


def test_regions_that_see_upright_edges_alone_say_nothing_about_y() -> None:
    """The aperture problem: all points tell x, a few corners tell y; what the others make of y must not count."""
    y, x = torch.meshgrid(torch.arange(-4.0, 5.0) * 8, torch.arange(-4.0, 5.0) * 8, indexing="ij")
    offsets_px = torch.stack([x, y], dim=-1).reshape(-1, 2)
    points = grid_points().float()
    truth = displacements_of(AFFINE, points.double()).float()
    distance = offsets_px - truth[:, None]
    corners = torch.arange(len(points)) % 4 == 0
    scores = (
        -(distance[..., 0] / 4).square() / 2
        - torch.where(corners, 1.0, 0.0)[:, None] * (distance[..., 1] / 4).square() / 2
    )
    mean, weights = weigh(scores[None], offsets_px, torch.zeros(1, len(points)), stride=8)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(1, 2))
    fitted = fit_affine(points, mean, weights, stiffness=1e-6)[0]
    corner_px = torch.tensor([[0.0, 0, 1], [150, 0, 1], [0, 90, 1], [150, 90, 1]])
    off_px = (corner_px @ fitted.T - corner_px @ AFFINE.float().T).norm(dim=-1)
    even = fit_affine(points, mean, torch.full_like(mean, 1 / len(points)), stiffness=1e-6)[0]
    off_even_px = (corner_px @ even.T - corner_px @ AFFINE.float().T).norm(dim=-1)
    assert off_px.max() < 1 and off_even_px.max() > 4


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
