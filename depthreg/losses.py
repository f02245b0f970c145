"""The training loss: depth, colour, and optionally what the known affine says."""

import torch
from torch import Tensor, nn

from depthreg.data.sample import Measurement
from depthreg.geometry import compose_affines, corner_errors_px, invert_affine, transform_points, warp_affine
from depthreg.metrics import masked_mean, masked_ssim
from depthreg.networks import JointOutput, LocalMatches


class JointLoss(nn.Module):
    """Weighted sum of L1 on the depth, 1 - SSIM on the aligned colour, and two terms on the known affine.

    The paper's loss is 0.9 L1 + 0.02 (1 - SSIM) (Martinez et al., Sensors 2025). Its SSIM alone is a weak teacher of
    registration: far from alignment it has no slope. The simulator knows the affine, so its corners can teach too; and
    the displacement of every region teaches from the first step on, where corners alone lead to the identity.

    Args:
        depth_weight: Weight of the mean absolute depth error in metres, over pixels with ground truth.
        ssim_weight: Weight of 1 - SSIM between the aligned colour and the true one, over pixels that the warp saw.
        corner_weight: Weight of the mean distance of the image corners, in percent of the image's width.
        match_weight: Weight of the cross-entropy of each region's displacement, the mean over matchers.
    """

    def __init__(
        self,
        depth_weight: float = 0.9,
        ssim_weight: float = 0.02,
        corner_weight: float = 0.0,
        match_weight: float = 0.0,
    ) -> None:
        super().__init__()
        self.weights = {
            "depth": depth_weight,
            "ssim": ssim_weight,
            "corner": corner_weight,
            "match": match_weight,
        }

    def forward(self, output: JointOutput, measurement: Measurement) -> dict[str, Tensor]:
        """The terms, unweighted, and their weighted sum as `total`; a term of weight 0 is left out."""
        terms = {
            name: getattr(self, f"_{name}")(output, measurement) for name, weight in self.weights.items() if weight
        }
        return {"total": sum(self.weights[name] * term for name, term in terms.items()), **terms}

    @staticmethod
    def _depth(output: JointOutput, measurement: Measurement) -> Tensor:
        truth_m = measurement["truth_depth_m"]
        return masked_mean((output.depth_m - truth_m).abs(), truth_m > 0)

    @staticmethod
    def _ssim(output: JointOutput, measurement: Measurement) -> Tensor:
        _, seen = warp_affine(measurement["rgb"], output.affine_rgb_from_depth)
        return 1 - masked_ssim(output.rgb_aligned, measurement["truth_rgb"], seen)

    @staticmethod
    def _corner(output: JointOutput, measurement: Measurement) -> Tensor:
        height, width = measurement["rgb"].shape[-2:]
        truth = measurement["truth_affine_rgb_from_depth"]
        return 100 / width * corner_errors_px(output.affine_rgb_from_depth, truth, (height, width)).mean()

    @staticmethod
    def _match(output: JointOutput, measurement: Measurement) -> Tensor:
        truth = measurement["truth_affine_rgb_from_depth"]
        return torch.stack([match_cross_entropy(matches, truth) for matches in output.matches]).mean()


def match_cross_entropy(matches: LocalMatches, truth: Tensor) -> Tensor:
    """Cross-entropy of the displacement scores against where the true affine (B, 2, 3) sends each region.

    The target is spread over the four candidates around the true displacement by bilinear weights; a displacement
    beyond the candidates teaches nothing.
    """
    points_px, offsets_px, scores, affine_before = matches
    still_to_do = compose_affines(invert_affine(affine_before), truth)
    places = points_px.expand(len(truth), -1, -1)
    wanted_px = transform_points(still_to_do, places) - places  # (B, N, 2)
    spacing_px = offsets_px[1, 0] - offsets_px[0, 0]
    distance = (wanted_px[:, :, None] - offsets_px).abs() / spacing_px  # (B, N, K, 2)
    target = (1 - distance).clamp(min=0).prod(dim=-1)
    return -(target * scores.log_softmax(dim=-1)).sum(dim=-1).mean()
