"""Colour that belongs to another place: does the network notice, and does it do harm?"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from depthreg.data.sample import Measurement
from depthreg.evaluation.scores import run_network
from depthreg.metrics import depth_errors
from judging.table import Row

Progress = Callable[[Iterable, str], Iterable]

OWN, OTHER, NONE = "own colour", "another frame's colour", "no colour"


def colours(frame: Measurement, other: Measurement) -> dict[str, torch.Tensor]:
    """The frame's own colour, another frame's at its size, and black."""
    rgb = frame["rgb"]
    foreign = F.interpolate(other["rgb"], rgb.shape[-2:], mode="bilinear", align_corners=False)
    return {OWN: rgb, OTHER: foreign, NONE: torch.zeros_like(rgb)}


def measure(
    network: nn.Module, frames: Sequence[Measurement], others: Sequence[Measurement], progress: Progress
) -> list[dict[str, tuple[float, float]]]:
    """For each frame and colour: RMSE in metres, and the trust in the registration."""
    found = []
    for frame, other in progress(list(zip(frames, others, strict=True)), "another frame's colour"):
        scores = {}
        for name, rgb in colours(frame, other).items():
            output = run_network(network, Measurement(**{**frame, "rgb": rgb}))
            rmse_m = depth_errors(output.depth_m, frame["truth_depth_m"])[0, 0].item()
            scores[name] = (rmse_m, output.trust.item())
        found.append(scores)
    return found


def rows(found: Sequence[dict[str, tuple[float, float]]]) -> list[Row]:
    """RMSE with the wrong colour beside that without any, and how often trust tells right from wrong."""
    part, of = "colour of another frame", f"{len(found)} frames"
    rmse_m = {name: float(np.mean([frame[name][0] for frame in found])) for name in (OWN, OTHER, NONE)}
    beside = {name: rmse_m[name] for name in (NONE, OWN)}
    said = {name: np.array([frame[name][1] for frame in found]) for name in (OWN, OTHER)}
    right = float(np.mean(np.concatenate([said[OWN] >= 0.5, said[OTHER] < 0.5])))
    unsure = float(np.mean(said[OTHER])), {OWN: float(np.mean(said[OWN]))}
    ratio = rmse_m[OTHER] / rmse_m[NONE] if rmse_m[NONE] else 1.0
    return [
        Row(part, "RMSE (m), share of that without colour", rmse_m[OTHER], beside, ratio, 1.0, 1.0, of=of),
        Row(part, "mean trust: share of frames told right", *unsure, right, 0.9, 1.0, most=False, of=of),
    ]
