"""The networks that users can choose, as small as they get."""

import functools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from depthreg.networks import HalfResolutionNetwork, JointNetwork, Network

RANGE_M = (0.5, 90.0)


def joint_network(**options: object) -> JointNetwork:
    """The paper's, with everything that it has."""
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


def half_resolution_network(**options: object) -> HalfResolutionNetwork:
    """The released one, with everything that it has and a head that has learned something."""
    torch.manual_seed(0)
    defaults: dict[str, object] = {
        "completion_widths": (16, 32),
        "dilations": (2, 1),
        "registration_widths": (16, 16, 16),
        "registration_hidden": 16,
        "matchers": ((8, 2, 5), (4, 1, 5)),
    }
    network = HalfResolutionNetwork(**{**defaults, **options}).eval()
    torch.nn.init.normal_(network.completion.head.weight, std=0.05)
    return network


def _make_input(batch: int = 2, size: tuple[int, int] = (65, 97)) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(batch, 3, *size, generator=generator)
    depth_m = 1 + 50 * torch.rand(batch, 1, *size, generator=generator)
    return rgb, depth_m * (torch.rand(depth_m.shape, generator=generator) < 0.2)


CORRECTING = functools.partial(joint_network, residual=True)


@pytest.fixture(
    params=[joint_network, CORRECTING, half_resolution_network], ids=["joint", "joint, correcting", "half_resolution"]
)
def make_any(request: pytest.FixtureRequest) -> Callable[..., Network]:
    """Makes a network of each kind."""
    make: Callable[..., Network] = request.param
    return make


@pytest.fixture
def make_joint() -> Callable[..., JointNetwork]:
    """Makes the paper's network; options replace its own."""
    return joint_network


@pytest.fixture
def make_half_resolution() -> Callable[..., HalfResolutionNetwork]:
    """Makes the released network; options replace its own."""
    return half_resolution_network


@pytest.fixture
def make_input() -> Callable[..., tuple[Tensor, Tensor]]:
    """Makes colour, and depth in metres at one pixel of five."""
    return _make_input


@pytest.fixture
def range_m() -> tuple[float, float]:
    """What the paper's network is allowed to predict."""
    return RANGE_M
