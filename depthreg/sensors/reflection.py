"""Infrared light that an active depth camera sends out, and what comes back.

Strengths are relative to a white, matte wall, head-on, one metre away. Lamp and lens count as one point, as they do in
every depth camera compared with the scene's size.
"""

import math

import torch
from torch import Tensor

_GLOSS_EXPONENT = 200  # sharpness of a highlight: half its strength at 5 degrees


def view_rays(intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Directions through the pixels, (B, 3, H, W), z = 1: times a z-depth they are points."""
    height, width = size
    row, column = (torch.arange(side, device=intrinsics.device, dtype=intrinsics.dtype) for side in size)
    x = (column - intrinsics[:, 0, 2, None]) / intrinsics[:, 0, 0, None]  # (B, W)
    y = (row - intrinsics[:, 1, 2, None]) / intrinsics[:, 1, 1, None]  # (B, H)
    planes = (x[:, None].expand(-1, height, -1), y[..., None].expand(-1, -1, width))
    return torch.stack([*planes, torch.ones_like(planes[0])], dim=1)


def ray_stretch(rays: Tensor) -> Tensor:
    """Range along each ray per metre of z-depth, (B, 1, H, W), >= 1."""
    return (rays[:, :1].square() + rays[:, 1:2].square() + 1).sqrt()


def incidence(normal: Tensor, rays: Tensor, stretch: Tensor) -> Tensor:
    """Cosine between surface and light, (B, 1, H, W) in [0, 1]; 1 = head-on, 0 in the sky.

    Args:
        normal: Unit normals that face the camera, (B, 3, H, W).
        rays, stretch: Of `view_rays` and `ray_stretch`.
    """
    return (-(normal * rays).sum(dim=1, keepdim=True) / stretch).clamp(0, 1)


def infrared_albedo(albedo: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Reflectivity at 850 nm of surfaces of a visible albedo, (B, 1, H, W); drawn for each sample.

    Dyes hardly absorb infrared, pigments do: dark things come out brighter by a random power of 0.5 to 1.
    """
    power = 1 - 0.5 * torch.rand(len(albedo), 1, 1, 1, generator=generator).to(albedo.device)
    return albedo.clamp(min=1e-4) ** power * (albedo > 0)


def matte_return(albedo: Tensor, gloss: Tensor, cos: Tensor, range_m: Tensor) -> Tensor:
    """Strength of the light that a surface scatters back, (B, 1, H, W).

    Lambert's law with what a polished surface mirrors away taken off, and the same at grazing angles from every
    surface (Schlick's approximation of Fresnel's law).
    """
    scattered = (1 - gloss) * (1 - (1 - cos) ** 5)
    return torch.where(range_m > 0, albedo * scattered * cos / range_m.clamp(min=1e-2).square(), 0)


def highlight(gloss: Tensor, cos: Tensor, range_m: Tensor) -> Tensor:
    """Strength of the light that a polished surface mirrors straight back, (B, 1, H, W).

    The normalised Blinn-Phong lobe; lamp and lens are one point, so its half vector is the line of sight.
    """
    lobe = (_GLOSS_EXPONENT + 2) / 2 * cos**_GLOSS_EXPONENT
    return torch.where(range_m > 0, gloss * lobe / range_m.clamp(min=1e-2).square(), 0)


def angle_rad(cos: Tensor) -> Tensor:
    """Angle of incidence, radians, a little under a right one."""
    return cos.acos().clamp(max=math.radians(89))
