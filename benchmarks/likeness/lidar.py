"""Statistics of sparse depth images: what a LiDAR's returns look like, whatever they were measured on.

Every function takes z-depth (H, W) in metres with 0 = no return, and gives samples of one quantity.
"""

import cv2
import numpy as np

from likeness.frames import DepthImage

SEE_THROUGH_M = 1.5  # deeper than the neighbourhood's minimum by this: the usual outlier filter of KITTI's benchmark
HOLE_PX = 5.0  # a pixel so far from every return lies in a hole
_FLAT = 0.01  # a block is a plane where returns leave it by less than this share of their range


def image_elevation_deg(depth_m: np.ndarray, focal_px: float, center_row: float) -> np.ndarray:
    """Angle above the optical axis of each return's row, degrees: the density by image row, whatever the crop."""
    rows = np.nonzero(depth_m > 0)[0]
    return np.rad2deg(np.arctan2(center_row - rows, focal_px))


def row_gaps_px(depth_m: np.ndarray) -> np.ndarray:
    """Columns from each return to the next one in its row."""
    rows, columns = np.nonzero(depth_m > 0)
    return np.diff(columns)[np.diff(rows) == 0]


def line_gaps_px(depth_m: np.ndarray, strip_px: int = 3) -> np.ndarray:
    """Rows from each scan line to the next, in strips so wide that every line leaves a return in most of them."""
    height, width = depth_m.shape
    strips = (depth_m[:, : width // strip_px * strip_px] > 0).reshape(height, -1, strip_px).any(axis=2)
    columns, rows = np.nonzero(strips.T)
    return np.diff(rows)[np.diff(columns) == 0]


def lines_per_strip(depth_m: np.ndarray, strip_px: int = 3) -> np.ndarray:
    """How many scan lines cross each strip; returns in touching rows belong to one line."""
    height, width = depth_m.shape
    strips = (depth_m[:, : width // strip_px * strip_px] > 0).reshape(height, -1, strip_px).any(axis=2)
    return (strips & ~np.roll(strips, 1, axis=0))[1:].sum(axis=0)


def see_through_share(depth_m: np.ndarray) -> float:
    """Share of the returns that lie deeper than the nearest one of their 7x7 neighbourhood by 1.5 m or more."""
    valid = depth_m > 0
    nearest_m = cv2.erode(np.where(valid, depth_m, np.float32(1e6)).astype(np.float32), np.ones((7, 7)))
    return float((depth_m[valid] > nearest_m[valid] + SEE_THROUGH_M).mean())


def hole_share(depth_m: np.ndarray) -> float:
    """Share of the pixels below their column's highest return that are more than 5 px away from any return.

    These are the beams that never came back: from dark, polished or slanting surfaces, or behind a blocked view.
    """
    valid = depth_m > 0
    away_px = cv2.distanceTransform((~valid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    scanned = np.logical_or.accumulate(cv2.dilate(valid.astype(np.uint8), np.ones((1, 9))) > 0, axis=0)
    return float((away_px[scanned] > HOLE_PX).mean()) if scanned.any() else 0.0


def depth_steps(depth_m: np.ndarray, within_px: int = 4) -> np.ndarray:
    """Relative change of depth from each return to the next one in its row, at most `within_px` columns away."""
    rows, columns = np.nonzero(depth_m > 0)
    near = (np.diff(rows) == 0) & (np.diff(columns) <= within_px)
    return np.abs(np.diff(np.log(depth_m[rows, columns])))[near]


def plane_roughness_m(
    depth_m: np.ndarray, rays: np.ndarray, block_px: tuple[int, int] = (12, 24), least: int = 12
) -> tuple[np.ndarray, np.ndarray]:
    """How far returns scatter about the plane that fits their block of the image best.

    A plane that misses the camera is q . P = 1; least squares over the block's points P gives q, and the residual
    |q . P - 1| / |q| is the distance from the plane. Blocks that no plane fits are left out.

    Args:
        depth_m: (H, W).
        rays: Through the pixels with z = 1, (H, W, 3).
        block_px: Rows and columns that share a plane: by default some 3 lines of 10 returns.
        least: Fewest returns of a block.

    Returns:
        Root mean square distance of each block, unbiased for the plane's three parameters, and the mean depth of its
        returns, both in metres.
    """
    rows, columns = np.nonzero(depth_m > 0)
    points = (rays[rows, columns] * depth_m[rows, columns, None]).astype(float)
    per_row = -(-depth_m.shape[1] // block_px[1])
    block = rows // block_px[0] * per_row + columns // block_px[1]
    count = np.bincount(block)
    moments = np.stack([np.bincount(block, a * b) for a in points.T for b in points.T], -1).reshape(-1, 3, 3)
    sums = np.stack([np.bincount(block, a) for a in points.T], -1)
    enough = np.nonzero((count >= least) & (np.linalg.cond(moments + 1e-9 * np.eye(3)) < 1e9))[0]
    normal = np.zeros_like(sums)
    normal[enough] = np.linalg.solve(moments[enough], sums[enough, :, None])[..., 0]
    length = np.linalg.norm(normal, axis=1)
    squares = np.bincount(block, (np.einsum("nk,nk->n", points, normal[block]) - 1) ** 2)[enough]
    rms_m = np.sqrt(squares / (count[enough] - 3)) / length[enough]
    mean_m = sums[enough, 2] / count[enough]
    flat = rms_m < _FLAT * mean_m
    return rms_m[flat], mean_m[flat]


def lidar_samples(frame: DepthImage) -> dict[str, np.ndarray]:
    """Samples of every statistic; the unit is in the name."""
    depth_m, camera = frame.depth_m, frame.camera
    roughness_m, mean_m = plane_roughness_m(depth_m, camera.rays())
    return {
        "density, %": np.array([100 * (depth_m > 0).mean()]),
        "row of returns, deg": image_elevation_deg(depth_m, camera.focal_px, float(camera.intrinsics[1, 2])),
        "gap along rows, px": row_gaps_px(depth_m).clip(max=40),
        "gap between lines, px": line_gaps_px(depth_m).clip(max=40),
        "lines per column": lines_per_strip(depth_m),
        "depth, m": depth_m[depth_m > 0],
        "depth step to the next, log": depth_steps(depth_m).clip(max=1),
        "roughness to 10 m, cm": 100 * roughness_m[mean_m < 10],
        "roughness 10-20 m, cm": 100 * roughness_m[(mean_m >= 10) & (mean_m < 20)],
        "roughness 20-40 m, cm": 100 * roughness_m[(mean_m >= 20) & (mean_m < 40)],
        "see-through, %": np.array([100 * see_through_share(depth_m)]),
        "holes, %": np.array([100 * hole_share(depth_m)]),
    }
