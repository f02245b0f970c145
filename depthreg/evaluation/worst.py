"""Panels of the frames that a network is worst on, with the sign of its error."""

from collections.abc import Mapping

import cv2
import numpy as np

from depthreg import viz
from depthreg.report import OURS

_GROWN_PX = 2  # so that sparse truth can be seen


def grow(values: np.ndarray, radius_px: float = _GROWN_PX) -> np.ndarray:
    """Give unknown values (NaN) that of the nearest known pixel, as far as `radius_px`; (H, W)."""
    unknown = np.isnan(values)
    if unknown.all():
        return values
    distance_px, owner = cv2.distanceTransformWithLabels(
        unknown.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_owner = np.zeros(owner.max() + 1, values.dtype)
    of_owner[owner[~unknown]] = values[~unknown]
    return np.where(distance_px <= radius_px, of_owner[owner], np.nan)


def error_panel(
    rgb: np.ndarray,
    depth_m: np.ndarray,
    completed_m: Mapping[str, np.ndarray],
    truth_m: np.ndarray,
) -> np.ndarray:
    """Colour, returns and truth, then depth and signed error of each method, on common scales.

    Args:
        rgb: (H, W, 3) uint8, on the depth's grid.
        depth_m: Sparse depth, (H, W), 0 = none.
        completed_m: Method -> dense depth (H, W); the network first.
        truth_m: (H, W), 0 where unknown.
    """
    known = truth_m > 0
    errors_m = {name: np.where(known, dense_m - truth_m, np.nan) for name, dense_m in completed_m.items()}
    limits_m = viz.depth_limits_m(depth_m, truth_m)
    # Of the network's own error: another method's outliers must not hide it.
    most_m = max(float(np.nanpercentile(np.abs(errors_m.get(OURS, next(iter(errors_m.values())))), 98)), 0.05)
    factor = max(1, round(640 / rgb.shape[1]))
    tiles: list[viz.Tile] = [
        ("colour", viz.enlarge(rgb, factor)),
        (f"depth as given, {np.mean(depth_m > 0):.1%} of pixels", viz.depth_tile(depth_m, limits_m, factor)),
        ("true depth", viz.depth_tile(truth_m, limits_m, factor)),
    ]
    for name, dense_m in completed_m.items():
        error_m = errors_m[name]
        rmse_m = np.sqrt(np.nanmean(np.square(error_m)))
        picture = viz.signed_error_with_bar(viz.enlarge(grow(error_m), factor), most_m)
        tiles.append((f"{name}", viz.depth_tile(dense_m, limits_m, factor)))
        tiles.append((f"{name}, error (blue: too near, red: too far), RMSE {rmse_m:.2f} m", picture))
    if rgb.shape[1] > 2 * rgb.shape[0]:
        return viz.panel(tiles, 1)
    return viz.panel([*tiles[:3], ("", np.zeros((1, 1, 3), np.uint8)), *tiles[3:]], 2)
