"""A network as one function of a frame: colour and returns in, metres out, in the types that programs have."""

import copy
from contextlib import nullcontext

import torch
from torch import Tensor, nn

from depthreg.result import chance_near

INPUTS = {
    "rgb": "colour, red first, (height, width, 3) uint8",
    "sparse_depth_m": "sparse z-depth in metres, (height, width) float32; all but positive numbers is none",
}
OUTPUTS = {
    "depth_m": "dense z-depth in metres, (height, width) float32",
    "rgb_aligned": "colour on the depth's grid, (height, width, 3) uint8; 0 where the colour image doesn't reach",
    "affine_rgb_from_depth": "A in pixels, (2, 3) float32: rgb_aligned[y, x] = rgb[A @ (x, y, 1)], centres at integers",
    "confidence": "how likely a depth is within 5 % of the truth, (height, width) float32; NaN: can't tell",
    "trust": "how likely the affine is right, () float32 in [0, 1]",
}


class FrameNetwork(nn.Module):
    """A network for one frame at a time, in the types that cameras give and programs take.

    Args:
        network: Any of `depthreg.networks`; it gets into evaluation mode.
        half: Convolve in half precision; positions and depths stay whole.
    """

    def __init__(self, network: nn.Module, half: bool = False) -> None:
        super().__init__()
        self.network, self.half_precision = network, half
        self.eval()

    def forward(self, rgb: Tensor, depth_m: Tensor) -> tuple[Tensor, ...]:
        """`INPUTS` -> `OUTPUTS`, in their order."""
        colour = rgb.permute(2, 0, 1)[None].float() / 255
        known = (depth_m > 0) & (depth_m < torch.inf)  # NaN is neither
        depth = torch.where(known, depth_m, 0)[None, None]
        half = torch.autocast(rgb.device.type, torch.float16, cache_enabled=False)
        with half if self.half_precision else nullcontext():
            output = self.network(colour, depth)
        aligned = (255 * output.rgb_aligned[0].float().clamp(0, 1)).round().to(torch.uint8)
        return (
            output.depth_m[0, 0].float(),
            aligned.permute(1, 2, 0).contiguous(),
            output.affine_rgb_from_depth[0].float(),
            chance_near(output.log_error[0, 0].float()),
            output.trust[0].float(),
        )


class RowwiseGroupNorm(nn.Module):
    """`nn.GroupNorm` that adds up rows, then columns, then channels.

    ONNX Runtime's own normalisation adds millions of numbers one after the other in single precision, which moves far
    depths by centimetres.

    Args:
        norm: What it stands for.
    """

    def __init__(self, norm: nn.GroupNorm) -> None:
        super().__init__()
        self.eps, self.weight, self.bias = norm.eps, norm.weight, norm.bias
        size = norm.num_channels // norm.num_groups
        share = torch.block_diag(*[torch.full((size, size), 1 / size)] * norm.num_groups)
        self.share: Tensor
        self.register_buffer("share", share)  # (C, C), means of channels -> of their groups, without reshaping

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) -> the same, in single precision."""
        centred = x.float() - self._mean(x.float())
        normal = centred * (self._mean(centred.square()) + self.eps).rsqrt()
        return normal * self.weight[:, None, None] + self.bias[:, None, None]

    def _mean(self, x: Tensor) -> Tensor:
        return (x.mean(dim=3).mean(dim=2)[:, None] * self.share).sum(dim=2)[..., None, None]


def with_rowwise_norms(network: nn.Module) -> nn.Module:
    """A copy of a network with `RowwiseGroupNorm`."""
    network = copy.deepcopy(network)
    for module in [*network.modules()]:
        for name, child in module.named_children():
            if isinstance(child, nn.GroupNorm):
                setattr(module, name, RowwiseGroupNorm(child))
    return network
