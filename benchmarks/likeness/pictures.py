"""Pictures of measurements side by side, and of histograms."""

from collections.abc import Sequence

import cv2
import numpy as np

from depthreg.viz import colorize_depth
from likeness.distances import Samples

_DARK = 18
_TEXT = (225, 225, 225)
_REAL, _SIMULATED = (255, 170, 60), (80, 190, 255)  # RGB
_BINS = 40


def _caption(picture: np.ndarray, text: str) -> np.ndarray:
    strip = np.full((24, picture.shape[1], 3), _DARK, np.uint8)
    cv2.putText(strip, text, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    return np.concatenate([strip, picture])


def draw_returns(depth_m: np.ndarray, size: tuple[int, int], max_m: float, dot_px: int = 2) -> np.ndarray:
    """Returns coloured by depth over dark, drawn as dots; cropped to `size` (rows, columns) at the lower middle."""
    height, width = size
    left = max((depth_m.shape[1] - width) // 2, 0)
    cut = depth_m[-height:, left : left + width]
    grown = cv2.dilate(np.where(cut > 0, 1 / np.maximum(cut, 0.1), 0).astype(np.float32), np.ones((dot_px, dot_px)))
    depth = np.where(grown > 0, 1 / np.maximum(grown, 1e-6), 0)
    return np.where((depth > 0)[..., None], colorize_depth(depth, 4.0 if max_m > 20 else 0.5, max_m), np.uint8(_DARK))


def draw_histograms(real: Sequence[Samples], simulated: Sequence[Samples], size: tuple[int, int]) -> np.ndarray:
    """A histogram of every statistic, real in orange, simulated in blue."""
    tiles = [_histogram(real, simulated, name, size) for name in real[0]]
    blank = np.full_like(tiles[0], _DARK)
    tiles += [blank] * (-len(tiles) % 4)
    return np.concatenate([np.concatenate(tiles[i : i + 4], 1) for i in range(0, len(tiles), 4)])


def _histogram(real: Sequence[Samples], simulated: Sequence[Samples], name: str, size: tuple[int, int]) -> np.ndarray:
    height, width = size
    picture = np.full((height, width, 3), _DARK, np.uint8)
    samples = [np.concatenate([s[name] for s in both]).astype(float) for both in (real, simulated)]
    pooled = np.concatenate(samples)
    if not len(pooled):
        return _caption(picture, f"{name}: none")
    low, high = np.percentile(pooled, [0.2, 99.5])
    edges = np.linspace(low, max(high, low + 1e-6), _BINS + 1)
    shares = [np.histogram(x, edges)[0] / max(len(x), 1) for x in samples]
    top = max(float(s.max()) for s in shares) or 1.0
    x = np.linspace(8, width - 8, _BINS)
    for share, color in zip(shares, (_REAL, _SIMULATED), strict=True):
        line = np.stack([x, height - 6 - (height - 14) * share / top], axis=1).round().astype(np.int32)
        cv2.polylines(picture, [line], False, color, 1, cv2.LINE_AA)
    return _caption(picture, f"{name}: {low:.3g} to {high:.3g}")


def side_by_side(
    real: Sequence[np.ndarray], simulated: Sequence[np.ndarray], size: tuple[int, int], max_m: float
) -> np.ndarray:
    """Real measurements in the upper row, simulated ones below."""
    rows = []
    for title, depths in (("real", real), ("simulated", simulated)):
        pictures = [_caption(draw_returns(depth, size, max_m), f"{title} {k + 1}") for k, depth in enumerate(depths)]
        rows.append(np.concatenate(pictures, axis=1))
    return np.concatenate(rows)


def above_each_other(*pictures: np.ndarray) -> np.ndarray:
    """Pictures in one column, padded to the widest."""
    width = max(picture.shape[1] for picture in pictures)
    return np.concatenate(
        [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=_DARK) for p in pictures]
    )
