"""The released network: no unit, no doubt that it hides, nothing that it makes up."""

from collections.abc import Callable

import hydra
import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from depthreg.config import compose_config
from depthreg.networks import HalfResolutionNetwork, LocalMatches
from depthreg.networks.half_resolution import match_quality
from depthreg.networks.priors import FAR_FACTOR, find_priors, window_max
from depthreg.networks.propagation import anchored, neighbours

Make = Callable[..., HalfResolutionNetwork]
MakeInput = Callable[..., tuple[Tensor, Tensor]]


def test_the_released_model_keeps_within_the_papers_size() -> None:
    network = hydra.utils.instantiate(compose_config("train", ["model=release"]).model)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count <= 5.2e6
    assert count == sum(p.numel() for p in HalfResolutionNetwork().parameters())  # what the class gives by default


@pytest.mark.parametrize("unit", [2.0, 1000.0, 1 / 0.3048])
def test_twice_the_depth_in_gives_twice_the_depth_out(
    unit: float, make_half_resolution: Make, make_input: MakeInput
) -> None:
    network, (rgb, depth_m) = make_half_resolution(), make_input()
    metres, other = network(rgb, depth_m), network(rgb, unit * depth_m)
    torch.testing.assert_close(other.depth_m, unit * metres.depth_m, rtol=1e-4, atol=0)
    torch.testing.assert_close(other.log_error, metres.log_error, rtol=1e-3, atol=0)
    assert metres.log_error.shape == metres.depth_m.shape and metres.log_error.min() > 0
    torch.testing.assert_close(other.affine_rgb_from_depth, metres.affine_rgb_from_depth, rtol=1e-3, atol=1e-3)


def test_predictions_stay_near_the_returns_whatever_the_head_says(
    make_half_resolution: Make, make_input: MakeInput
) -> None:
    network, (rgb, depth_m) = make_half_resolution(), make_input()
    torch.nn.init.normal_(network.completion.head.weight, std=100)
    predicted_m = network(rgb, depth_m).depth_m
    returns_m = depth_m[depth_m > 0]
    assert returns_m.min() / 4.001 <= predicted_m.min() and predicted_m.max() <= 4.001 * returns_m.max()


def test_a_flat_wall_is_completed_as_a_flat_wall(make_half_resolution: Make, make_input: MakeInput) -> None:
    network, (rgb, depth_m) = make_half_resolution(), make_input()
    torch.nn.init.zeros_(network.completion.head.weight)  # untrained, it mixes the fillings
    torch.nn.init.constant_(network.completion.head.bias, 0)
    with torch.no_grad():
        network.completion.head.bias[7] = -50  # none of the sky
    wall_m = torch.where(depth_m > 0, 7.0, 0.0)
    torch.testing.assert_close(network(rgb, wall_m).depth_m, torch.full_like(wall_m, 7.0))


def test_colour_that_is_not_trusted_changes_nothing(make_half_resolution: Make, make_input: MakeInput) -> None:
    network, (rgb, depth_m) = make_half_resolution(), make_input()
    torch.nn.init.constant_(network.registration.trust[-1].bias, -200.0)
    output, other = network(rgb, depth_m), network(1 - rgb, depth_m)
    assert output.trust.max() == 0
    assert torch.equal(output.depth_m, other.depth_m)


def test_a_network_without_matchers_registers_nothing_and_trusts_colour(
    make_half_resolution: Make, make_input: MakeInput
) -> None:
    rgb, depth_m = make_input()
    output = make_half_resolution(matchers=(), registration_widths=(8,))(rgb, depth_m)
    assert torch.equal(output.trust, torch.ones(2))


def test_fillings_are_the_nearest_return_and_the_nearest_surface() -> None:
    generator = torch.Generator().manual_seed(0)
    depth_m = 1 + 50 * torch.rand(1, 1, 64, 96, generator=generator)
    depth_m *= torch.rand(depth_m.shape, generator=generator) < 0.02
    priors = find_priors(depth_m, surface_window=7)
    metres = (priors.candidates + priors.centre).exp()[0].numpy()
    cells = depth_m[0, 0].unfold(0, 2, 2).unfold(1, 2, 2).flatten(2).numpy()
    cells = np.where(cells > 0, cells, np.inf).min(axis=-1)  # nearest of each cell's returns
    _, (row, column) = ndimage.distance_transform_edt(np.isinf(cells), return_indices=True)
    agrees = np.isclose(metres[0], cells[row, column], rtol=1e-4)
    assert agrees.mean() > 0.95  # of two returns as near as each other, either may be taken
    surface = ndimage.minimum_filter(cells, 7, mode="constant", cval=np.inf)
    seen = np.isfinite(surface)
    np.testing.assert_allclose(metres[1][seen], surface[seen], rtol=1e-4)
    np.testing.assert_allclose(metres[7], FAR_FACTOR * depth_m.max().item(), rtol=1e-4)


def test_a_column_is_filled_from_above_from_below_and_by_the_plane_between() -> None:
    depth_m = torch.zeros(1, 1, 64, 96)
    plane_m = 60 / (torch.arange(64.0)[:, None] - 10.5)  # inverse depth is linear in the row
    depth_m[..., [20, 21, 40, 41], 8] = plane_m[[20, 20, 40, 40]].T
    priors = find_priors(depth_m)
    above, below, plane = (priors.candidates + priors.centre).exp()[0, 4:7, :, 4]
    torch.testing.assert_close(above[10:], plane_m[[20] * 10 + [40] * 12, 0])
    torch.testing.assert_close(below[:21], plane_m[[20] * 11 + [40] * 10, 0])
    torch.testing.assert_close(plane[10:21], plane_m[20:41:2, 0])
    torch.testing.assert_close(plane[21:], plane_m[[40] * 11, 0])  # the one that there is
    assert (priors.candidates[0, 4, :10, 4] == priors.candidates[0, 0, :10, 4]).all()  # none above: the nearest


def test_a_windows_maximum_is_scipys() -> None:
    x = torch.rand(1, 1, 13, 17, generator=torch.Generator().manual_seed(0))
    expected = ndimage.maximum_filter(x[0, 0].numpy(), 5, mode="constant", cval=-np.inf)
    np.testing.assert_array_equal(window_max(x, 5)[0, 0].numpy(), expected)


def test_neighbours_are_those_at_the_dilations_distance() -> None:
    x = torch.arange(35.0).view(1, 1, 5, 7)
    around = neighbours(x, 2)[0, :, 2, 3]
    assert around.tolist() == [1, 3, 5, 15, 17, 19, 29, 31, 33]  # row 2, column 3 holds 17
    assert neighbours(x, 2)[0, 0, 0, 0] == 0  # the border repeats


def test_depth_that_is_off_by_little_is_shifted_to_the_returns_that_are_believed() -> None:
    """A return of what stands behind, or one that is not believed, shifts nothing."""
    generator = torch.Generator().manual_seed(0)
    truth = torch.linspace(-1, 1, 96).expand(1, 1, 64, 96)
    valid = (torch.rand(truth.shape, generator=generator) < 0.1).float()
    off = 0.01 * torch.linspace(1, 2, 64)[:, None]
    sure, unsure = torch.ones_like(truth), torch.zeros_like(truth)
    found = anchored(truth + off, truth * valid, valid, sure)
    assert (found - truth).abs().mean() < 0.1 * off.mean()
    torch.testing.assert_close(anchored(truth + off, truth * valid, valid, unsure), truth + off)
    torch.testing.assert_close(anchored(truth, truth * valid, valid, sure), truth)
    behind = anchored(truth, (truth + 3) * valid, valid, sure)
    assert (behind - truth).abs().max() < 0.2


def test_matches_that_an_affine_explains_are_told_from_noise() -> None:
    y, x = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    points_px = 8 * torch.stack([x, y], dim=-1).reshape(-1, 2)
    steps = torch.arange(-2.0, 3)
    offsets_px = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)
    shifted = torch.full((1, 48, 25), -20.0)
    shifted[..., 7] = 20.0  # all regions say the same
    noise = 40 * torch.rand(1, 48, 25, generator=torch.Generator().manual_seed(0))
    affine = torch.eye(2, 3)[None]
    sure, unsure = (match_quality(LocalMatches(points_px, offsets_px, scores, affine)) for scores in (shifted, noise))
    torch.testing.assert_close(sure, torch.tensor([[0.0, 1.0, 0.0]]), atol=1e-5, rtol=0)
    assert unsure[0, 2] > 0.2


def test_depth_on_the_way_is_told_to_training_alone(make_half_resolution: Make, make_input: MakeInput) -> None:
    network, (rgb, depth_m) = make_half_resolution().train(), make_input()
    output = network(rgb, depth_m)
    assert [earlier.shape for earlier in output.earlier_m] == [depth_m.shape] * 2
    sum(earlier.sum() for earlier in output.earlier_m).backward()
    assert network.completion.head.weight.grad.abs().sum() > 0
    assert network.eval()(rgb, depth_m).earlier_m == ()
