"""Points and depth of one sensor as the sparse depth that a camera beside it would have.

Pixel centres lie at integers; poses are (4, 4) and rigid.
"""

import cv2
import numpy as np

OCCLUSION_TOLERANCE = 0.05  # of the depth: what lies deeper than a neighbour by more is behind it


def splat(uv_px: np.ndarray, depth_m: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Points as a depth image: each goes to the nearest pixel, and where several do, the nearest point wins.

    Args:
        uv_px: Columns and rows, (N, 2).
        depth_m: Their z-depths, (N,); what isn't positive is behind the camera and left out.
        size: Height and width of the image.

    Returns:
        (H, W) float32, 0 where there is no point.
    """
    height, width = size
    with np.errstate(invalid="ignore"):  # a point at the camera's centre has no pixel, and no depth either
        column, row = np.rint(np.where(depth_m[:, None] > 0, uv_px, -1)).astype(np.int64).T
    inside = (depth_m > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    order = np.flatnonzero(inside)[np.argsort(-depth_m[inside], kind="stable")]  # the nearest is written last
    image = np.zeros(size, np.float32)
    image[row[order], column[order]] = depth_m[order]
    return image


def project_points(points_m: np.ndarray, projection: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Points (N, 3) as a depth image, under a camera's projection matrix (3, 4) from the points' coordinates."""
    homogeneous = points_m @ projection[:, :3].T + projection[:, 3]
    depth_m = homogeneous[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv_px = homogeneous[:, :2] / depth_m[:, None]
    return splat(uv_px, depth_m, size)


def reproject_depth(
    depth_m: np.ndarray,
    depth_intrinsics: np.ndarray,
    rgb_from_depth: np.ndarray,
    rgb_intrinsics: np.ndarray,
    size: tuple[int, int],
) -> np.ndarray:
    """A depth camera's image as the colour camera beside it would see it; nothing is filled in.

    A depth pixel may be several colour pixels wide, and through the gaps between those of a near thing shines what
    the colour camera doesn't see: such points are left out.

    Args:
        depth_m: (H', W') z-depth of the depth camera, 0 = none.
        depth_intrinsics: Its K, (3, 3).
        rgb_from_depth: Pose (4, 4), from the depth camera's coordinates into the colour camera's, metres.
        rgb_intrinsics: K of the colour camera, (3, 3).
        size: Height and width of the colour image.

    Returns:
        (H, W) float32 z-depth of the colour camera, 0 = none.
    """
    row, column = np.nonzero(depth_m > 0)
    rays = np.stack([column, row, np.ones_like(row)], axis=1) @ np.linalg.inv(depth_intrinsics).T
    points_m = rays * depth_m[row, column, None]
    image = project_points(points_m, rgb_intrinsics @ rgb_from_depth[:3], size)
    footprint_px = int(np.ceil(max(np.diag(rgb_intrinsics)[:2] / np.diag(depth_intrinsics)[:2])))
    reach_px = 2 * (footprint_px // 2) + 1
    nearest_m = cv2.erode(
        np.where(image > 0, image, np.inf).astype(np.float32), np.ones((reach_px, reach_px), np.uint8)
    )
    return np.where(image / (1 + OCCLUSION_TOLERANCE) <= nearest_m, image, 0).astype(np.float32)
