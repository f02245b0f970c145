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


def between_halves(
    distance: Distance, frames: Sequence[Samples], name: str, groups: Sequence[str], draws: int = 20
) -> float:
    """Mean distance between two halves of one set, split by group at random: the noise floor of a comparison."""
    rng = np.random.default_rng(0)
    names, found = sorted(set(groups)), []
    for _ in range(draws):
        chosen = set(rng.permutation(names)[: len(names) // 2].tolist())
        halves: list[tuple[list[Samples], list[str]]] = [([], []), ([], [])]
        for frame, group in zip(frames, groups, strict=True):
            side = halves[group in chosen]
            side[0].append(frame)
            side[1].append(group)
        found.append(distance(halves[0][0], halves[1][0], name, (halves[0][1], halves[1][1])))
    return float(np.nanmean(found))
