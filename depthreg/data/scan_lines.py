"""Thinning a scan as a scanner of fewer lasers would: whole scan lines go, rather than single returns.

A depth map doesn't say which laser a return is of. Its elevation does, seen from the scanner: the returns of one laser
share it, whatever they hit.
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

LASERS = 64  # of KITTI's scanner
KITTI_BEHIND_M = 0.27  # how far it stands behind the cameras

# Lasers sit up to 0.2 m above a scanner's origin, which KITTI has 0.08 m above the cameras.
_HEIGHTS_M = np.arange(0.0, 0.61, 0.04)
_TILTS_RAD = np.arange(-0.02, 0.0201, 0.0025)  # of the camera about its optical and its horizontal axis
_COARSE_DEG = 0.08  # a fraction of the angle between two beams
_FINE_DEG = 0.02
_LEAST_GAP_DEG = 0.2  # beams of the densest scanners are 0.3 degrees apart
_CROWDED = 1.5  # lines let elevations crowd so many times as much as chance does
_MOST_OF_A_SCAN = 0.15  # of all pixels; KITTI's reach 5 %


def keep_lines(depth_m: np.ndarray, intrinsics: np.ndarray, lines: int, behind_m: float = KITTI_BEHIND_M) -> np.ndarray:
    """Keep every k-th scan line, as if the scanner had `lines` lasers instead of 64.

    Args:
        depth_m: z-depth of the returns, (H, W), 0 = none.
        intrinsics: K of the camera, (3, 3).
        lines: Lasers of the scanner to imitate, a divisor of 64.
        behind_m: How far the scanner stands behind the camera.

    Raises:
        ValueError: 64 isn't a multiple of `lines`.
    """
    if lines < 1 or LASERS % lines:
        raise ValueError(f"lines must divide {LASERS}, got {lines}")
    every = LASERS // lines
    line = scan_lines(depth_m, intrinsics, behind_m)
    return np.where((line >= 0) & (line % every == every // 2), depth_m, 0)


def scan_lines(depth_m: np.ndarray, intrinsics: np.ndarray, behind_m: float = KITTI_BEHIND_M) -> np.ndarray:
    """Which scan line each return is of, counted from the lowest in view: (H, W) int, -1 = no return.

    How high the lasers stand, and how the camera is tilted, is found by trying: where it is right, elevations crowd
    most. A see-through return beside a near edge may be counted with a neighbouring line.

    Args:
        depth_m: z-depth of the returns, (H, W), 0 = none.
        intrinsics: K of the camera, (3, 3).
        behind_m: How far the scanner stands behind the camera.
    """
    lines = np.full(depth_m.shape, -1)
    if (depth_m > 0).any():
        lines[depth_m > 0] = _beams(_elevations_deg(depth_m, intrinsics, behind_m))
    return lines


def is_scan(depth_m: np.ndarray, intrinsics: np.ndarray, behind_m: float = KITTI_BEHIND_M) -> bool:
    """Whether the returns of a depth map stand in scan lines, and not anywhere, as a depth camera's do.

    Args:
        depth_m: z-depth of the returns, (H, W), 0 = none.
        intrinsics: K of the camera, (3, 3).
        behind_m: How far a scanner would stand behind the camera.
    """
    if not 0 < np.mean(depth_m > 0) < _MOST_OF_A_SCAN:
        return False
    elevation_deg = _elevations_deg(depth_m, intrinsics, behind_m)
    anywhere_deg = elevation_deg + np.random.default_rng(0).uniform(-0.5, 0.5, len(elevation_deg))
    return _crowding(elevation_deg) > _CROWDED * _crowding(anywhere_deg)


def _elevations_deg(depth_m: np.ndarray, intrinsics: np.ndarray, behind_m: float) -> np.ndarray:
    """Elevations of the returns (N,), row by row, for that height and those tilts for which they crowd most."""
    row, column = np.nonzero(depth_m > 0)
    pixels = np.stack([column, row, np.ones_like(row)]).astype(np.float32)
    right, down, forward = np.linalg.inv(intrinsics).astype(np.float32) @ pixels * depth_m[row, column]
    forward = forward + np.float32(behind_m)
    flat = np.hypot(right, forward)
    candidates = []
    for height_m in _HEIGHTS_M.astype(np.float32):
        for pitch in _TILTS_RAD.astype(np.float32):
            risen = -(down + height_m + pitch * forward)
            for roll in _TILTS_RAD.astype(np.float32):
                elevation_deg = np.rad2deg(np.arctan((risen - roll * right) / flat))
                candidates.append((_crowding(elevation_deg), height_m, pitch, roll))
    _, height_m, pitch, roll = max(candidates)
    return np.rad2deg(np.arctan((-(down + height_m + pitch * forward) - roll * right) / flat))


def _histogram(elevation_deg: np.ndarray, bin_deg: float) -> np.ndarray:
    return np.bincount(((elevation_deg + 90) / bin_deg).astype(np.int64)).astype(np.float64)


def _crowding(elevation_deg: np.ndarray) -> float:
    """How many returns share a bin with a return, on average."""
    return float(np.square(_histogram(elevation_deg, _COARSE_DEG)).sum())


def _beams(elevation_deg: np.ndarray) -> np.ndarray:
    """The number of the nearest peak of the elevations' density, from the lowest, (N,)."""
    density = gaussian_filter1d(_histogram(elevation_deg, _FINE_DEG), 2)
    peaks, _ = find_peaks(np.append(density, 0), distance=_LEAST_GAP_DEG / _FINE_DEG, prominence=0.1 * density.max())
    if not len(peaks):
        return np.zeros(len(elevation_deg), np.int64)
    peaks_deg = (peaks + 0.5) * _FINE_DEG - 90
    return np.searchsorted((peaks_deg[1:] + peaks_deg[:-1]) / 2, elevation_deg)
