"""Registration where the truth is a second real camera: where a calibration says that each return's colour lies."""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

from depthreg.baselines.registration import color_edges, depth_edges
from depthreg.data.io import read_depth_m, read_rgb
from depthreg.data.sample import Measurement
from depthreg.evaluation.scores import run_network
from depthreg.geometry import identity_affine, warp_affine
from depthreg.report import OURS
from depthreg.viz import to_picture
from judging.readers import KITTI, grey, measurement
from judging.table import Row

Progress = Callable[[Iterable, str], Iterable]

REALSENSE = 10000.0  # stored value per metre
REALSENSE_LEAST_M = 0.2  # data sheet; what is nearer is no surface
EDGE_SHARE = 0.08  # of the pixels, with the largest gradients of depth
IDENTITY, FITTED = "identity", "best affine"


@dataclass(frozen=True)
class Pair:
    """Depth of one camera, colour of another.

    Attributes:
        sample: Colour (as the other camera sees it) and depth.
        pixels: Of the depth's grid, where the truth is known, (N, 3) as (x, y, 1).
        places_px: Where the calibration says that their points lie in the colour image, (N, 2).
        judge: A grey image on the depth's grid (H, W); where there is none, the depth's own edges judge.
    """

    sample: Measurement
    pixels: np.ndarray
    places_px: np.ndarray
    judge: np.ndarray | None


def kitti_pairs(root: Path) -> list[Pair]:
    """Depth of the left grey camera, colour of the camera 6 cm beside it; the grey image judges."""
    folder = root / "kitti_odom_04"
    rig, pairs = json.loads((folder / "cameras.json").read_text()), []
    for path in sorted((folder / "cam0/velodyne_raw").glob("*.png")):
        depth_m = read_depth_m(path, KITTI)
        truth_m = read_depth_m(folder / "cam0/groundtruth_depth" / path.name, KITTI)
        row, column = np.nonzero(truth_m)
        z = truth_m[row, column].astype(np.float64)
        places = np.stack([column * z + rig["tx"], row * z + rig["ty"]], axis=-1) / (z + rig["tz"])[:, None]
        sample = measurement(f"cam0_{path.stem}", read_rgb(folder / "cam2/image" / path.name), depth_m)
        pairs.append(Pair(sample, _pixels(row, column), places, grey(folder / "cam0/image" / path.name)))
    return pairs


def realsense_pairs(root: Path) -> list[Pair]:
    """Depth of a RealSense F200 in its own view, colour of the camera 26 mm beside it; the depth's edges judge.

    The colour is brought to the depth camera's focal length and principal point, which every driver tells, and both are
    cut to what it covers; what is left to find is what 26 mm and a slight turn do.
    """
    folder = root / "realsense_f200_apc"
    color_k, depth_k, pose = _calibration(folder / "cam.info.txt")
    color_from_depth = color_k @ np.linalg.inv(depth_k)
    pairs = []
    for path in sorted(folder.glob("*.depth_raw.png")):
        depth_m = read_depth_m(path, REALSENSE)
        rgb = read_rgb(path.with_name(path.name.replace("depth_raw", "color")))
        left, top, right, bottom = _covered(color_from_depth, rgb.shape[:2], depth_m.shape)
        depth_m = depth_m[top:bottom, left:right]
        inner_k = depth_k - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
        to_color, flags = (color_k @ np.linalg.inv(inner_k))[:2], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = cv2.warpAffine(rgb, to_color, depth_m.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
        row, column = np.nonzero(depth_m >= REALSENSE_LEAST_M)
        pixels = _pixels(row, column)
        points = pose[:3, :3] @ (np.linalg.inv(inner_k) @ pixels.T * depth_m[row, column]) + pose[:3, 3:]
        places = (inner_k @ points)[:2] / points[2]
        pairs.append(Pair(measurement(path.name[:12], seen, depth_m), pixels, places.T, None))
    return pairs


def _covered(
    color_from_depth: np.ndarray, color_size: tuple[int, ...], depth_size: tuple[int, ...]
) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what the colour image covers on the depth's grid."""
    corners = np.array([[0, 0, 1], [color_size[1] - 1, color_size[0] - 1, 1]])
    (left, top), (right, bottom) = (corners @ np.linalg.inv(color_from_depth).T)[:, :2]
    return (
        max(math.ceil(left), 0),
        max(math.ceil(top), 0),
        min(math.floor(right) + 1, depth_size[1]),
        min(math.floor(bottom) + 1, depth_size[0]),
    )


def _pixels(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    return np.stack([column, row, np.ones_like(row)], axis=-1).astype(np.float64)


def _calibration(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K of colour, K of depth, and the transform from depth's coordinates to colour's."""
    blocks = [block.splitlines() for block in path.read_text().split("\n\n")]
    matrices = [
        np.array([line.split() for line in lines if line.strip() and not line.startswith("#")], float)
        for lines in blocks
        if any("matrix" in line for line in lines)
    ]
    return matrices[0], matrices[1], matrices[2]


def fitted(pair: Pair) -> np.ndarray:
    """The affine (2, 3) that stands best for the calibration: what no affine can do better."""
    return np.linalg.lstsq(pair.pixels, pair.places_px, rcond=None)[0].T


def place_error_px(pair: Pair, affine: np.ndarray) -> float:
    """Mean distance from where an affine (2, 3) puts the returns to where they lie in the colour image."""
    return float(np.linalg.norm(pair.pixels @ affine.T - pair.places_px, axis=1).mean())


def agreement(pair: Pair, affine: np.ndarray, seen: np.ndarray) -> float:
    """How well the aligned colour fits what judges it, where `seen`.

    The correlation with the judge image; where there is none, how many times stronger the colour's gradients are at
    the depth's edges than elsewhere.
    """
    aligned, _ = warp_affine(pair.sample["rgb"], torch.from_numpy(affine).float()[None])
    rgb = to_picture(aligned[0])
    if pair.judge is not None:
        ours = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        return float(np.corrcoef(ours[seen], pair.judge[seen])[0, 1])
    depth_m = pair.sample["depth_m"][0, 0].numpy()
    edges = depth_edges(np.where(depth_m < REALSENSE_LEAST_M, 0, depth_m))[seen]
    gradients = color_edges(rgb)[seen]
    return float(gradients[edges > np.quantile(edges, 1 - EDGE_SHARE)].mean() / gradients.mean())


def seen_by_all(pair: Pair, affines: Sequence[np.ndarray]) -> np.ndarray:
    """Pixels for which every affine looks inside the colour image, two pixels from its border at least, (H, W) bool."""
    seen = np.ones(pair.sample["rgb"].shape[-2:], bool)
    for affine in affines:
        _, inside = warp_affine(pair.sample["rgb"], torch.from_numpy(affine).float()[None])
        seen &= cv2.erode(inside[0, 0].numpy().astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return seen


def measure(network: nn.Module, pairs: Sequence[Pair], progress: Progress, doing: str) -> list[dict[str, tuple]]:
    """For each pair, by method: place error in pixels, and agreement with the judge."""
    found = []
    for pair in progress(pairs, doing):
        affines = {
            OURS: run_network(network, pair.sample).affine_rgb_from_depth[0].double().numpy(),
            IDENTITY: identity_affine(1)[0].double().numpy(),
            FITTED: fitted(pair),
        }
        seen = seen_by_all(pair, list(affines.values()))
        found.append({name: (place_error_px(pair, a), agreement(pair, a, seen)) for name, a in affines.items()})
    return found


def rows(found: Sequence[dict[str, tuple]], name: str, judged: str) -> list[Row]:
    """Mean place error and agreement; the bar is better than the identity on every frame."""
    part, of = "second camera", f"{len(found)} frames"
    table = []
    for number, what, sign in ((0, "distance to the calibration's place (px)", -1), (1, judged, 1)):
        means = {method: float(np.mean([frame[method][number] for frame in found])) for method in found[0]}
        better = float(np.mean([sign * (frame[OURS][number] - frame[IDENTITY][number]) > 0 for frame in found]))
        beside = {method: mean for method, mean in means.items() if method != OURS}
        label = f"{what}, {name}: share of frames better than the identity"
        table.append(Row(part, label, means[OURS], beside, better, 1.0, 1.0, most=False, of=of))
    return table
