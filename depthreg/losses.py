"""The training loss: depth, colour, and optionally what the known affine says.

A term gives one value an image, so that the mean over a batch is the same however the batch is spread over devices or
accumulated over steps.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from depthreg.data.sample import Measurement
from depthreg.geometry import compose_affines, corner_errors_px, invert_affine, transform_points, warp_affine
from depthreg.metrics import masked_mean, masked_ssim
from depthreg.networks import JointOutput, LocalMatches
from depthreg.networks.priors import window_max


class LossTerm(Protocol):
    """One term of the loss."""

    @property
    def weight(self) -> float:
        """Its share of the sum; 0 leaves it out."""

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """The unweighted term of each image, (B,)."""


class JointLoss:
    """Weighted sum of terms.

    The paper's loss is 0.9 L1 + 0.02 (1 - SSIM) (Martinez et al., Sensors 2025). Its SSIM alone is a weak teacher of
    registration: far from alignment it has no slope. The simulator knows the affine, so its corners can teach too; and
    the displacement of every region teaches from the first step on, where corners alone lead to the identity.

    Args:
        **terms: By the name under which they are logged.

    Raises:
        ValueError: A weight is negative, or all are 0.
    """

    def __init__(self, **terms: LossTerm) -> None:
        weights = {name: term.weight for name, term in terms.items()}
        if min(weights.values(), default=0) < 0 or not any(weights.values()):
            raise ValueError(f"weights must be at least 0, and one of them above, got {weights}")
        self.terms = {name: term for name, term in terms.items() if term.weight}

    def __call__(self, output: JointOutput, measurement: Measurement) -> dict[str, Tensor]:
        """The terms, unweighted, and their weighted sum as `total`; means over the batch."""
        means = {name: term(output, measurement).mean() for name, term in self.terms.items()}
        total = torch.stack([term.weight * means[name] for name, term in self.terms.items()]).sum()
        return {"total": total, **means}


@dataclass(frozen=True)
class DepthL1:
    """Mean absolute depth error in metres, over the pixels with ground truth."""

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,); 0 where there is no truth."""
        truth_m = measurement["truth_depth_m"]
        return masked_mean((output.depth_m - truth_m).abs(), truth_m > 0, dim=(1, 2, 3))


@dataclass(frozen=True)
class Dissimilarity:
    """1 - SSIM between the aligned colour and the true one, over the pixels that the warp saw."""

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,)."""
        _, seen = warp_affine(measurement["rgb"], output.affine_rgb_from_depth)
        return of_pairs(1 - masked_ssim(output.rgb_aligned, measurement["truth_rgb"], seen), measurement)


@dataclass(frozen=True)
class CornerError:
    """Mean distance of the image corners from where the true affine sends them, in percent of the image's width."""

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,)."""
        return of_pairs(corner_error_pct(output, measurement), measurement)


@dataclass(frozen=True)
class MatchCrossEntropy:
    """Cross-entropy of each region's displacement, the mean over matchers."""

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,); 0 for a network that doesn't register."""
        truth = measurement["truth_affine_rgb_from_depth"]
        if not output.matches:
            return torch.zeros_like(truth[:, 0, 0])
        terms = torch.stack([match_cross_entropy(matches, truth) for matches in output.matches])
        return of_pairs(terms.mean(dim=0), measurement)


@dataclass(frozen=True)
class TrustCrossEntropy:
    """Cross-entropy of the trust in the affine against whether it is right.

    Args:
        weight: Its share of the sum.
        right_pct: The largest mean corner error that counts as right, in percent of the image's width; 0.25 is 3 px of
            KITTI's 1242.
    """

    weight: float
    right_pct: float = 0.25

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,)."""
        right = of_pairs((corner_error_pct(output, measurement) < self.right_pct).float(), measurement)
        return F.binary_cross_entropy(output.trust.float(), right, reduction="none")


@dataclass(frozen=True)
class LogDepthL1:
    """Mean absolute error of the depth's logarithm, which serves the inverse depth and the near as well as the far."""

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,); 0 where there is no truth."""
        truth_m = measurement["truth_depth_m"]
        error = output.depth_m.log() - torch.where(truth_m > 0, truth_m, 1).log()
        return masked_mean(error.abs(), truth_m > 0, dim=(1, 2, 3))


@dataclass(frozen=True)
class RelativeL1:
    """Mean absolute depth error as a share of the image's mean depth: rooms count as much as streets."""

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,); 0 where there is no truth."""
        truth_m = measurement["truth_depth_m"]
        error = masked_mean((output.depth_m - truth_m).abs(), truth_m > 0, dim=(1, 2, 3))
        return error / mean_depth_m(truth_m)


@dataclass(frozen=True)
class EarlierDepth:
    """What depth was on the way, as `LogDepthL1` and `RelativeL1` see it, their sum (deep supervision; Lee 2015).

    Without it a network may say anything before returns correct it, and depends on how many of them there are.
    """

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,); 0 from a network that doesn't say."""
        terms = (LogDepthL1(1.0), RelativeL1(1.0))
        earlier = [output._replace(depth_m=depth_m) for depth_m in output.earlier_m]
        told = [term(one, measurement) for one in earlier for term in terms]
        return torch.stack(told).sum(dim=0) / len(earlier) if told else torch.zeros_like(output.trust)


@dataclass(frozen=True)
class RelativeRmse:
    """Root mean square depth error around the returns, as a share of the image's mean depth.

    Far from any return the depth is a guess, and squares would let those guesses rule; scanners' benchmarks have no
    truth there either.

    Args:
        weight: Its share of the sum.
        reach_px: How far around a return counts.
    """

    weight: float
    reach_px: int = 16

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,); 0 where there is no truth."""
        truth_m, measured = measurement["truth_depth_m"], (measurement["depth_m"] > 0).float()
        near = window_max(measured, 2 * self.reach_px + 1) > 0
        square = masked_mean((output.depth_m - truth_m).square(), (truth_m > 0) & near, dim=(1, 2, 3))
        return (square + 1e-6).sqrt() / mean_depth_m(truth_m)  # the root's slope is infinite at 0


@dataclass(frozen=True)
class ErrorLikelihood:
    """Negative log-likelihood of the depth's own error, were it Laplacian with the expected error that is claimed.

    It teaches the claim alone, not the depth. The sky has no depth, so an error of a factor e is expected there.
    """

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,)."""
        truth_m = measurement["truth_depth_m"]
        error = (output.depth_m.detach().log() - torch.where(truth_m > 0, truth_m, 1).log()).abs()
        claimed = output.log_error.clamp(min=1e-4)
        likelihood = (2 * claimed).log() + torch.where(truth_m > 0, error, 1) / claimed
        return likelihood.mean(dim=(1, 2, 3))


@dataclass(frozen=True)
class NearSky:
    """How much nearer than the farthest return the sky is taken to be, as a logarithm; mean over the sky.

    Where a simulated frame has no true depth, there is sky, or what lies beyond any scanner's range.
    """

    weight: float

    def __call__(self, output: JointOutput, measurement: Measurement) -> Tensor:
        """Of each image, (B,); 0 where there is no sky."""
        farthest_m = measurement["depth_m"].amax(dim=(1, 2, 3), keepdim=True)
        missing = (farthest_m.clamp(min=1e-3) / output.depth_m).log().clamp(min=0)
        return masked_mean(missing, measurement["truth_depth_m"] == 0, dim=(1, 2, 3))


def mean_depth_m(truth_m: Tensor) -> Tensor:
    """Mean true depth of each image, (B,); 1 where there is none."""
    mean = masked_mean(truth_m, truth_m > 0, dim=(1, 2, 3))
    return torch.where(mean > 0, mean, 1)


def corner_error_pct(output: JointOutput, measurement: Measurement) -> Tensor:
    """Mean distance of the corners from where the true affine sends them, in percent of the image's width, (B,)."""
    height, width = measurement["rgb"].shape[-2:]
    truth = measurement["truth_affine_rgb_from_depth"]
    return 100 / width * corner_errors_px(output.affine_rgb_from_depth, truth, (height, width)).mean(dim=-1)


def of_pairs(values: Tensor, measurement: Measurement) -> Tensor:
    """Values (B,) of samples whose colour belongs to their depth, 0 for the others."""
    return values * measurement["paired"] if "paired" in measurement else values


def match_cross_entropy(matches: LocalMatches, truth: Tensor) -> Tensor:
    """Cross-entropy of the displacement scores against where the true affine (B, 2, 3) sends each region.

    The target is spread over the four candidates around the true displacement by bilinear weights; a displacement
    beyond the candidates teaches nothing.

    Returns:
        (B,), means over the regions.
    """
    points_px, offsets_px, scores, affine_before = matches
    still_to_do = compose_affines(invert_affine(affine_before), truth)
    places = points_px.expand(len(truth), -1, -1)
    wanted_px = transform_points(still_to_do, places) - places  # (B, N, 2)
    spacing_px = offsets_px[1, 0] - offsets_px[0, 0]
    distance = (wanted_px[:, :, None] - offsets_px).abs() / spacing_px  # (B, N, K, 2)
    target = (1 - distance).clamp(min=0).prod(dim=-1)
    return -(target * scores.log_softmax(dim=-1)).sum(dim=-1).mean(dim=-1)
