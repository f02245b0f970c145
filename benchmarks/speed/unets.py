"""Plain U-Nets on ResNets, as segmentation-models-pytorch builds them, without what it needs beyond PyTorch."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

RESNET18 = (2, 2, 2, 2)  # blocks of each level
RESNET34 = (3, 4, 6, 3)
_WIDTHS = (64, 64, 128, 256, 512)  # channels at strides 2, 4, 8, 16, 32


def _conv_norm(in_channels: int, out_channels: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(in_channels, out_channels, kernel, stride, padding=kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(out_channels))


class BasicBlock(nn.Module):
    """Two convolutions added to their input (He et al., CVPR 2016)."""

    def __init__(self, in_channels: int, out_channels: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Sequential(_conv_norm(in_channels, out_channels, stride=stride), nn.ReLU())
        self.second = _conv_norm(out_channels, out_channels)
        same = in_channels == out_channels and stride == 1
        self.skip = nn.Identity() if same else _conv_norm(in_channels, out_channels, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, out_channels, H / stride, W / stride)."""
        return F.relu(self.skip(x) + self.second(self.first(x)))


class ResNetUNet(nn.Module):
    """U-Net whose encoder is a ResNet (18 or 34) and whose decoder doubles sides, with two convolutions a level.

    Args:
        in_channels: Channels of the input.
        blocks: Of each of the encoder's four levels: `RESNET18` or `RESNET34`.
        decoder: Channels of the decoder's five levels, coarsest first.
    """

    def __init__(
        self,
        in_channels: int,
        blocks: Sequence[int] = RESNET18,
        decoder: Sequence[int] = (256, 128, 64, 32, 16),
    ) -> None:
        super().__init__()
        self.stem = nn.Sequential(_conv_norm(in_channels, _WIDTHS[0], 7, 2), nn.ReLU())
        self.levels = nn.ModuleList()
        for level, (before, width, count) in enumerate(zip(_WIDTHS[:-1], _WIDTHS[1:], blocks, strict=True)):
            first = BasicBlock(before, width, 1 if level == 0 else 2)
            self.levels.append(nn.Sequential(first, *(BasicBlock(width, width, 1) for _ in range(count - 1))))
        skips = [*reversed(_WIDTHS[:-1]), 0]
        self.decoder = nn.ModuleList(
            nn.Sequential(_conv_norm(below + skip, width), nn.ReLU(), _conv_norm(width, width), nn.ReLU())
            for below, skip, width in zip((_WIDTHS[-1], *decoder), skips, decoder, strict=False)
        )
        self.head = nn.Conv2d(decoder[-1], 1, 3, padding=1)
        self.stride = 32

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W), sides multiples of 32 -> (B, 1, H, W)."""
        features = [self.stem(x)]
        x = F.max_pool2d(features[0], 3, 2, 1)
        for level in self.levels:
            x = level(x)
            features.append(x)
        features.pop()
        for block in self.decoder:
            x = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = block(torch.cat([x, features.pop()], dim=1) if features else x)
        return self.head(x)
