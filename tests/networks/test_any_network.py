"""What every network keeps to: any size, finite answers, a registration that completion can't disturb."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from depthreg.networks import Network

Make = Callable[..., Network]
MakeInput = Callable[..., tuple[Tensor, Tensor]]


@pytest.mark.parametrize("size", [(64, 64), (65, 97), (71, 130)])
def test_any_size_comes_back_as_it_went_in(size: tuple[int, int], make_any: Make, make_input: MakeInput) -> None:
    output = make_any()(*make_input(size=size))
    assert output.depth_m.shape == (2, 1, *size)
    assert output.rgb_aligned.shape == (2, 3, *size)
    assert output.affine_rgb_from_depth.shape == (2, 2, 3)
    assert output.trust.shape == (2,)
    assert all(tensor.isfinite().all() for tensor in (*output[:3], output.trust))


@pytest.mark.parametrize(("rgb_size", "depth_size"), [((63, 80), (63, 80)), ((80, 63), (80, 63)), ((64, 80), (64, 81))])
def test_sizes_that_cannot_work_are_refused(
    rgb_size: tuple[int, int], depth_size: tuple[int, int], make_any: Make
) -> None:
    with pytest.raises(ValueError, match="at least 64 x 64"):
        make_any()(torch.rand(1, 3, *rgb_size), torch.rand(1, 1, *depth_size))


@pytest.mark.parametrize("fill_m", [0.0, 1e-3, 1e3, None])
def test_slopes_are_finite_whatever_comes_in(fill_m: float | None, make_any: Make, make_input: MakeInput) -> None:
    network = make_any().train()
    rgb, depth_m = make_input()
    depth_m = (depth_m if fill_m is None else torch.full_like(depth_m, fill_m)).requires_grad_()
    output = network(rgb.requires_grad_(), depth_m)
    (output.depth_m.log().mean() + output.rgb_aligned.mean() + output.affine_rgb_from_depth.mean()).backward()
    slopes = [rgb.grad, depth_m.grad, *(p.grad for p in network.parameters() if p.grad is not None)]
    assert all(slope.isfinite().all() for slope in slopes)


def test_every_parameter_learns_from_depth_colour_matches_and_trust(make_any: Make, make_input: MakeInput) -> None:
    network = make_any().train()
    output = network(*make_input())
    matching = sum(matches.scores.square().mean() for matches in output.matches)
    told = matching + output.trust.sum() + output.log_error.nan_to_num().sum()
    (output.depth_m.mean() + output.affine_rgb_from_depth.square().mean() + told).backward()
    assert [name for name, parameter in network.named_parameters() if parameter.grad is None] == []


def test_a_frames_answer_does_not_depend_on_its_batch(make_any: Make, make_input: MakeInput) -> None:
    network, (rgb, depth_m) = make_any(), make_input(batch=3)
    together = network(rgb, depth_m)
    for i in range(3):
        alone = network(rgb[i : i + 1], depth_m[i : i + 1])
        for ours, theirs in zip(together[:3], alone[:3], strict=True):
            torch.testing.assert_close(ours[i], theirs[0], atol=1e-4, rtol=1e-4)


def test_registration_does_not_hear_of_completion(make_any: Make, make_input: MakeInput) -> None:
    network, given = make_any(), make_input()
    before = network(*given)
    for parameter in network.completion.parameters():
        torch.nn.init.normal_(parameter)
    after = network(*given)
    assert torch.equal(before.affine_rgb_from_depth, after.affine_rgb_from_depth)
    assert torch.equal(before.trust, after.trust)
    assert not torch.equal(before.depth_m, after.depth_m)


def test_registration_can_be_left_out(make_any: Make, make_input: MakeInput) -> None:
    rgb, depth_m = make_input()
    network = make_any()
    aside = network(rgb, depth_m, register=False)
    assert torch.equal(aside.affine_rgb_from_depth, torch.eye(2, 3).expand(2, -1, -1))
    torch.testing.assert_close(aside.rgb_aligned, rgb)
    assert aside.matches == []
    assert not torch.equal(aside.depth_m, network(rgb, depth_m).depth_m)


def test_without_matchers_colour_stays_where_it_is(make_any: Make, make_input: MakeInput) -> None:
    rgb, depth_m = make_input()
    output = make_any(matchers=(), registration_widths=())(rgb, depth_m)
    assert torch.equal(output.affine_rgb_from_depth, torch.eye(2, 3).expand(2, -1, -1))
    torch.testing.assert_close(output.rgb_aligned, rgb)
    assert output.matches == []


def test_completion_may_be_left_without_colour(make_any: Make, make_input: MakeInput) -> None:
    rgb, depth_m = make_input()
    network = make_any(use_rgb=False, matchers=(), registration_widths=())
    assert torch.equal(network(rgb, depth_m).depth_m, network(1 - rgb, depth_m).depth_m)
    with pytest.raises(ValueError, match="nothing to register"):
        make_any(use_rgb=False)


def test_the_same_input_gives_the_same_answer(make_any: Make, make_input: MakeInput) -> None:
    given = make_input()
    first, second = make_any()(*given), make_any()(*given)
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(first[:3], second[:3], strict=True))


def test_inputs_are_left_as_they_were(make_any: Make, make_input: MakeInput) -> None:
    rgb, depth_m = make_input()
    rgb_before, depth_before_m = rgb.clone(), depth_m.clone()
    make_any()(rgb, depth_m)
    assert torch.equal(rgb, rgb_before) and torch.equal(depth_m, depth_before_m)


def test_double_precision_agrees_with_single(make_any: Make, make_input: MakeInput) -> None:
    network, (rgb, depth_m) = make_any(), make_input()
    single = network(rgb, depth_m)
    double = network.double()(rgb.double(), depth_m.double())
    assert double.depth_m.dtype == torch.float64
    torch.testing.assert_close(single.depth_m, double.depth_m.float(), atol=1e-2, rtol=1e-3)


def test_half_precision_works_and_keeps_the_affine_in_single(make_any: Make, make_input: MakeInput) -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = make_any()(*make_input())
    assert output.affine_rgb_from_depth.dtype == torch.float32
    assert all(tensor.isfinite().all() for tensor in output[:3])


def test_a_network_exports_to_a_graph_that_answers_alike(make_any: Make, make_input: MakeInput) -> None:
    network, given = make_any(), make_input(batch=1)
    exported = torch.export.export(network, given).module()
    for ours, theirs in zip(network(*given)[:3], exported(*given)[:3], strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


def test_the_configuration_rebuilds_the_network(make_any: Make) -> None:
    network = make_any()
    again = type(network)(**network.config)
    again.load_state_dict(network.state_dict())
    assert again.config == network.config
