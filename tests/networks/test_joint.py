"""The paper's joint network: its size, its range, and what it can be without."""

from collections.abc import Callable

import hydra
import pytest
import torch
from torch import Tensor

from depthreg.config import compose_config
from depthreg.networks import JointNetwork

Make = Callable[..., JointNetwork]
MakeInput = Callable[..., tuple[Tensor, Tensor]]


def test_the_papers_model_has_the_papers_size() -> None:
    network = hydra.utils.instantiate(compose_config("train", ["model=paper"]).model)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == pytest.approx(5.2e6, rel=0.05)
    assert count == sum(p.numel() for p in JointNetwork().parameters())  # what the class gives by default


@pytest.mark.parametrize("fill_m", [0.0, 1e-3, 1e3])
@pytest.mark.parametrize("residual", [False, True])
def test_predictions_stay_within_the_range_whatever_comes_in(
    fill_m: float, residual: bool, make_joint: Make, make_input: MakeInput, range_m: tuple[float, float]
) -> None:
    network = make_joint(residual=residual)
    torch.nn.init.normal_(network.completion.head.weight, std=50)  # saturates the output
    depth_m = network(make_input()[0], torch.full((2, 1, 65, 97), fill_m)).depth_m
    assert depth_m.isfinite().all()
    assert depth_m.min() >= range_m[0] * (1 - 1e-5) and depth_m.max() <= range_m[1] * (1 + 1e-5)


def test_without_matchers_every_other_parameter_learns(make_joint: Make, make_input: MakeInput) -> None:
    network = make_joint(matchers=(), registration_widths=()).train()
    assert not list(network.registration.parameters())
    network(*make_input()).depth_m.mean().backward()
    assert all(parameter.grad is not None for parameter in network.parameters())
