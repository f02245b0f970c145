"""Depth completion that needs no training and no colour: what a user would do without depthreg.

Each takes a z-depth map (H, W) float32 in metres, 0 = no return, with at least one return, and
gives a dense one.
"""

from collections.abc import Callable

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

MAX_DEPTH_M = 100.0  # IP-Basic counts depth from here towards the camera
MIN_DEPTH_M = 0.1  # and takes anything below for empty


def nearest(depth_m: np.ndarray) -> np.ndarray:
    """The depth of the nearest return at every pixel."""
    empty = (depth_m <= 0).astype(np.uint8)
    _, owner = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    depth_of_owner = np.zeros(owner.max() + 1, np.float32)
    depth_of_owner[owner[empty == 0]] = depth_m[empty == 0]
    return depth_of_owner[owner]


def linear(depth_m: np.ndarray) -> np.ndarray:
    """Linear interpolation over the returns' Delaunay triangles; the nearest return outside their hull."""
    filled = nearest(depth_m)
    known = (depth_m > 0).astype(np.uint8)
    # Returns with returns all round border on no gap; without them, dense maps take a hundredth of the time.
    rows, columns = np.nonzero(known & ~cv2.erode(known, np.ones((3, 3), np.uint8)))
    try:
        surface = LinearNDInterpolator((rows, columns), depth_m[rows, columns])
    except (QhullError, ValueError):  # no gap, fewer than three returns, or all of them on one line
        return filled
    gaps = np.nonzero(known == 0)
    inside = surface(*gaps).astype(np.float32)
    filled[gaps] = np.where(np.isnan(inside), filled[gaps], inside)
    return filled


def ip_basic(depth_m: np.ndarray) -> np.ndarray:
    """IP-Basic (Ku et al., CRV 2018): morphology that lets near surfaces grow over far ones.

    The variant that extends each column's topmost depth to the image's upper edge, with the bilateral filter.
    Kernels suit a 64-beam LiDAR at KITTI's resolution; holes of more than 31 px may stay 0.
    """
    # Turned round, so that a dilation (a maximum) prefers what is near; 0 stays empty.
    near_m = np.where(depth_m > MIN_DEPTH_M, MAX_DEPTH_M - depth_m, 0).astype(np.float32)
    steps = np.abs(np.arange(-2, 3))
    near_m = cv2.dilate(near_m, (steps[:, None] + steps <= 2).astype(np.uint8))  # a diamond
    near_m = cv2.morphologyEx(near_m, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    near_m = _fill_empty(near_m, 7)
    near_m = _fill_empty(_extend_to_top(near_m), 31)
    near_m = cv2.medianBlur(near_m, 5)
    near_m = cv2.bilateralFilter(near_m, 5, 1.5, 2.0)
    return np.where(near_m > MIN_DEPTH_M, MAX_DEPTH_M - near_m, 0).astype(np.float32)


def _fill_empty(near_m: np.ndarray, size: int) -> np.ndarray:
    """Give empty pixels the maximum of the `size` x `size` pixels round them."""
    return np.where(near_m > MIN_DEPTH_M, near_m, cv2.dilate(near_m, np.ones((size, size), np.uint8)))


def _extend_to_top(near_m: np.ndarray) -> np.ndarray:
    """Repeat each column's topmost value up to the image's upper edge."""
    top_row = (near_m > MIN_DEPTH_M).argmax(axis=0)
    above = np.arange(len(near_m))[:, None] < top_row
    return np.where(above, near_m[top_row, np.arange(near_m.shape[1])], near_m)


COMPLETION_BASELINES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "nearest": nearest,
    "linear": linear,
    "IP-Basic": ip_basic,
}
