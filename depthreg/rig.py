"""What many frames say about their rig: how colour and depth are misaligned, and whether that changes over time."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats

from depthreg.geometry import corner_errors_px, decompose_affine, identity_affine

PARAMETERS = {"x_px": "px", "y_px": "px", "rotation_deg": "deg", "scale_percent": "%"}
MIN_TRUST = 0.5  # below, the network thinks an affine more likely wrong than right
MIN_FRAMES = 10  # of which no trend can be told
SIGNIFICANCE = 0.01  # chance of a trend in any of the parameters where there is none
RULE = (
    f"drifts where a trend in x, y, rotation or scale is significant at {SIGNIFICANCE:g} in all (Mann-Kendall, "
    "Bonferroni, with the number of independent frames after Yue and Wang 2004) and what it comes to over the "
    "recording (Theil-Sen) exceeds the scatter of single frames about it"
)
_MOST_FOR_SLOPE = 1000
_SIGMA_OF_MAD = 1.4826  # a normal distribution's standard deviation is so many median absolute deviations


class FrameAffine(NamedTuple):
    """What the network said of one frame."""

    name: str
    time: float  # in whatever unit, later is larger
    affine_rgb_from_depth: np.ndarray  # (2, 3) in pixels
    trust: float  # in [0, 1]


@dataclass(frozen=True)
class Trend:
    """One parameter over time."""

    median: float
    scatter: float  # of single frames about the trend: robust standard deviation
    change: float  # of the trend, from the first frame to the last
    p_value: float  # of so clear a trend where there is none
    drifts: bool


@dataclass(frozen=True)
class Rig:
    """How colour and depth are misaligned over a recording."""

    frames: int
    frames_used: int  # those that the network trusts
    verdict: str  # constant, drifts, or too few frames
    affine_rgb_from_depth: list[list[float]]  # median, (2, 3) in pixels
    width: int
    height: int
    corner_px: float  # how far the median moves the image's corners, mean
    duration: float  # from the first frame to the last, in the unit of the times
    parameters: dict[str, Trend]  # of `PARAMETERS`

    def as_json(self) -> dict[str, Any]:
        """All of it with the rule, in plain containers."""
        return {**asdict(self), "min_trust": MIN_TRUST, "rule": RULE}


def summarize_rig(frames: Sequence[FrameAffine], size: tuple[int, int]) -> Rig:
    """Summarise the affines of a recording; those that the network doesn't trust are left out.

    Args:
        frames: At least one; in any order.
        size: Height and width of the images.
    """
    frames = sorted(frames, key=lambda frame: frame.time)
    used = [frame for frame in frames if frame.trust >= MIN_TRUST]
    times = np.array([frame.time for frame in used or frames])
    affines = torch.tensor(np.array([frame.affine_rgb_from_depth for frame in used or frames]), dtype=torch.float64)
    trends = {name: _trend(times, values) for name, values in parameters_of(affines, size).items()}
    enough = len(used) >= MIN_FRAMES
    drifts = any(trend.drifts for trend in trends.values())
    median = _median_affine(affines, size)
    return Rig(
        frames=len(frames),
        frames_used=len(used),
        verdict="too few frames" if not enough else "drifts" if drifts else "constant",
        affine_rgb_from_depth=median.tolist(),
        width=size[1],
        height=size[0],
        corner_px=corner_errors_px(median, identity_affine(1, dtype=torch.float64)[0], size).mean().item(),
        duration=frames[-1].time - frames[0].time,
        parameters=trends,
    )


def parameters_of(affines: torch.Tensor, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """What affines (N, 2, 3) do to the image's centre and its size, by the names of `PARAMETERS`, (N,) each."""
    moves = decompose_affine(affines, size)
    x_px, y_px = moves["translation_px"].unbind(-1)
    values = (x_px, y_px, moves["rotation_deg"], 100 * (moves["scale"] - 1))
    return {name: value.numpy() for name, value in zip(PARAMETERS, values, strict=True)}


def _median_affine(affines: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """The median of each number of affines (N, 2, 3) about the image's centre: a turn doesn't move it."""
    centre = affines.new_tensor([(size[1] - 1) / 2, (size[0] - 1) / 2])
    linear = torch.from_numpy(np.median(affines[..., :2].numpy(), axis=0))
    moved = torch.from_numpy(np.median((affines[..., :2] @ centre + affines[..., 2]).numpy(), axis=0))
    return torch.cat([linear, (moved - linear @ centre)[:, None]], dim=1)


def _trend(times: np.ndarray, values: np.ndarray) -> Trend:
    """See `RULE`; fewer than `MIN_FRAMES` values have no trend."""
    median = float(np.median(values))
    if len(values) < MIN_FRAMES or np.ptp(times) == 0:
        return Trend(median, _scatter(values), 0.0, 1.0, False)
    every = -(-len(values) // _MOST_FOR_SLOPE)  # every two of them are compared
    slope = float(stats.theilslopes(values[::every], times[::every]).slope)
    residuals = values - slope * times
    scatter, change = _scatter(residuals), slope * float(np.ptp(times))
    p_value = _trend_p_value(times, values, residuals)
    drifts = p_value < SIGNIFICANCE / len(PARAMETERS) and abs(change) > scatter
    return Trend(median, scatter, change, p_value, bool(drifts))


def _scatter(values: np.ndarray) -> float:
    return float(_SIGMA_OF_MAD * np.median(np.abs(values - np.median(values))))


def _trend_p_value(times: np.ndarray, values: np.ndarray, residuals: np.ndarray) -> float:
    """Mann-Kendall's test, with fewer independent frames the more each resembles the one before.

    After S. Yue, C. Wang, "The Mann-Kendall test modified by effective sample size to detect trend in serially
    correlated hydrological series", Water Resources Management 18, 2004, for a first-order process.
    """
    p_value = stats.kendalltau(times, values).pvalue
    if not np.isfinite(p_value):  # all values are the same
        return 1.0
    likeness = stats.spearmanr(residuals[:-1], residuals[1:]).statistic if np.ptp(residuals) > 0 else 0.0
    likeness = np.clip(np.nan_to_num(likeness), 0, 0.99)
    independent_share = (1 - likeness) / (1 + likeness)
    return float(2 * stats.norm.sf(stats.norm.isf(p_value / 2) * np.sqrt(independent_share)))
