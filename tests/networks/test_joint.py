"""The joint network as a user meets it: any size, any depth, finite answers within its range."""

import hydra
import pytest
import torch
from torch import Tensor

from depthreg.config import compose_config
from depthreg.networks import JointNetwork

RANGE_M = (0.5, 90.0)


def make_network(**options: object) -> JointNetwork:
    torch.manual_seed(0)
    defaults: dict[str, object] = {
        "first_channels": 8,
        "completion_widths": (16, 32),
        "registration_widths": (16, 16),
        "registration_hidden": 16,
        "matchers": ((4, 2, 5),),
        "depth_range_m": RANGE_M,
    }
    return JointNetwork(**{**defaults, **options}).eval()


def make_input(batch: int = 2, size: tuple[int, int] = (65, 97)) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(batch, 3, *size, generator=generator)
    depth_m = 1 + 50 * torch.rand(batch, 1, *size, generator=generator)
    return rgb, depth_m * (torch.rand(depth_m.shape, generator=generator) < 0.2)


def test_the_papers_model_has_the_papers_size() -> None:
    network = hydra.utils.instantiate(compose_config("train", ["model=paper"]).model)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == pytest.approx(5.2e6, rel=0.05)
    assert count == sum(p.numel() for p in JointNetwork().parameters())  # what the class gives by default


@pytest.mark.parametrize("size", [(64, 64), (65, 97), (71, 130)])
@pytest.mark.parametrize("residual", [False, True])
def test_any_size_comes_back_as_it_went_in(size: tuple[int, int], residual: bool) -> None:
    rgb, depth_m = make_input(size=size)
    output = make_network(residual=residual)(rgb, depth_m)
    assert output.depth_m.shape == (2, 1, *size)
    assert output.rgb_aligned.shape == (2, 3, *size)
    assert output.affine_rgb_from_depth.shape == (2, 2, 3)
    assert all(tensor.isfinite().all() for tensor in output[:3])


@pytest.mark.parametrize(("rgb_size", "depth_size"), [((63, 80), (63, 80)), ((80, 63), (80, 63)), ((64, 80), (64, 81))])
def test_sizes_that_cannot_work_are_refused(rgb_size: tuple[int, int], depth_size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="at least 64 x 64"):
        make_network()(torch.rand(1, 3, *rgb_size), torch.rand(1, 1, *depth_size))


@pytest.mark.parametrize("fill_m", [0.0, 1e-3, 1e3])
@pytest.mark.parametrize("residual", [False, True])
def test_predictions_stay_within_the_range_whatever_comes_in(fill_m: float, residual: bool) -> None:
    network = make_network(residual=residual)
    torch.nn.init.normal_(network.completion.head.weight, std=50)  # saturates the output
    depth_m = network(make_input()[0], torch.full((2, 1, 65, 97), fill_m)).depth_m
    assert depth_m.isfinite().all()
    assert depth_m.min() >= RANGE_M[0] * (1 - 1e-5) and depth_m.max() <= RANGE_M[1] * (1 + 1e-5)


@pytest.mark.parametrize("fill_m", [0.0, 1e-3, 1e3, None])
def test_slopes_are_finite_whatever_comes_in(fill_m: float | None) -> None:
    network = make_network(residual=True).train()
    rgb, depth_m = make_input()
    depth_m = (depth_m if fill_m is None else torch.full_like(depth_m, fill_m)).requires_grad_()
    output = network(rgb.requires_grad_(), depth_m)
    (output.depth_m.mean() + output.rgb_aligned.mean() + output.affine_rgb_from_depth.mean()).backward()
    slopes = [rgb.grad, depth_m.grad, *(p.grad for p in network.parameters() if p.grad is not None)]
    assert all(slope.isfinite().all() for slope in slopes)


def test_every_parameter_learns_from_depth_colour_and_matches() -> None:
    network = make_network().train()
    output = network(*make_input())
    matching = sum(matches.scores.square().mean() for matches in output.matches)
    (output.depth_m.mean() + output.affine_rgb_from_depth.square().mean() + matching).backward()
    assert [name for name, parameter in network.named_parameters() if parameter.grad is None] == []


def test_a_frames_answer_does_not_depend_on_its_batch() -> None:
    network, (rgb, depth_m) = make_network(), make_input(batch=3)
    together = network(rgb, depth_m)
    for i in range(3):
        alone = network(rgb[i : i + 1], depth_m[i : i + 1])
        for ours, theirs in zip(together[:3], alone[:3], strict=True):
            torch.testing.assert_close(ours[i], theirs[0], atol=1e-4, rtol=1e-4)


def test_registration_does_not_hear_of_completion() -> None:
    network, given = make_network(), make_input()
    before = network(*given)
    for parameter in network.completion.parameters():
        torch.nn.init.normal_(parameter)
    after = network(*given)
    assert torch.equal(before.affine_rgb_from_depth, after.affine_rgb_from_depth)
    assert not torch.equal(before.depth_m, after.depth_m)


def test_without_matchers_colour_stays_where_it_is() -> None:
    rgb, depth_m = make_input()
    network = make_network(matchers=(), registration_widths=()).train()
    output = network(rgb, depth_m)
    assert torch.equal(output.affine_rgb_from_depth, torch.eye(2, 3).expand(2, -1, -1))
    torch.testing.assert_close(output.rgb_aligned, rgb)
    assert output.matches == [] and not list(network.registration.parameters())
    output.depth_m.mean().backward()
    assert all(parameter.grad is not None for parameter in network.parameters())


def test_completion_may_be_left_without_colour() -> None:
    rgb, depth_m = make_input()
    network = make_network(use_rgb=False, matchers=(), registration_widths=())
    assert torch.equal(network(rgb, depth_m).depth_m, network(1 - rgb, depth_m).depth_m)
    with pytest.raises(ValueError, match="nothing to register"):
        make_network(use_rgb=False)


def test_the_same_input_gives_the_same_answer() -> None:
    given = make_input()
    first, second = make_network()(*given), make_network()(*given)
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(first[:3], second[:3], strict=True))


def test_inputs_are_left_as_they_were() -> None:
    rgb, depth_m = make_input()
    rgb_before, depth_before_m = rgb.clone(), depth_m.clone()
    make_network()(rgb, depth_m)
    assert torch.equal(rgb, rgb_before) and torch.equal(depth_m, depth_before_m)


def test_double_precision_agrees_with_single() -> None:
    network, (rgb, depth_m) = make_network(), make_input()
    single = network(rgb, depth_m)
    double = network.double()(rgb.double(), depth_m.double())
    assert double.depth_m.dtype == torch.float64
    torch.testing.assert_close(single.depth_m, double.depth_m.float(), atol=1e-2, rtol=1e-3)


def test_half_precision_works_and_keeps_the_affine_in_single() -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = make_network()(*make_input())
    assert output.affine_rgb_from_depth.dtype == torch.float32
    assert all(tensor.isfinite().all() for tensor in output[:3])


def test_the_network_exports_to_a_graph_that_answers_alike() -> None:
    network, given = make_network(), make_input(batch=1)
    exported = torch.export.export(network, given).module()
    for ours, theirs in zip(network(*given)[:3], exported(*given)[:3], strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


def test_the_configuration_rebuilds_the_network() -> None:
    network = make_network(residual=True)
    again = JointNetwork(**network.config)
    again.load_state_dict(network.state_dict())
    assert again.config == network.config


def test_without_registration_the_colour_is_used_as_it_comes(make_network):
    network = make_network().eval()
    torch.manual_seed(0)
    rgb, depth_m = torch.rand(1, 3, 64, 70), 5 * (torch.rand(1, 1, 64, 70) < 0.2).float()
    with torch.no_grad():
        output = network(rgb, depth_m, register=False)
    torch.testing.assert_close(output.affine_rgb_from_depth, torch.eye(2, 3)[None])
    torch.testing.assert_close(output.rgb_aligned, rgb, atol=1e-5, rtol=0)
