"""TinyU-Net, against the published network's numbers."""

import pytest
import torch
from torch import nn

from depthreg.networks import TinyUNet


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_published_network_has_its_published_number_of_parameters() -> None:
    network = TinyUNet(3, 2, (64, 128, 256, 512))
    assert count(network) == 481_170
    assert [count(block) for block in network.encoder] == [2_524, 10_120, 38_672, 151_072]
    assert [count(block) for block in network.decoder] == [200_224, 59_152, 15_240, 4_036]


@pytest.mark.parametrize("widths", [(16,), (16, 32), (32, 48, 64)])
def test_the_output_has_the_inputs_resolution(widths: tuple[int, ...]) -> None:
    network = TinyUNet(5, 3, widths).eval()
    assert network.stride == 2 ** len(widths)
    height, width = 3 * network.stride, 5 * network.stride
    assert network(torch.rand(2, 5, height, width)).shape == (2, 3, height, width)


def test_extra_features_join_the_last_block_alone() -> None:
    plain, skipping = TinyUNet(4, 1, (16, 32)), TinyUNet(4, 1, (16, 32), skip_channels=6)
    # They enter one 1x1 convolution without bias, of 16 / 8 outputs.
    assert count(skipping) - count(plain) == 6 * 2
    x, skip = torch.rand(1, 4, 16, 24), torch.rand(1, 6, 16, 24)
    skipping.eval()
    assert not torch.equal(skipping(x, skip), skipping(x, 1 - skip))
