"""Distances between two sets of frames, and how far apart two sets of real frames are."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial.distance import jensenshannon
from scipy.stats import wasserstein_distance

Samples = Mapping[str, np.ndarray]  # of one frame, by statistic
_BINS = 40


def _pool(frames: Sequence[Samples], name: str, groups: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Samples of all frames, and weights by which every group counts as much as every other."""
    sizes = {group: sum(len(f[name]) for f, g in zip(frames, groups, strict=True) if g == group) for group in groups}
    weights = [np.full(len(f[name]), 1 / max(sizes[g], 1)) for f, g in zip(frames, groups, strict=True)]
    return np.concatenate([f[name] for f in frames]).astype(float), np.concatenate(weights)


def wasserstein(
    first: Sequence[Samples], second: Sequence[Samples], name: str, groups: tuple[Sequence[str], Sequence[str]]
) -> float:
    """Wasserstein-1 distance in the statistic's own unit: how far samples have to move on average."""
    (a, weight_a), (b, weight_b) = _pool(first, name, groups[0]), _pool(second, name, groups[1])
    return float(wasserstein_distance(a, b, weight_a, weight_b)) if len(a) and len(b) else float("nan")


def jensen_shannon(
    first: Sequence[Samples], second: Sequence[Samples], name: str, groups: tuple[Sequence[str], Sequence[str]]
) -> float:
    """Jensen-Shannon divergence of the histograms, in bits: 0 = the same, 1 = no overlap."""
    (a, weight_a), (b, weight_b) = _pool(first, name, groups[0]), _pool(second, name, groups[1])
    if not len(a) or not len(b):
        return float("nan")
    low, high = min(a.min(), b.min()), max(a.max(), b.max())
    edges = np.linspace(low, high + 1e-9 + 1e-6 * abs(high), _BINS + 1)
    histograms = [np.histogram(x, edges, weights=w)[0] for x, w in ((a, weight_a), (b, weight_b))]
    return float(jensenshannon(*histograms, base=2) ** 2)


Distance = Callable[[Sequence[Samples], Sequence[Samples], str, tuple[Sequence[str], Sequence[str]]], float]


def _between(
    distance: Distance, frames: Sequence[Samples], name: str, groups: Sequence[str], chosen: set[str]
) -> float:
    """Distance of the frames whose group is among the chosen ones from all others."""
    inside = [group in chosen for group in groups]
    sides = [[frame for frame, within in zip(frames, inside, strict=True) if within is side] for side in (True, False)]
    names = [[group for group, within in zip(groups, inside, strict=True) if within is side] for side in (True, False)]
    if not sides[0] or not sides[1]:
        return float("nan")
    return distance(sides[0], sides[1], name, (names[0], names[1]))


def between_halves(
    distance: Distance, frames: Sequence[Samples], name: str, groups: Sequence[str], draws: int = 20
) -> float:
    """Mean distance between two halves of one set, split by group at random: the noise floor of a comparison."""
    rng, names = np.random.default_rng(0), sorted(set(groups))
    halves = [set(rng.permutation(names)[: len(names) // 2].tolist()) for _ in range(draws)]
    found = [_between(distance, frames, name, groups, half) for half in halves]
    known = [value for value in found if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def between_sources(distance: Distance, frames: Sequence[Samples], name: str, groups: Sequence[str]) -> float:
    """Distance of the group with the most frames from all others: what another drive or another room makes."""
    return _between(distance, frames, name, groups, {max(sorted(set(groups)), key=list(groups).count)})


def compare(
    real: Sequence[Samples], simulated: Sequence[Samples], groups: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Means and distances of every statistic; each group of real frames counts as much as every other.

    Args:
        real, simulated: Samples of each frame.
        groups: Of the real frames; each simulated one is a group of its own.

    Returns:
        By statistic: means of the frames' means, Wasserstein-1 distance (`w1`) in the statistic's unit and
        Jensen-Shannon divergence (`js`) in bits, both also between two halves of the real frames (`_halves`) and
        between the longest real sequence and all other real frames (`_sources`). NaN where there are too few frames.
    """
    own = [str(k) for k in range(len(simulated))]
    rows = {}
    for name in real[0]:
        rows[name] = {"real": mean_of(real, name), "simulated": mean_of(simulated, name)}
        for short, distance in (("w1", wasserstein), ("js", jensen_shannon)):
            rows[name][short] = distance(real, simulated, name, (groups, own))
            rows[name][f"{short}_halves"] = between_halves(distance, real, name, groups)
            rows[name][f"{short}_sources"] = between_sources(distance, real, name, groups)
    return rows


def mean_of(frames: Sequence[Samples], name: str) -> float:
    """Mean over frames of their means; NaN where no frame has any."""
    means = [frame[name].mean() for frame in frames if len(frame[name])]
    return float(np.mean(means)) if means else float("nan")
