"""The joint network: registration and completion in one pass."""

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from depthreg.geometry import identity_affine, warp_affine
from depthreg.networks.blocks import conv_norm_gelu, fill_nearest, fill_smoothly, padding_to
from depthreg.networks.completion import TinyUNet
from depthreg.networks.output import JointOutput, check_inputs
from depthreg.networks.registration import LocalMatches, RegistrationNet, edge_strength

MAX_CORRECTION = 4.0  # of a filled depth, as a factor; a bound keeps a young network away from near-zero depths


class JointNetwork(nn.Module):
    """Estimates the affine that aligns colour with depth, warps the colour, and completes the depth.

    After Martinez et al., Sensors 2025, 25(11), 3328: first convolutions on both inputs serve both tasks; registration
    reads them, the colour is warped, and TinyU-Net completes [aligned RGB, sparse depth] with the first features as
    extra skips. Depth enters and leaves as log-depth scaled to [0, 1] over `depth_range_m`, so no prediction can
    approach zero. The affine depends on `first_rgb`, `first_depth` and `registration`; all else is `completion`.

    Args:
        first_channels: Channels of the first convolution on each input.
        completion_widths: Widths of TinyU-Net.
        registration_widths: Channels of registration's tower at strides 2, 4, 8, ...
        registration_hidden: Width of the convolutions that read a correlation.
        matchers: Stride, radius and window of each matcher; see `Matcher`.
        depth_range_m: Smallest and largest depth that can be predicted.
        residual: Predict a correction to the filled sparse depth, at most by `MAX_CORRECTION`, rather than the depth.
        use_rgb: Let completion see colour; without, it sees depth alone, and there must be no matchers.

    Raises:
        ValueError: Matchers without colour.
    """

    def __init__(
        self,
        first_channels: int = 16,
        completion_widths: Sequence[int] = (64, 128, 256, 512),
        registration_widths: Sequence[int] = (32, 96, 256),
        registration_hidden: int = 328,
        matchers: Sequence[tuple[int, int, int]] = ((8, 4, 9), (4, 3, 17)),
        depth_range_m: tuple[float, float] = (0.1, 200.0),
        residual: bool = False,
        use_rgb: bool = True,
    ) -> None:
        super().__init__()
        if matchers and not use_rgb:
            raise ValueError(f"use_rgb=False leaves nothing to register: expected matchers=[], got {list(matchers)}")
        self.config: dict[str, Any] = {  # plain containers, so that a checkpoint can hold it
            "first_channels": first_channels,
            "completion_widths": list(completion_widths),
            "registration_widths": list(registration_widths),
            "registration_hidden": registration_hidden,
            "matchers": [list(matcher) for matcher in matchers],
            "depth_range_m": list(depth_range_m),
            "residual": residual,
            "use_rgb": use_rgb,
        }
        self.first_rgb = conv_norm_gelu(3, first_channels)
        self.first_depth = conv_norm_gelu(3, first_channels)
        self.registration = RegistrationNet(first_channels + 2, registration_widths, registration_hidden, matchers)
        self.completion = TinyUNet(1 + 3 * use_rgb, 1, completion_widths, skip_channels=(1 + use_rgb) * first_channels)
        self.min_depth_m, self.max_depth_m = depth_range_m
        self.residual, self.use_rgb = residual, use_rgb
        self._log_span = math.log(self.max_depth_m / self.min_depth_m)
        self.stride = max(self.completion.stride, self.registration.stride)

    def forward(self, rgb: Tensor, depth_m: Tensor, register: bool = True) -> JointOutput:
        """Register and complete.

        Args:
            rgb: Colour in [0, 1], (B, 3, H, W), H and W at least 64.
            depth_m: Sparse z-depth in metres, (B, 1, H, W); 0 where there is no return.
            register: Look for the affine; else it is the identity, and the colour is used as it comes.
        """
        check_inputs(rgb, depth_m)
        height, width = rgb.shape[-2:]
        padding = padding_to(self.stride, height, width)
        valid = F.pad(depth_m > 0, padding)
        sparse = F.pad(self._to_unit(depth_m), padding) * valid
        filled = fill_smoothly(sparse, valid)
        rgb_padded = F.pad(rgb, padding, mode="replicate")

        first_depth = self.first_depth(torch.cat([sparse, filled, valid.to(sparse.dtype)], dim=1))
        matches: list[LocalMatches] = []
        affine = identity_affine(len(rgb), device=rgb.device, dtype=rgb.dtype)
        if register:
            affine, matches = self._register(rgb_padded, filled, first_depth)
        rgb_aligned, _ = warp_affine(rgb_padded, affine)
        known = fill_nearest(sparse, valid) if self.residual else sparse  # a correction sees what it corrects
        if self.use_rgb:
            skip = torch.cat([self.first_rgb(rgb_aligned), first_depth], dim=1)
            logit = self.completion(torch.cat([rgb_aligned, known], dim=1), skip)
        else:
            logit = self.completion(known, first_depth)
        if self.residual:
            unit = (known + math.log(MAX_CORRECTION) / self._log_span * logit.tanh()).clamp(0, 1)
        else:
            unit = logit.sigmoid()
        depth = self._to_metres(unit)
        cropped = depth[..., :height, :width], rgb_aligned[..., :height, :width]
        unknown = torch.full_like(cropped[0], torch.nan)
        return JointOutput(*cropped, affine, matches, torch.ones_like(affine[:, 0, 0]), unknown)

    def _register(self, rgb: Tensor, filled: Tensor, first_depth: Tensor) -> tuple[Tensor, list[LocalMatches]]:
        rgb_features = torch.cat([self.first_rgb(rgb), edge_strength(rgb)], dim=1)
        return self.registration(rgb_features, torch.cat([first_depth, edge_strength(filled)], dim=1))

    def _to_unit(self, depth_m: Tensor) -> Tensor:
        return (depth_m.clamp(self.min_depth_m, self.max_depth_m) / self.min_depth_m).log() / self._log_span

    def _to_metres(self, unit: Tensor) -> Tensor:
        return self.min_depth_m * (unit * self._log_span).exp()
