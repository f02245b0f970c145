"""Colour that doesn't line up with depth: random affines of a bounded corner shift, and the view that they give.

All randomness is drawn on the CPU, so that a generator's seed gives the same measurement on every device.
"""

import numpy as np
import torch
from torch import Tensor

from depthreg.geometry import affine_places, corner_errors_px, identity_affine, invert_affine, samples_at

REFERENCE_WIDTH_PX = 1242  # shifts are stated for a KITTI image and scale with the width


def random_affines(
    count: int, size: tuple[int, int], max_corner_shift_px: float, generator: torch.Generator | None = None
) -> Tensor:
    """Random translations, rotations, scalings and shears, scaled to a chosen shift of the worst corner.

    The largest corner shift of each affine is uniform in [0, `max_corner_shift_px`], and the mixture of the four kinds
    is random.

    Args:
        count: How many.
        size: Height and width of the image, pixels.
        max_corner_shift_px: Largest distance that an image corner may move, >= 0.
        generator: Source of randomness, on the CPU.

    Returns:
        `affine_rgb_from_depth`, (count, 2, 3), on the CPU.
    """
    height, width = size
    radius = (
        max(height, width) / 2
    )  # a unit of rotation, scale or shear moves the far border about as much as a unit shift
    kinds = torch.tensor(
        [
            [[0, 0, 1], [0, 0, 0]],  # translation along x
            [[0, 0, 0], [0, 0, 1]],  # translation along y
            [[0, -1, 0], [1, 0, 0]],  # rotation
            [[1, 0, 0], [0, 1, 0]],  # scale
            [[1, 0, 0], [0, -1, 0]],  # aspect (shear along the diagonals)
            [[0, 1, 0], [1, 0, 0]],  # shear
        ],
        dtype=torch.float32,
    )
    kinds[2:] *= torch.tensor([1.0, 1.0, 0.25, 0.25])[:, None, None] / radius  # real rigs shear little
    mixture = torch.rand(count, len(kinds), generator=generator) * 2 - 1
    deviation = torch.einsum("bk,kij->bij", mixture, kinds)
    to_centre = torch.tensor([(width - 1) / 2, (height - 1) / 2])
    deviation[..., 2] -= deviation[..., :2] @ to_centre  # rotate and scale about the image's centre
    wanted_px = torch.rand(count, generator=generator) * max_corner_shift_px
    return _scaled(deviation, wanted_px, size)


def with_corner_shift(affine: Tensor, corner_shift_px: Tensor, size: tuple[int, int]) -> Tensor:
    """Affines (B, 2, 3) of the same kind, scaled so that the worst corner moves by so many pixels (B,).

    The identity stays the identity. `size` is (height, width).
    """
    return _scaled(affine - identity_affine(len(affine)), corner_shift_px, size)


def _scaled(deviation: Tensor, corner_shift_px: Tensor, size: tuple[int, int]) -> Tensor:
    """The identity and a multiple of a deviation (B, 2, 3) from it that moves the worst corner by so much (B,)."""
    identity = identity_affine(len(deviation))
    worst_corner_px = corner_errors_px(identity + deviation, identity, size).amax(dim=-1).clamp(min=1e-6)
    return identity + deviation * (corner_shift_px / worst_corner_px)[:, None, None]


def misalign_rgb(rgb_with_margin: Tensor, affine_rgb_from_depth: Tensor, margin_px: int) -> Tensor:
    """The colour that a misaligned camera would report.

    Args:
        rgb_with_margin: Colour on the depth's grid, with a margin on every side, (B, 3, H + 2M, W + 2M).
        affine_rgb_from_depth: A (B, 2, 3): the result at A @ (x, y, 1) shows what the depth's grid has at (x, y).
        margin_px: M; large enough for the corner shift, else black borders would give the answer away.

    Returns:
        (B, 3, H, W).
    """
    height, width = (side - 2 * margin_px for side in rgb_with_margin.shape[-2:])
    depth_from_rgb = invert_affine(affine_rgb_from_depth)
    into_margin = depth_from_rgb + depth_from_rgb.new_tensor([[0, 0, margin_px], [0, 0, margin_px]])
    return samples_at(rgb_with_margin, affine_places(into_margin, (height, width)))


def margin_for(max_corner_shift_px: float) -> int:
    """The margin that a renderer has to leave for misalignments up to this corner shift, with a tenth to spare."""
    return int(max_corner_shift_px * 1.1) + 2


def fit_affine(depth_m: np.ndarray, intrinsics: np.ndarray, rgb_from_depth: np.ndarray) -> tuple[np.ndarray, float]:
    """The affine that stands best for a colour camera with a position of its own.

    Least squares over the depth's pixels that the colour camera sees too, of where each one's point lies in its image.
    The sky has no depth and so no say.

    Args:
        depth_m: (H, W), 0 where unknown.
        intrinsics: K of both cameras, (3, 3).
        rgb_from_depth: Rigid transform between their coordinates, (4, 4).

    Returns:
        `affine_rgb_from_depth` (2, 3) float32, and the RMS distance in pixels that it leaves (parallax). Where fewer
        than three points are seen, which leave an affine open, it is the identity, and 0.
    """
    row, column = np.nonzero(depth_m)
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1).astype(np.float64)
    points_m = (pixels @ np.linalg.inv(intrinsics).T) * depth_m[row, column, None]
    points_m = points_m @ rgb_from_depth[:3, :3].T + rgb_from_depth[:3, 3]
    inverse_depth = 1 / points_m[:, 2].clip(1e-3)  # what lies behind the camera lands far outside its image
    places_px = (points_m @ intrinsics.T)[:, :2] * inverse_depth[:, None]
    parallax_px = intrinsics[0, 0] * np.linalg.norm(rgb_from_depth[:3, 3]) * inverse_depth
    seen = _nearest_in_its_pixel(places_px, parallax_px, depth_m.shape)
    pixels, places_px = pixels[seen], places_px[seen]
    if len(pixels) < 3:
        return np.eye(2, 3, dtype=np.float32), 0.0
    affine = np.linalg.lstsq(pixels, places_px, rcond=None)[0].T
    residual_px = np.sqrt(np.square(pixels @ affine.T - places_px).sum(axis=1).mean())
    return affine.astype(np.float32), float(residual_px)


def _nearest_in_its_pixel(places_px: np.ndarray, parallax_px: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Which points lie in the image with nothing nearer before them, bool (N,).

    Two points that meet in a pixel of one camera lay at least a pixel apart in the other's: the nearer one moved that
    much farther. Less is a slanted surface's own neighbourhood.

    Args:
        places_px: (column, row), (N, 2).
        parallax_px: How far each point moves because of its distance, (N,).
        size: Height and width.
    """
    height, width = size
    column, row = np.rint(places_px.clip(-1, max(size))).astype(np.int64).T
    seen = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel, parallax_px = (row * width + column)[seen], parallax_px[seen]
    nearest = np.zeros(height * width)
    np.maximum.at(nearest, pixel, parallax_px)
    seen[seen] = nearest[pixel] - parallax_px <= 1
    return seen
