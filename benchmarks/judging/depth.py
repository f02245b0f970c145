"""Completed depth against the truth: KITTI, rooms, fewer scan lines, misaligned colour, held-out scan lines."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import nn

from depthreg.baselines import COMPLETION_BASELINES
from depthreg.data.sample import Measurement
from depthreg.data.scan_lines import is_scan, scan_lines
from depthreg.evaluation.curves import UNREGISTERED, CurveError, frame_errors, pool
from depthreg.evaluation.scores import run_network
from depthreg.metrics import DEPTH_KEYS, DepthMetrics
from depthreg.report import METRICS, OURS
from judging.readers import KITTI_SETS, Frames, each
from judging.table import Row, ratio_row

Progress = Callable[[Iterable, str], Iterable]
Scores = dict[str, dict[str, dict[str, float]]]  # set -> method -> metric -> value

RIVAL = "IP-Basic"
LIDAR_BEHIND_M = {"nuscenes_demo": 0.8, "ddad_mini": 0.0, "pjlab_calib": 0.09}  # else as in KITTI's car
MAX_SHIFT_PX = 24.0


def score(network: nn.Module, sets: Frames, progress: Progress, doing: str) -> Scores:
    """Each method's errors on each set, per image, then the mean over the set's images."""
    metrics: dict[str, dict[str, DepthMetrics]] = defaultdict(lambda: defaultdict(DepthMetrics))
    for name, frame in progress(list(each(sets)), doing):
        truth_m, sparse_m = frame["truth_depth_m"], frame["depth_m"][0, 0].numpy()
        metrics[name][OURS].update(run_network(network, frame).depth_m, truth_m)
        for method, complete in COMPLETION_BASELINES.items():
            metrics[name][method].update(torch.from_numpy(complete(sparse_m))[None, None], truth_m)
    return {
        name: {
            method: {key: float(value) for key, value in metric.compute().items()} for method, metric in methods.items()
        }
        for name, methods in metrics.items()
    }


def kitti_rows(scores: Scores, counts: dict[str, int]) -> list[Row]:
    """The four errors beside IP-Basic's, of official and derived truth apart."""
    rows = []
    for name in KITTI_SETS:
        methods = scores[name]
        for metric in DEPTH_KEYS[:4]:
            bar = 0.85 if metric in ("rmse_m", "mae_m") else 0.90
            rivals = {RIVAL: methods[RIVAL][metric]}
            what = f"{METRICS[metric][0]}, {name}"
            rows.append(
                ratio_row("KITTI depth", what, methods[OURS][metric], rivals, bar, 0.7, f"{counts[name]} frames")
            )
        others = {key: methods[key]["rmse_m"] for key in ("nearest", "linear")}
        rows.append(ratio_row("KITTI depth", f"RMSE (m), {name}", methods[OURS]["rmse_m"], others))
    return rows


def room_rows(scores: Scores, counts: dict[str, int]) -> list[Row]:
    """RMSE beside all three baselines, set by set; better than all of them is the bar."""
    rows = []
    for name, methods in scores.items():
        rivals = {key: methods[key]["rmse_m"] for key in COMPLETION_BASELINES}
        of = f"{counts[name]} frames"
        rows.append(ratio_row("rooms", f"RMSE (m), {name}", methods[OURS]["rmse_m"], rivals, 0.999, 0.6, of))
    return rows


def curve_rows(network: nn.Module, frames: Sequence[Measurement], progress: Progress) -> list[Row]:
    """Fewer scan lines, and misaligned colour, on the same frames."""
    errors: list[CurveError] = []
    for index, frame in enumerate(progress(frames, "lines and misalignment")):
        errors += frame_errors(network, frame, MAX_SHIFT_PX, (0, index))
    pooled = {error[:4]: error.value for error in pool(errors)}
    of = f"{len(frames)} frames"
    rows = [line_row(pooled, lines, rival, of) for lines in (32, 16, 8, 4) for rival in (RIVAL, "linear")]
    return rows + rise_rows(pooled, of)


def line_row(pooled: dict[tuple, float], lines: int, rival: str, of: str) -> Row:
    """RMSE with so many scan lines, beside a rival's on the same returns."""
    ours, theirs = (pooled["lines", float(lines), "rmse_m", method] for method in (OURS, rival))
    return ratio_row("fewer scan lines", f"RMSE (m), {lines} lines", ours, {rival: theirs}, 0.9, 0.6, of)


def rise_rows(pooled: dict[tuple, float], of: str) -> list[Row]:
    """By how much, in per cent, RMSE rises over that with aligned colour; the bar is of the mean over the shifts."""
    shifts = sorted({key[1] for key in pooled if key[0] == "misalignment" and key[2] == "rmse_m"})
    aligned_m = pooled["misalignment", 0.0, "rmse_m", OURS]

    def rise(method: str, some: Sequence[float]) -> float:
        mean_m = float(np.mean([pooled["misalignment", shift, "rmse_m", method] for shift in some]))
        return 100 * (mean_m / aligned_m - 1) if aligned_m else (math.inf if mean_m else 0.0)

    rows = []
    for what, some, bar, aim in [
        ("0 to 24 px", shifts, 5.0, 1.0),
        *((f"{shift:g} px", [shift], None, None) for shift in shifts[1:]),
    ]:
        ours, rivals = rise(OURS, some), {UNREGISTERED: rise(UNREGISTERED, some)}
        rows.append(Row("misaligned colour", f"rise of RMSE (%), {what}", ours, rivals, ours, bar, aim, of=of))
    return rows


def hold_out(frame: Measurement, behind_m: float) -> tuple[Measurement, str]:
    """Every other scan line becomes the truth; where no lines show, every other return, by chance."""
    depth_m, k = frame["depth_m"][0, 0].numpy(), frame["intrinsics"][0].numpy()
    by_lines = is_scan(depth_m, k, behind_m)
    if by_lines:
        held = scan_lines(depth_m, k, behind_m) % 2 == 1
    else:
        held = np.random.default_rng(0).random(depth_m.shape) < 0.5
    out = Measurement(**frame)
    out["depth_m"], out["truth_depth_m"] = (
        torch.from_numpy(np.where(mask, depth_m, 0).astype(np.float32))[None, None] for mask in (~held, held)
    )
    return out, "scan lines" if by_lines else "returns"


def held_out_sets(sets: Frames) -> Frames:
    """Sets whose frames have held-out returns as truth; the name says whether whole lines were held out."""
    out: Frames = defaultdict(list)
    for name, frame in each(sets):
        held, what = hold_out(frame, LIDAR_BEHIND_M.get(name, 0.27))
        out[f"{name}, {what} held out"].append(held)
    return dict(out)


def held_out_rows(scores: Scores, counts: dict[str, int]) -> list[Row]:
    """RMSE at held-out returns of other LiDARs."""
    rows = []
    for name, methods in scores.items():
        rivals = {key: methods[key]["rmse_m"] for key in (RIVAL, "linear")}
        what = f"RMSE (m), {name}"
        rows.append(ratio_row("other LiDARs", what, methods[OURS]["rmse_m"], rivals, of=f"{counts[name]} frames"))
    return rows
