"""Completion at half resolution: a U-Net chooses among fillings, and learned affinities spread what it is sure of."""

import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from depthreg.networks.priors import FILLINGS, Priors

ANCHOR_STRIDES = (8, 4, 2)  # of the grids on which returns correct what lies around them, in pixels
ANCHOR_REACH = 0.3  # in log-depth: a return this far from the answer is taken for another surface's, by three quarters


def conv_norm_relu(in_channels: int, out_channels: int, stride: int = 1) -> nn.Sequential:
    """Convolution, group normalisation (independent of the batch) and ReLU, which is cheap on a CPU."""
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, bias=False),
        nn.GroupNorm(out_channels // 16, out_channels),
        nn.ReLU(),
    )


class Residual(nn.Module):
    """Two convolutions added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(conv_norm_relu(channels, channels), conv_norm_relu(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) -> the same."""
        return x + self.convolutions(x)


class UNet(nn.Module):
    """Residual U-Net whose finest level is its input's.

    Args:
        in_channels: Channels of the input.
        widths: Channels of each level, finest first.
    """

    def __init__(self, in_channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        inputs = [in_channels, *widths][:-1]
        self.encoder = nn.ModuleList(
            nn.Sequential(conv_norm_relu(i, o, stride=1 if level == 0 else 2), Residual(o))
            for level, (i, o) in enumerate(zip(inputs, widths, strict=True))
        )
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in itertools.pairwise(widths))
        self.decoder = nn.ModuleList(Residual(width) for width in widths[:-1])
        self.stride = 2 ** (len(widths) - 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, h, w), sides multiples of `stride` -> (B, widths[0], h, w)."""
        features = []
        for level in self.encoder:
            x = level(x)
            features.append(x)
        x = features.pop()
        for up, level in zip(reversed(self.up), reversed(self.decoder), strict=True):
            # A 1x1 convolution commutes with enlarging, and is cheaper before it.
            fine = features.pop()
            x = level(fine + F.interpolate(up(x), size=fine.shape[-2:], mode="bilinear", align_corners=False))
        return x


def neighbours(x: Tensor, dilation: int) -> Tensor:
    """Each cell's 3 x 3 neighbourhood: (B, 1, h, w) -> (B, 9, h, w); the border repeats."""
    height, width = x.shape[-2:]
    padded = F.pad(x, [dilation] * 4, mode="replicate")
    steps = (0, dilation, 2 * dilation)
    return torch.cat([padded[..., i : i + height, j : j + width] for i in steps for j in steps], dim=1)


def anchored(dense: Tensor, returns: Tensor, valid: Tensor, trust: Tensor) -> Tensor:
    """Shift dense log-depth to the returns around it, from coarse to fine: a mean of how far off it is at them.

    What a network says at half resolution is off by a little everywhere, and each return says by how much.

    Args:
        dense: Log-depth, (B, 1, H, W).
        returns: Measured log-depth.
        valid: 1 where there is a return.
        trust: In each return, in [0, 1].
    """
    size = dense.shape[-2:]
    for stride in ANCHOR_STRIDES:
        off = (returns - dense) * valid
        near = trust / (1 + (off / ANCHOR_REACH).square()).square()
        means = F.avg_pool2d(torch.cat([near * off, valid], dim=1), stride)
        shift, there = F.interpolate(means, size=size, mode="bilinear", align_corners=False).split(1, dim=1)
        dense = dense + shift / (there + 1e-3)
    return dense


class PropagationNet(nn.Module):
    """From aligned colour and a filled sparse depth map to dense log-depth at full resolution.

    All convolutions work on cells of 2 x 2 pixels and coarser, as full-resolution ones cost mostly memory traffic. A
    U-Net mixes the fillings of each cell; then every cell takes a convex mixture of its neighbours', several times, at
    shrinking distances, while cells with a trusted return keep it (convolutional spatial propagation, Cheng et al.,
    TPAMI 2019); convex upsampling (RAFT, Teed and Deng, ECCV 2020) gives pixels, which trusted returns around them
    correct.

    Args:
        widths: Channels of the U-Net at strides 2, 4, 8, ...
        dilations: Of the propagation's steps, in cells.
    """

    def __init__(self, widths: Sequence[int], dilations: Sequence[int]) -> None:
        super().__init__()
        self.dilations = tuple(dilations)
        self.unet = UNet(self.IN_CHANNELS, widths)
        # Of a cell: candidates, trust in its return, neighbours of each step; of each of its 4 pixels:
        # neighbours, trust in its return, expected error.
        self.parts = [len(FILLINGS), 1, *[9] * len(self.dilations), 36, 4, 4]
        self.head = nn.Conv2d(widths[0], sum(self.parts), 3, padding=1)
        self._start_plainly()
        self.stride = 2 * self.unet.stride

    def _start_plainly(self) -> None:
        """Before it has learned, the answer is the mean of the fillings but for the sky's; returns are kept."""
        centre = [2.0 if neighbour == 4 else 0.0 for neighbour in range(9)]
        fillings, trust = [0.0] * (len(FILLINGS) - 1) + [-4.0], [2.0]
        pixels = [weight for weight in centre for _ in range(4)]
        bias = [*fillings, *trust, *centre * len(self.dilations), *pixels, *trust * 4, *[-2.0] * 4]
        nn.init.zeros_(self.head.weight)
        assert self.head.bias is not None
        self.head.bias.data = torch.tensor(bias)

    IN_CHANNELS = (
        12 + 1 + len(FILLINGS) + 4 + 4 + 1
    )  # colour, trust in it, candidates, returns and where they are, distance

    def forward(self, rgb: Tensor, trust: Tensor, valid: Tensor, priors: Priors) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Complete.

        Args:
            rgb: Aligned colour in [0, 1], (B, 3, H, W), sides multiples of `stride`.
            trust: In the colour's alignment, in [0, 1], (B,); colour that isn't trusted isn't seen.
            valid: 1 where there is a return, (B, 1, H, W).
            priors: The sparse depth, filled.

        Returns:
            Log-depth relative to the image's mean, and its expected absolute error, (B, 1, H, W) each; and what that
            depth was before it spread and before it was enlarged, (B, 1, H / 2, W / 2) each.
        """
        seen = trust[:, None, None, None]
        features = [F.pixel_unshuffle(rgb * seen, 2), seen.expand_as(priors.valid), priors.candidates]
        features += [F.pixel_unshuffle(priors.returns, 2), F.pixel_unshuffle(valid, 2), priors.distance]
        read = self.head(self.unet(torch.cat(features, dim=1))).to(valid.dtype)
        mixture, trust_cell, *steps, pixels, trust_pixel, error = read.split(self.parts, dim=1)
        depth = mixed = (mixture.softmax(dim=1) * priors.candidates).sum(dim=1, keepdim=True)
        kept = priors.valid * trust_cell.sigmoid()
        for dilation, affinity in zip(self.dilations, steps, strict=True):
            depth = torch.lerp(depth, priors.sparse, kept)
            depth = (affinity.softmax(dim=1) * neighbours(depth, dilation)).sum(dim=1, keepdim=True)
        weights = pixels.unflatten(1, (9, 4)).softmax(dim=1)
        dense = F.pixel_shuffle((weights * neighbours(depth, 1)[:, :, None]).sum(dim=1), 2)
        trust_returns = F.pixel_shuffle(trust_pixel, 2).sigmoid()
        dense = anchored(dense, priors.returns, valid, trust_returns)
        dense = torch.lerp(dense, priors.returns, valid * trust_returns)
        return dense, F.softplus(F.pixel_shuffle(error, 2)), [mixed, depth]
