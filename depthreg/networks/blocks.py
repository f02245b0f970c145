"""Layers that the networks share: the CMRF block, plain convolution blocks, and a parameter-free hole filler."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

MAX_EXPORTED_SIDE_PX = 4096  # of a network that is exported for any size
MOMENTUM = 0.5  # of a thin plate that settles


def doublings(*sides: int) -> int:
    """How often 1 has to double to reach the longest side.

    In an export for any size, it is what the longest possible one takes: more passes than needed change nothing here.
    """
    if torch.jit.is_tracing():
        return (MAX_EXPORTED_SIDE_PX - 1).bit_length()
    return (max(sides) - 1).bit_length()


def padding_to(stride: int, height: int, width: int) -> list[int]:
    """Padding to the right and below, as `F.pad` takes it, that makes both sides multiples of `stride`."""
    # Written so that an export for any size sees the multiple: it can halve that, but not a remainder.
    wide, high = ((side + stride - 1) // stride * stride for side in (width, height))
    return [0, wide - width, 0, high - height]


def conv_norm_gelu(in_channels: int, out_channels: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, group normalisation (independent of the batch, so DDP ranks agree) and GELU."""
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, kernel, stride, padding=kernel // 2, bias=False),
        nn.GroupNorm(out_channels // 8, out_channels),
        nn.GELU(),
    )


def _batch_norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.03)


class CMRF(nn.Module):
    """Cascade multi-receptive-field block of TinyU-Net (Chen et al., MICCAI 2024).

    A 1x1 convolution shrinks the input to `out_channels / 8`; the odd half of it runs through seven depthwise 3x3
    convolutions in a row, and everything seen on the way is kept and mixed by a second 1x1 convolution.

    Its input may come in parts, as a decoder's does: the 1x1 convolution of a concatenation is the sum of 1x1
    convolutions, and it commutes with bilinear upsampling, so each part is shrunk first, at its own resolution, and
    only then enlarged and added. That is the same function with a fraction of the memory traffic.

    Args:
        in_channels: Channels of the input, all parts together.
        out_channels: Channels of the output (B, out_channels, H, W), a multiple of 16.
    """

    STAGES = 8  # N in the paper

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        if out_channels % (2 * self.STAGES):
            raise ValueError(f"out_channels must be a multiple of {2 * self.STAGES}, got {out_channels}")
        narrow = out_channels // self.STAGES
        self.reduce = nn.Conv2d(in_channels, narrow, 1, bias=False)
        self.normalize = nn.Sequential(_batch_norm(narrow), nn.GELU())
        self.cascade = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(narrow // 2, narrow // 2, 3, padding=1, groups=narrow // 2, bias=False),
                _batch_norm(narrow // 2),
            )
            for _ in range(self.STAGES - 1)
        )
        self.expand = nn.Sequential(
            nn.Conv2d(out_channels // 2, out_channels, 1, bias=False), _batch_norm(out_channels), nn.GELU()
        )
        self.residual = in_channels == out_channels

    def forward(self, *parts: Tensor) -> Tensor:
        """Parts (B, C_i, H_i, W_i), channels summing to in_channels -> (B, out_channels, H, W), sized as the last."""
        weights = self.reduce.weight.split([part.shape[1] for part in parts], dim=1)
        # Contiguous slices, or PyTorch falls back to its slow convolution.
        reduced = [F.conv2d(part, weight.contiguous()) for part, weight in zip(parts, weights, strict=True)]
        narrow = self.normalize(sum(r if r.shape == reduced[-1].shape else upsample_to(r, parts[-1]) for r in reduced))
        even, odd = narrow[:, ::2], narrow[:, 1::2]
        seen = [even + odd]
        for convolution in self.cascade:
            odd = convolution(odd)
            seen.append(odd)
        out = self.expand(torch.cat(seen, dim=1))
        return out + parts[0] if self.residual else out


def upsample_to(x: Tensor, like: Tensor) -> Tensor:
    """Bilinear resize to the height and width of `like`; bilinear because it exports everywhere."""
    return F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)


def nearest_valid(values: Tensor, valid: Tensor, reach_px: int | None = None) -> tuple[Tensor, Tensor]:
    """The value of the nearest valid pixel, by jump flooding (Rong and Tan, I3D 2006): log2(size) passes of shifts.

    Args:
        values: (B, 1, H, W).
        valid: bool, (B, 1, H, W).
        reach_px: Farther neighbours may stay unfound, which saves passes; a power of 2, the image's size by default.

    Returns:
        The values (B, 1, H, W), 0 everywhere for an image without a valid pixel, and the squared distances to them in
        pixels (B, 1, H, W). A few pixels get their second nearest.
    """
    height, width = values.shape[-2:]
    row = torch.arange(height, device=values.device)[:, None]
    column = torch.arange(width, device=values.device)[None]
    seed = torch.where(valid, row * width + column, -1)  # index of the nearest valid pixel found so far
    far = height**2 + width**2
    distance = torch.where(valid, 0, far)
    step = (reach_px or 1 << doublings(height, width)) // 2
    while step:
        padded = F.pad(seed, [step] * 4, value=-1)
        for dy in (0, step, 2 * step):
            for dx in (0, step, 2 * step):
                candidate = padded[..., dy : dy + height, dx : dx + width]
                above = candidate // width
                reach = (above - row).square() + (candidate - above * width - column).square()
                closer = (candidate >= 0) & (reach < distance)
                seed, distance = torch.where(closer, candidate, seed), torch.where(closer, reach, distance)
        step //= 2
    return (values * valid).flatten(2).gather(2, seed.clamp(min=0).flatten(2)).view_as(values), distance


def fill_nearest(values: Tensor, valid: Tensor, reach_px: int = 16) -> Tensor:
    """Fill holes with the nearest valid values: crisp, found at half resolution, which is 7 times as fast.

    Farther than `reach_px` from any valid pixel the filling is smooth: the region of one nearest value becomes a wedge
    there, with edges that no scene has.

    Args:
        values: (B, 1, H, W); ignored where not valid.
        valid: bool, (B, 1, H, W).
        reach_px: How far a value is believed to hold.

    Returns:
        (B, 1, H, W): `values` where valid, filled elsewhere; 0 everywhere for an image without a valid pixel.
    """
    weight = valid.to(values.dtype)
    pooled, pooled_weight = _pool_valid(values * weight, weight)
    nearest, distance = nearest_valid(pooled, pooled_weight > 0)
    filled = upsample_to(fill_smoothly(nearest, distance <= (reach_px / 2) ** 2), values)
    return torch.where(valid, values, filled)


def fill_smoothly(values: Tensor, valid: Tensor, plate_steps: int = 0) -> Tensor:
    """Fill holes from ever coarser averages of the valid values (pull-push; Gortler et al., SIGGRAPH 1996).

    Smooth, so it invents no edges half way between two returns, as the nearest values would. See `fill_nearest`.

    Args:
        values: (B, 1, H, W); ignored where not valid.
        valid: bool, (B, 1, H, W).
        plate_steps: How often each level bends like a thin plate held by its valid values (Terzopoulos, PAMI 1986):
            averages alone leave steps, where a plane is wanted. None by default.
    """
    weight = valid.to(values.dtype)
    levels = [(values * weight, weight)]  # values and whether there are any, finest first
    for _ in range(doublings(*values.shape[-2:])):
        levels.append(_pool_valid(*levels[-1]))
    filled = levels.pop()[0]
    for value, weight in reversed(levels):
        filled = value + (1 - weight) * upsample_to(filled, value)
        if plate_steps:
            filled = _bend(filled, 1 - weight, plate_steps)
    return filled


def _bend(values: Tensor, free: Tensor, steps: int) -> Tensor:
    """Descend to the least bending energy where `free` is 1, with momentum (Polyak, 1964); 0 holds a value fast.

    The energy is the square of the Laplacian, here the mean of 3 x 3 pixels less the middle: its eigenvalues lie in
    [-4/3, 0], so steps of 1 are stable. All in pooling, which autocast leaves in single precision.
    """
    values = before = values + free * _laplacian(values)
    for _ in range(steps):
        bending = _laplacian(_laplacian(values))
        values, before = values - free * bending + MOMENTUM * (values - before), values
    return values


def _laplacian(x: Tensor) -> Tensor:
    return F.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False) - x


def _pool_valid(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Means of the valid values of 2 x 2 blocks, and 1 where there were any; `values` are 0 where `weight` is."""
    # avg_pool2d divides both sums by the same count, so the ratio is the mean over the valid pixels.
    pooled_weight = F.avg_pool2d(weight, 2, ceil_mode=True)
    pooled = F.avg_pool2d(values, 2, ceil_mode=True) / pooled_weight.clamp(min=0.25)
    return pooled, (pooled_weight > 0).to(values.dtype)
