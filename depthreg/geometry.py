"""Pinhole camera, the affine convention, warping and point clouds.

Pixel centres lie at integers. `affine_rgb_from_depth` A (B, 2, 3), in pixels, reads
`rgb_aligned[y, x] = rgb[A @ (x, y, 1)]`. Normalised coordinates never leave this file; align_corners is True, because
then -1 and 1 are the centres of the first and last pixel.
"""

import torch
import torch.nn.functional as F
from torch import Tensor


def identity_affine(batch: int, *, device: torch.device | None = None, dtype: torch.dtype | None = None) -> Tensor:
    """The affine that leaves every pixel where it is, (B, 2, 3)."""
    return torch.eye(2, 3, device=device, dtype=dtype).expand(batch, 2, 3).contiguous()


def exact_product(a: Tensor, b: Tensor) -> Tensor:
    """`a @ b`, (..., N, M) by (..., M, K), element by element: mixed precision would round pixels to half precision."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(dim=-2)


def _as_square(affine: Tensor) -> Tensor:
    last_row = affine.new_tensor([0.0, 0.0, 1.0]).expand(*affine.shape[:-2], 1, 3)
    return torch.cat([affine, last_row], dim=-2)  # (..., 3, 3)


def invert_affine(affine: Tensor) -> Tensor:
    """The affine that undoes `affine`, (..., 2, 3), in closed form (no LAPACK call, so it exports)."""
    (a, b, tx), (c, d, ty) = (row.unbind(-1) for row in affine.unbind(-2))
    det = a * d - b * c
    rows = [d / det, -b / det, (b * ty - d * tx) / det, -c / det, a / det, (c * tx - a * ty) / det]
    return torch.stack(rows, dim=-1).unflatten(-1, (2, 3))


def compose_affines(outer: Tensor, inner: Tensor) -> Tensor:
    """Apply `inner` first, then `outer`; both (..., 2, 3)."""
    return exact_product(outer, _as_square(inner))


def transform_points(affine: Tensor, points_px: Tensor) -> Tensor:
    """Move points (..., N, 2) given as (x, y) by affines (..., 2, 3)."""
    x, y = points_px.unbind(-1)  # not a matrix product, which mixed precision would round to half precision
    rows = affine[..., None].unbind(-3)  # (..., 3, 1) each
    return torch.stack([a * x + b * y + shift for a, b, shift in (row.unbind(-2) for row in rows)], dim=-1)


def affine_places(affine: Tensor, size: tuple[int, int]) -> Tensor:
    """Where affines (B, 2, 3) put each pixel centre of an image of that height and width, (x, y), (B, H, W, 2).

    `transform_points` of `pixel_grid`, for less: a column's part is computed once for all its pixels, a row's too.
    """
    y, x = (torch.arange(side, device=affine.device, dtype=affine.dtype) for side in size)
    rows = affine[..., None, None].unbind(1)  # (B, 3, 1, 1) each
    return torch.stack(
        [a * x + b * y[:, None] + shift for a, b, shift in (row.unbind(1) for row in rows)],
        dim=-1,
    )


def pixel_grid(
    height: int, width: int, *, device: torch.device | None = None, dtype: torch.dtype | None = None
) -> Tensor:
    """The (x, y) of every pixel centre, (H, W, 2)."""
    y, x = torch.meshgrid(
        torch.arange(height, device=device, dtype=dtype),
        torch.arange(width, device=device, dtype=dtype),
        indexing="ij",
    )
    return torch.stack([x, y], dim=-1)


def samples_at(image: Tensor, xy_px: Tensor) -> Tensor:
    """The samples (B, C, H', W') of `sample_at` alone: whether they lie inside takes as long again to tell."""
    x, y = xy_px.unbind(-1)
    unit = torch.stack([2 * x / (image.shape[-1] - 1) - 1, 2 * y / (image.shape[-2] - 1) - 1], dim=-1)
    return F.grid_sample(image, unit, mode="bilinear", padding_mode="zeros", align_corners=True)


def sample_at(image: Tensor, xy_px: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear samples of an image at pixel positions.

    Args:
        image: (B, C, H, W).
        xy_px: Positions (x, y), (B, H', W', 2).

    Returns:
        The samples (B, C, H', W'), zero outside, and a bool mask (B, 1, H', W') of positions inside the image.
    """
    height, width = image.shape[-2:]
    last = xy_px.new_tensor([width - 1, height - 1])
    # A thousandth of a pixel forgives rounding at the border of an identity warp.
    inside = ((xy_px >= -1e-3) & (xy_px <= last + 1e-3)).all(dim=-1)[:, None]
    return samples_at(image, xy_px), inside


def warp_affine(image: Tensor, affine: Tensor, size: tuple[int, int] | None = None) -> tuple[Tensor, Tensor]:
    """`warped[y, x] = image[A @ (x, y, 1)]`, bilinear.

    Args:
        image: (B, C, H, W).
        affine: A in pixels, (B, 2, 3).
        size: Height and width of the result; the image's own where not given.

    Returns:
        The warped image (B, C, H', W'), zero where it looks outside, and a bool mask (B, 1, H', W') of what it saw.
    """
    xy_px = affine_places(affine, size or (image.shape[-2], image.shape[-1]))
    return sample_at(image, xy_px.to(image.dtype))


def image_corners(
    height: int, width: int, *, device: torch.device | None = None, dtype: torch.dtype | None = None
) -> Tensor:
    """Centres of the four corner pixels as (x, y), (4, 2)."""
    return torch.tensor(
        [[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]],
        device=device,
        dtype=dtype or torch.float32,
    )


def corner_errors_px(affine: Tensor, other: Tensor, size: tuple[int, int]) -> Tensor:
    """Distance between where two affines put each image corner, (..., 4) px; `size` is (height, width)."""
    corners = image_corners(*size, device=affine.device, dtype=affine.dtype)
    return (transform_points(affine, corners) - transform_points(other, corners)).norm(dim=-1)


def decompose_affine(affine: Tensor, size: tuple[int, int]) -> dict[str, Tensor]:
    """What an affine does: `translation_px` of the image's centre (..., 2), `rotation_deg`, `scale` and `shear`.

    The 2x2 part is rotation @ [[scale_x, shear], [0, scale_y]]; `scale` is the root of its determinant.
    """
    height, width = size
    centre = affine.new_tensor([[(width - 1) / 2, (height - 1) / 2]])
    translation_px = (transform_points(affine, centre) - centre)[..., 0, :]
    (a, b), (c, d) = (row.unbind(-1) for row in affine[..., :2].unbind(-2))
    angle = torch.atan2(c, a)
    determinant = a * d - b * c
    return {
        "translation_px": translation_px,
        "rotation_deg": torch.rad2deg(angle),
        "scale": determinant.clamp(min=1e-12).sqrt(),
        "shear": (b * angle.cos() + d * angle.sin()) / determinant.clamp(min=1e-12).sqrt(),
    }


def flip_affine(affine: Tensor, width: int) -> Tensor:
    """The affine between the two images after both are mirrored left to right."""
    mirror = affine.new_tensor([[-1.0, 0.0, width - 1.0], [0.0, 1.0, 0.0]]).expand_as(affine)
    return compose_affines(mirror, compose_affines(affine, mirror))


def flip_intrinsics(intrinsics: Tensor, width: int) -> Tensor:
    """K (..., 3, 3) of the image mirrored left to right."""
    flipped = intrinsics.clone()
    flipped[..., 0, 2] = width - 1 - intrinsics[..., 0, 2]
    return flipped


def unproject(depth_m: Tensor, intrinsics: Tensor) -> Tensor:
    """Points in camera coordinates (..., H, W, 3), metres, of z-depths (..., H, W) under K (..., 3, 3)."""
    grid = pixel_grid(*depth_m.shape[-2:], device=depth_m.device, dtype=depth_m.dtype)
    focal = torch.stack([intrinsics[..., 0, 0], intrinsics[..., 1, 1]], dim=-1)[..., None, None, :]
    centre = intrinsics[..., None, None, :2, 2]
    xy = (grid - centre) / focal * depth_m[..., None]
    return torch.cat([xy, depth_m[..., None]], dim=-1)


def project(points_m: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel positions (..., N, 2) and z-depths (..., N) of camera-frame points (..., N, 3) under K (..., 3, 3)."""
    depth_m = points_m[..., 2]
    homogeneous = points_m @ intrinsics.transpose(-1, -2)
    return homogeneous[..., :2] / depth_m[..., None], depth_m
