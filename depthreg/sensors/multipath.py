"""Light that reaches a time-of-flight camera by way of a second surface, and so reports too long a way.

One bounce of Lambert's law between the surfaces that the camera sees, on a coarse grid: the part of multipath
interference that matters in concave corners (Fuchs, "Multipath interference compensation in time-of-flight camera
images", 2010). Surfaces that the camera doesn't see send nothing, and nothing stands between two patches.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

LIGHT_SPEED_M_PER_S = 299_792_458.0


def radians_per_m(frequency_mhz: float) -> float:
    """Phase that modulated light gains for each metre of range, there and back."""
    return 4 * math.pi * frequency_mhz * 1e6 / LIGHT_SPEED_M_PER_S


def patch_transport(points_m: Tensor, normal: Tensor, albedo: Tensor, solid_angle: Tensor) -> tuple[Tensor, Tensor]:
    """How much of the lamp's light comes to each patch by way of each other one, and how much longer that way is.

    A patch j in a solid angle w_j of the view is lit as cos_j / r_j^2, and its area is w_j r_j^2 / cos_j: both cancel.
    What it sends to patch i is albedo_j w_j / pi times cos_ij cos_ji / d_ij^2.

    Args:
        points_m: Patches' centres relative to camera and lamp, (B, N, 3).
        normal: Unit normals, (B, N, 3); 0 where there is no surface.
        albedo: (B, N) in [0, 1].
        solid_angle: Of each patch in the view, steradian, (B, N).

    Returns:
        Light that arrives at i from j relative to a white wall's, (B, N, N), and the one-way range that the detour
        adds to i's own, (r_j + d_ij - r_i) / 2 in metres, (B, N, N).
    """
    distance_m = torch.cdist(points_m, points_m, compute_mode="donot_use_mm_for_euclid_dist")
    # n_i . (p_j - p_i): how far patch j lies in front of patch i.
    in_front_m = normal @ points_m.mT - (normal * points_m).sum(-1, keepdim=True)
    facing = in_front_m.clamp(min=0) * in_front_m.mT.clamp(min=0)  # d^2 cos_ij cos_ji
    range_m = points_m.norm(dim=-1)
    # Patches have a size: without it, neighbours in a corner would light each other without limit.
    size_m2 = (solid_angle * range_m.square())[:, None]
    light = (
        (albedo * solid_angle / math.pi)[:, None] * facing / (distance_m.square() + size_m2).square().clamp(min=1e-9)
    )
    return light, (range_m[:, None] + distance_m - range_m[..., None]) / 2


def indirect_light(
    points_m: Tensor, normal: Tensor, albedo: Tensor, focal_px: Tensor, frequencies_mhz: Sequence[float], patches: int
) -> Tensor:
    """Sum of one-bounce light at each pixel, as phasors relative to the phase of the pixel's own range.

    Args:
        points_m, normal: (B, 3, H, W), camera coordinates; 0 where there is no surface.
        albedo: (B, 1, H, W).
        focal_px: (B,).
        frequencies_mhz: Modulation frequencies, K of them.
        patches: About how many patches the image is cut into.

    Returns:
        Real and imaginary part for each frequency, (B, 2K, H, W), for a white surface: multiply by the pixel's albedo.
    """
    height, width = albedo.shape[-2:]
    rows = max(1, round(math.sqrt(patches * height / width)))
    coarse = (min(rows, height), min(max(1, round(patches / rows)), width))
    pixels_each = height * width / (coarse[0] * coarse[1])
    point, direction, reflectivity = (_at_patches(image, coarse) for image in (points_m, normal, albedo))
    cos_view = point[..., 2] / point.norm(dim=-1).clamp(min=1e-6)
    solid_angle = cos_view**3 * pixels_each / focal_px.square()[:, None]
    light, detour_m = patch_transport(point, direction, reflectivity[..., 0], solid_angle)
    parts = []
    for frequency in frequencies_mhz:
        phase = radians_per_m(frequency) * detour_m
        parts += [(light * phase.cos()).sum(-1), (light * phase.sin()).sum(-1)]
    coarse_parts = torch.stack(parts, dim=1).unflatten(2, coarse)  # (B, 2K, rows, columns)
    return F.interpolate(coarse_parts, size=(height, width), mode="bilinear", align_corners=False)


def _at_patches(image: Tensor, coarse: tuple[int, int]) -> Tensor:
    """Values of (B, C, H, W) in the middle of each patch, (B, N, C)."""
    row, column = (
        ((torch.arange(count, device=image.device) + 0.5) * side / count).long()
        for count, side in zip(coarse, image.shape[-2:], strict=True)
    )
    return image[:, :, row[:, None], column].flatten(2).mT
