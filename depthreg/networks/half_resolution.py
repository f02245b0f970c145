"""The released network: registration and completion on cells of 2 x 2 pixels, in relative log-depth."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from depthreg.geometry import exact_product, identity_affine, transform_points, warp_affine
from depthreg.networks.blocks import conv_norm_gelu, padding_to, upsample_to
from depthreg.networks.output import JointOutput, check_inputs
from depthreg.networks.priors import Priors, find_priors
from depthreg.networks.propagation import PropagationNet
from depthreg.networks.registration import LocalMatches, RegistrationNet, edge_strength, fit_affine

BOUND = math.log(4.0)  # predictions lie within a quarter of the nearest and four times the farthest return


class HalfResolutionNetwork(nn.Module):
    """Estimates the affine that aligns colour with depth, warps the colour, and completes the depth.

    Depth is seen as its logarithm relative to the image's mean, so the unit doesn't matter: twice the input gives twice
    the output, exactly up to rounding. Modules: the affine and the trust in it depend on `registration` alone.

    Args:
        completion_widths: Channels of the completion's U-Net at strides 2, 4, 8, ...
        dilations: Of the propagation's steps, in cells.
        registration_widths: Channels of registration at strides 2, 4, 8, ...
        registration_hidden: Width of the convolutions that read a correlation.
        matchers: Stride, radius and window of each matcher and how often it looks, see `Matcher`; a stride of 4 at
            least. Without any, colour stays where it is.
        use_rgb: Let completion see colour; without, it sees depth alone, and there must be no matchers.

    Raises:
        ValueError: Matchers without colour.
    """

    def __init__(
        self,
        completion_widths: Sequence[int] = (48, 80, 128, 160, 160),
        dilations: Sequence[int] = (4, 2, 1, 2, 1, 1),
        registration_widths: Sequence[int] = (32, 32, 64),
        registration_hidden: int = 96,
        matchers: Sequence[Sequence[int]] = ((8, 4, 9, 6), (4, 2, 17, 3)),
        use_rgb: bool = True,
    ) -> None:
        super().__init__()
        if matchers and not use_rgb:
            raise ValueError(f"use_rgb=False leaves nothing to register: expected matchers=[], got {list(matchers)}")
        self.config: dict[str, Any] = {  # plain containers, so that a checkpoint can hold it
            "completion_widths": list(completion_widths),
            "dilations": list(dilations),
            "registration_widths": list(registration_widths),
            "registration_hidden": registration_hidden,
            "matchers": [list(matcher) for matcher in matchers],
            "use_rgb": use_rgb,
        }
        self.registers, self.use_rgb = bool(matchers), use_rgb
        self.registration = nn.Module()  # that nobody may look for it in vain
        if matchers:
            self.registration = HalfResolutionRegistration(registration_widths, registration_hidden, matchers)
        self.completion = PropagationNet(completion_widths, dilations)
        self.stride = max(self.completion.stride, self.registration.stride if matchers else 1)
        # Convolutions on CPUs take a fifth less time. The stub of `to` lacks the argument.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, rgb: Tensor, depth_m: Tensor, register: bool = True) -> JointOutput:
        """Register and complete.

        Args:
            rgb: Colour in [0, 1], (B, 3, H, W), H and W at least 64.
            depth_m: Sparse z-depth, (B, 1, H, W), in metres or in any other unit; 0 where there is no return.
            register: Take the colour as it comes where false.
        """
        check_inputs(rgb, depth_m)
        height, width = rgb.shape[-2:]
        padding = padding_to(self.stride, height, width)
        # Autocast would round positions and depths to half precision; convolutions alone are asked to.
        with torch.autocast(rgb.device.type, enabled=False):
            depth = F.pad(depth_m, padding)
            rgb_padded = F.pad(rgb, padding, mode="replicate")
            priors = find_priors(depth)
            valid = (depth > 0).to(depth.dtype)
        affine, trust, matches = self._register(rgb_padded, priors, register)
        rgb_aligned, _ = warp_affine(rgb_padded, affine)
        relative, log_error, earlier = self.completion(rgb_aligned, trust if self.use_rgb else 0 * trust, valid, priors)
        whole = [relative, *(upsample_to(x, relative) for x in earlier)] if self.training else [relative]
        depths = [(bounded(x, priors.returns) + priors.centre).exp()[..., :height, :width] for x in whole]
        rgb_aligned, log_error = (x[..., :height, :width] for x in (rgb_aligned, log_error))
        return JointOutput(depths[0], rgb_aligned, affine, matches, trust, log_error, tuple(depths[1:]))

    def _register(self, rgb: Tensor, priors: Priors, register: bool) -> tuple[Tensor, Tensor, list[LocalMatches]]:
        if register and self.registers:
            return self.registration(rgb, priors)
        return identity_affine(len(rgb), device=rgb.device, dtype=rgb.dtype), rgb.new_ones(len(rgb)), []


def bounded(relative: Tensor, returns: Tensor) -> Tensor:
    """Keep log-depths (B, 1, H, W) near those of the returns, so that none approaches zero or infinity.

    Relative to their mean, the lowest return is at most 0 and the highest at least 0, which is also what `returns` has
    where there is none.
    """
    low, high = (side(dim=(1, 2, 3), keepdim=True) for side in (returns.amin, returns.amax))
    return torch.minimum(torch.maximum(relative, low - BOUND), high + BOUND)


class HalfResolutionRegistration(nn.Module):
    """`RegistrationNet` on cells of 2 x 2 pixels, and how far its answer can be trusted.

    Args:
        widths: Channels at strides 2, 4, 8, ...
        hidden: Width of the convolutions that read a correlation.
        matchers: See `RegistrationNet`.
    """

    def __init__(self, widths: Sequence[int], hidden: int, matchers: Sequence[Sequence[int]]) -> None:
        super().__init__()
        first, *tower = widths
        self.first_rgb = conv_norm_gelu(12 + 2, first)
        self.first_depth = conv_norm_gelu(3 + 1 + 1 + 1 + 4, first)
        self.match = RegistrationNet(first, tower, hidden, matchers, in_stride=2)
        answer = nn.Linear(32, 1)
        nn.init.constant_(answer.bias, 2.0)  # trusts until it learns better
        self.trust = nn.Sequential(nn.Linear(3 * len(matchers), 32), nn.GELU(), answer)
        self.stride = self.match.stride

    def forward(self, rgb: Tensor, priors: Priors) -> tuple[Tensor, Tensor, list[LocalMatches]]:
        """Estimate the affine.

        Args:
            rgb: Colour in [0, 1], (B, 3, H, W), sides multiples of `stride`.
            priors: The sparse depth, filled.

        Returns:
            `affine_rgb_from_depth` (B, 2, 3) in pixels, the trust in it (B,), in [0, 1], and each look of each matcher.
        """
        _, surface, smooth, *_ = priors.candidates.split(1, dim=1)
        edges_rgb = edge_strength(F.avg_pool2d(rgb, 2))
        edges_depth = [edge_strength(surface), edge_strength(smooth)]
        filled = priors.candidates[:, :3]
        seen = torch.cat([filled, priors.sparse, priors.valid, priors.distance, *edges_depth], dim=1)
        first_rgb = self.first_rgb(torch.cat([F.pixel_unshuffle(rgb, 2), edges_rgb], dim=1))
        affine, matches = self.match(first_rgb, self.first_depth(seen))
        last_looks = [matches[seen - 1] for seen in itertools.accumulate(self.match.looks)]
        quality = torch.cat([match_quality(match) for match in last_looks], dim=1).detach()
        return affine, self.trust(quality.to(rgb.dtype)).float().sigmoid()[:, 0], matches


def match_quality(matches: LocalMatches) -> Tensor:
    """How sure and how consistent a matcher's regions are, (B, 3): their entropy, their peak, what no affine explains.

    All are relative to the search's size, so that matchers can be compared.
    """
    points_px, offsets_px, scores, _ = matches
    chance = scores.softmax(dim=-1)
    entropy = -(chance * scores.log_softmax(dim=-1)).sum(dim=-1) / math.log(len(offsets_px))
    displacements_px = exact_product(chance, offsets_px)
    places = points_px.expand(len(scores), -1, -1)
    even = torch.full_like(displacements_px, 1 / displacements_px.shape[1])
    fitted_px = transform_points(fit_affine(points_px, displacements_px, even), places) - places
    unexplained = (displacements_px - fitted_px).norm(dim=-1) / offsets_px.abs().max()
    return torch.stack([part.mean(dim=1) for part in (entropy, chance.amax(dim=-1), unexplained)], dim=1)
