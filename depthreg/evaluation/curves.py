"""How errors grow: with fewer returns, with misalignment, with depth, and with distance from the nearest return."""

import csv
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from depthreg.baselines import COMPLETION_BASELINES
from depthreg.data import io
from depthreg.data.sample import Measurement
from depthreg.data.scan_lines import LASERS, is_scan, keep_lines
from depthreg.evaluation.scores import run_network
from depthreg.evaluation.settings import can_misalign, misalign
from depthreg.geometry import corner_errors_px, identity_affine
from depthreg.metrics import depth_errors
from depthreg.report import OURS
from depthreg.sensors.simulator import seeded_generator

UNREGISTERED = "ours, unregistered"  # the same weights, colour taken as it comes
IDENTITY = "identity"

THINNINGS = (1, 2, 4, 8, 16)  # one scan line in so many is kept, or one return
SHIFT_SHARES = (0.0, 0.125, 0.25, 0.5, 0.75, 1.0)  # of the largest misalignment
RANGE_EDGES_M = (0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0, math.inf)
GAP_EDGES_PX = (0.0, 0.5, 1.5, 2.5, 4.5, 8.5, 16.5, 32.5, math.inf)  # the first bin is the returns themselves


class Axis(NamedTuple):
    """What a curve runs over."""

    title: str
    edges: tuple[float, ...] = ()  # of bins whose pixels are pooled over frames; without, frames are averaged


AXES = {
    "lines": Axis(f"scan lines kept, of {LASERS}"),
    "returns": Axis("share of the returns kept"),
    "range": Axis("true depth (m)", RANGE_EDGES_M),
    "gap": Axis("distance to the nearest return (px)", GAP_EDGES_PX),
    "misalignment": Axis("shift of the worst corner (px, for 1242 px of width)"),
}


class CurveError(NamedTuple):
    """An error of one method under one condition, of a frame or of all of them."""

    curve: str  # a key of AXES
    condition: float  # in the axis' unit; of a bin, its lower edge
    metric: str
    method: str
    value: float
    weight: float = 1.0  # frames, or pixels where the curve has bins


def frame_errors(
    network: nn.Module, aligned: Measurement, max_corner_shift_px: float = 24.0, seed: tuple[int, int] = (0, 0)
) -> Iterator[CurveError]:
    """Errors of one frame on all curves that its data allow.

    Depth needs truth; scan lines need intrinsics and a scanner's returns, else single returns are left out; a frame
    too small to cut the misalignment's margin off has no errors over it.

    Args:
        network: Any of `depthreg.networks`, on whatever device.
        aligned: A batch of one, whose colour lines up with its depth.
        max_corner_shift_px: Where the misalignment ends, for an image 1242 pixels wide.
        seed: Of what is drawn; the frame's own.
    """
    if "truth_depth_m" in aligned:
        completed = _completed(network, aligned)
        yield from _binned(completed, aligned)
        yield from _thinned(network, completed, aligned, np.random.default_rng(seed))
    shifts_px = dict.fromkeys(share * max_corner_shift_px for share in SHIFT_SHARES)
    for shift_px in shifts_px if can_misalign(aligned, max_corner_shift_px) else ():
        misaligned = misalign(aligned, max_corner_shift_px, seeded_generator(*seed), shift_px)
        yield from _misaligned(network, misaligned, shift_px)


def _completed(network: nn.Module, sample: Measurement) -> dict[str, Tensor]:
    """Depth (1, 1, H, W) by the network and by each baseline."""
    completed = {OURS: run_network(network, sample).depth_m}
    for method, complete in COMPLETION_BASELINES.items():
        completed[method] = torch.from_numpy(complete(sample["depth_m"][0, 0].numpy()))[None, None]
    return completed


def _depth_errors(curve: str, condition: float, method: str, depth_m: Tensor, truth_m: Tensor) -> Iterator[CurveError]:
    rmse_m, mae_m = depth_errors(depth_m, truth_m)[0, :2].tolist()
    yield CurveError(curve, condition, "rmse_m", method, rmse_m)
    yield CurveError(curve, condition, "mae_m", method, mae_m)


def _thinned(
    network: nn.Module, completed: dict[str, Tensor], sample: Measurement, rng: np.random.Generator
) -> Iterator[CurveError]:
    depth_m = sample["depth_m"][0, 0].numpy()
    intrinsics = sample["intrinsics"][0].numpy() if "intrinsics" in sample else None
    if intrinsics is not None and not is_scan(depth_m, intrinsics):
        intrinsics = None
    order = rng.random(depth_m.shape)  # a return that a coarser thinning keeps, a finer one keeps too
    for every in THINNINGS:
        if intrinsics is None:
            thin_m = np.where(order < 1 / every, depth_m, 0)
        else:
            thin_m = keep_lines(depth_m, intrinsics, LASERS // every)
        if not thin_m.any():
            continue
        if every > 1:
            completed = _completed(network, Measurement(**{**sample, "depth_m": torch.from_numpy(thin_m)[None, None]}))
        curve, condition = ("returns", 1 / every) if intrinsics is None else ("lines", LASERS / every)
        for method, dense_m in completed.items():
            yield from _depth_errors(curve, condition, method, dense_m, sample["truth_depth_m"])


def _misaligned(network: nn.Module, sample: Measurement, shift_px: float) -> Iterator[CurveError]:
    output, size = run_network(network, sample), (sample["rgb"].shape[-2], sample["rgb"].shape[-1])
    truth = sample["truth_affine_rgb_from_depth"]
    for method, affine in ((OURS, output.affine_rgb_from_depth), (IDENTITY, identity_affine(1))):
        error_px = corner_errors_px(affine.float(), truth, size).mean().item()
        yield CurveError("misalignment", shift_px, "corner_error_px", method, error_px)
    if "truth_depth_m" in sample:
        as_it_comes = run_network(network, sample, register=False)
        for method, depth_m in ((OURS, output.depth_m), (UNREGISTERED, as_it_comes.depth_m)):
            yield from _depth_errors("misalignment", shift_px, method, depth_m, sample["truth_depth_m"])


def _binned(completed: dict[str, Tensor], sample: Measurement) -> Iterator[CurveError]:
    truth_m = sample["truth_depth_m"][0, 0].numpy()
    known, empty = truth_m > 0, (sample["depth_m"][0, 0].numpy() <= 0).astype(np.uint8)
    conditions = {"range": truth_m[known], "gap": cv2.distanceTransform(empty, cv2.DIST_L2, 5)[known]}
    for curve, values in conditions.items():
        edges = AXES[curve].edges
        bins = np.digitize(values, edges) - 1
        count = np.bincount(bins, minlength=len(edges) - 1)
        for method, dense_m in completed.items():
            error_m = dense_m[0, 0].numpy()[known] - truth_m[known]
            for number in np.flatnonzero(count):
                some, where = error_m[bins == number], (curve, edges[number])
                rmse_m, mae_m = float(np.sqrt(np.square(some).mean())), float(np.abs(some).mean())
                yield CurveError(*where, "rmse_m", method, rmse_m, float(count[number]))
                yield CurveError(*where, "mae_m", method, mae_m, float(count[number]))


def pool(errors: Iterable[CurveError]) -> list[CurveError]:
    """Errors over all frames, ordered by condition: of frames the mean, of a bin's pixels what they have together."""
    groups = defaultdict(list)
    for error in errors:
        groups[error[:4]].append((error.value, error.weight))
    pooled = []
    for key, pairs in groups.items():
        values, weights = np.array(pairs).T
        power = 2 if AXES[key[0]].edges and key[2] == "rmse_m" else 1
        value = np.average(values**power, weights=weights) ** (1 / power)
        pooled.append(CurveError(*key, float(value), float(weights.sum())))
    order = list(AXES)
    return sorted(pooled, key=lambda error: (order.index(error.curve), error.metric, error.condition))


def write_csv(errors: Sequence[CurveError], path: Path) -> None:
    """One row an error, `weight` being frames, or pixels of a bin; a bin is named by its lower edge."""
    with io.atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(CurveError._fields)
        writer.writerows(errors)
