"""How good a depth map, a registration or an aligned image is, in the field's own definitions."""

from typing import Any

import torch
import torch.nn.functional as F
from kornia.metrics import ssim
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from depthreg.geometry import corner_errors_px, decompose_affine, identity_affine

DEPTH_KEYS = ("rmse_m", "mae_m", "irmse_per_km", "imae_per_km", "abs_rel", "delta1")


def masked_mean(values: Tensor, mask: Tensor, dim: tuple[int, ...] | None = None) -> Tensor:
    """Mean of `values` where `mask` is true, 0 where it is true nowhere; what it hides may be infinite.

    Args:
        values: (B, C, H, W).
        mask: Bool, broadcastable to `values`.
        dim: Dimensions to average over; all of them where not given.
    """
    mask = mask.expand_as(values)
    total, count = torch.where(mask, values, 0).sum(dim), mask.sum(dim)
    return total / count.clamp(min=1)


def ssim_map(image: Tensor, other: Tensor, window: int = 11) -> Tensor:
    """Structural similarity of two images (B, C, H, W) in [0, 1] at each pixel, averaged over the channels.

    Differentiable. Gaussian window of sigma 1.5 (Wang et al., 2004).

    Returns:
        (B, 1, H, W) in [-1, 1]; 1 where they agree.
    """
    return ssim(image, other, window_size=window).mean(dim=1, keepdim=True)


def masked_ssim(image: Tensor, other: Tensor, mask: Tensor, window: int = 11) -> Tensor:
    """Mean structural similarity of each image, (B,), where the whole window lies under the mask (B, 1, H, W)."""
    # Min-pooling: a window that touches a hole of the mask would compare colour with nothing.
    whole = -F.max_pool2d(-mask.to(image.dtype), window, stride=1, padding=window // 2) > 0
    return masked_mean(ssim_map(image, other, window), whole, dim=(1, 2, 3))


def depth_errors(pred_m: Tensor, truth_m: Tensor) -> Tensor:
    """Errors of each depth map over the pixels with ground truth, by the KITTI devkit's definitions.

    No cap and no epsilon: a prediction of zero or below where there is truth has an infinite inverse depth,
    and so an infinite iRMSE and iMAE; a hole in a completed map isn't hidden.

    Args:
        pred_m: Completed z-depth, (B, 1, H, W).
        truth_m: Ground truth, (B, 1, H, W), 0 where unknown.

    Returns:
        (B, 6), columns as in `DEPTH_KEYS`; all zero for a map without any truth.
    """
    valid = truth_m > 0
    pred_m, truth_m = pred_m.float().clamp(min=0), truth_m.float()
    error_m = pred_m - truth_m
    inverse_error_per_km = 1000 * (1 / pred_m - 1 / truth_m)
    ratio = torch.maximum(pred_m / truth_m, truth_m / pred_m)

    def mean(values: Tensor) -> Tensor:
        return masked_mean(values, valid, dim=(1, 2, 3))

    columns = [
        mean(error_m.square()).sqrt(),
        mean(error_m.abs()),
        mean(inverse_error_per_km.square()).sqrt(),
        mean(inverse_error_per_km.abs()),
        mean(error_m.abs() / truth_m),
        mean((ratio < 1.25).float()),
    ]
    return torch.stack(columns, dim=1)


class DepthMetrics(Metric):
    """`depth_errors` of each image, then the plain mean over the images that have ground truth.

    `compute()` returns a dictionary with the `DEPTH_KEYS` (NaN where no image had truth); in a Lightning
    module, write `self.log_dict(metric.compute())` at the epoch's end.

    Args:
        **options: Those of every torchmetrics `Metric`.
    """

    full_state_update = False
    sums: Tensor
    images: Tensor

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state("sums", torch.zeros(len(DEPTH_KEYS)), dist_reduce_fx="sum")
        self.add_state("images", torch.tensor(0), dist_reduce_fx="sum")

    def update(self, pred_m: Tensor, truth_m: Tensor) -> None:
        """Add completed depths and ground truths, (B, 1, H, W) in metres; truth 0 where unknown."""
        self.sums += depth_errors(pred_m.detach(), truth_m).sum(dim=0)
        self.images += (truth_m > 0).flatten(1).any(dim=1).sum()

    def compute(self) -> dict[str, Tensor]:
        """The mean over images of each of the `DEPTH_KEYS`."""
        return dict(zip(DEPTH_KEYS, self.sums / self.images, strict=True))


class RegistrationMetrics(Metric):
    """How far estimated affines lie from the true ones, over frames.

    The corner error of a frame is the mean distance over its four corners (MACE once averaged over frames);
    rotation and scale are absolute differences, translation is that of the image's centre. The identity's own
    corner error stands beside, because an error means nothing without the size of what had to be found.
    `compute()` raises ValueError where no frame was added.

    Args:
        **options: Those of every torchmetrics `Metric`.
    """

    full_state_update = False
    corner_px: list[Tensor]  # the median needs every frame's error, so these are kept rather than summed
    identity_corner_px: list[Tensor]
    translation_px: list[Tensor]
    rotation_deg: list[Tensor]
    scale_pct: list[Tensor]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        for name in ("corner_px", "identity_corner_px", "translation_px", "rotation_deg", "scale_pct"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, affine: Tensor, truth: Tensor, size: tuple[int, int]) -> None:
        """Add estimated and true affines, both (B, 2, 3) in pixels, of images of `size` (height, width)."""
        affine, truth = affine.detach().float(), truth.float()
        identity = identity_affine(len(truth), device=truth.device, dtype=truth.dtype)
        ours, true = decompose_affine(affine, size), decompose_affine(truth, size)
        turn_deg = ours["rotation_deg"] - true["rotation_deg"]
        self.corner_px.append(corner_errors_px(affine, truth, size).mean(dim=-1))
        self.identity_corner_px.append(corner_errors_px(identity, truth, size).mean(dim=-1))
        self.translation_px.append((ours["translation_px"] - true["translation_px"]).norm(dim=-1))
        self.rotation_deg.append(((turn_deg + 180) % 360 - 180).abs())
        self.scale_pct.append(100 * (ours["scale"] / true["scale"] - 1).abs())

    def compute(self) -> dict[str, Tensor]:
        """Means over frames, the median corner error, and the shares of frames under 1, 3 and 5 px."""
        corner_px = dim_zero_cat(self.corner_px)
        shares = {f"share_under_{limit}px": (corner_px < limit).float().mean() for limit in (1, 3, 5)}
        return {
            "corner_error_px": corner_px.mean(),
            "corner_error_median_px": corner_px.quantile(0.5),
            "identity_corner_error_px": dim_zero_cat(self.identity_corner_px).mean(),
            "translation_px": dim_zero_cat(self.translation_px).mean(),
            "rotation_deg": dim_zero_cat(self.rotation_deg).mean(),
            "scale_pct": dim_zero_cat(self.scale_pct).mean(),
            **shares,
        }
