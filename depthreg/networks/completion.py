"""TinyU-Net and the completion network built on it."""

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn

from depthreg.networks.blocks import CMRF


class TinyUNet(nn.Module):
    """TinyU-Net of CMRF blocks (Chen et al., MICCAI 2024), with bilinear instead of bicubic upsampling.

    Args:
        in_channels: Channels of the input.
        out_channels: Channels of the output.
        widths: Channels at full, 1/2, 1/4, ... resolution; the published network has (64, 128, 256, 512).
        skip_channels: Channels of extra full-resolution features that join the last decoder block.
    """

    def __init__(self, in_channels: int, out_channels: int, widths: Sequence[int], skip_channels: int = 0) -> None:
        super().__init__()
        inputs = [in_channels, *widths[:-1]]
        self.encoder = nn.ModuleList(CMRF(i, o) for i, o in zip(inputs, widths, strict=True))
        below = [*widths[1:], widths[-1]]  # channels that come up to each level
        extra = [skip_channels, *[0] * (len(widths) - 1)]
        self.decoder = nn.ModuleList(
            CMRF(b + w + e, w) for b, w, e in reversed(list(zip(below, widths, extra, strict=True)))
        )
        self.head = nn.Conv2d(widths[0], out_channels, 1)
        self.stride = 2 ** len(widths)

    def forward(self, x: Tensor, skip: Tensor | None = None) -> Tensor:
        """(B, in_channels, H, W), (B, skip_channels, H, W) -> (B, out_channels, H, W); H, W multiples of `stride`."""
        features = []
        for block in self.encoder:
            x = block(x)
            features.append(x)
            x = F.max_pool2d(x, 2)
        for block in self.decoder:
            parts = [x, features.pop()]
            if not features and skip is not None:
                parts.append(skip)
            x = block(*parts)
        return self.head(x)
