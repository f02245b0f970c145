"""How alike simulated and real measurements are, statistic by statistic, and to a small classifier.

python benchmarks/realism.py --out runs/realism --json runs/realism/realism.json

Reads real frames from the folder DEPTHREG_REAL_DATA, else from ../shared/real beside the checkout. Pictures of them go
to --out alone: their licences forbid publishing them.
"""

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import torch
from likeness import classifier, pictures
from likeness.depth_cameras import DEPTH_CAMERAS, DepthCamera, depth_samples, real_depth_frames
from likeness.distances import compare
from likeness.frames import FOLDERS, DepthImage, real_lidar_frames, simulated_frames
from likeness.lidar import lidar_samples
from rich.console import Console
from rich.table import Table

from depthreg.worlds import DrivingWorld, HouseholdWorld


def tell_apart(real: Sequence[DepthImage], simulated: Sequence[DepthImage], seeds: int) -> dict[str, dict[str, float]]:
    """AUC of the small classifier, mean and spread over seeds; controls hold no difference, or one that has to show."""
    found = {
        f"simulated from real, {channels}": classifier.auc(real, simulated, seeds, channels)
        for channels in classifier.CHANNELS
    }
    for name, tuned in (("tuned on", True), ("held out", False)):  # some frames are for looking at, others for judging
        some = [frame for frame in real if frame.group.startswith("object_") is tuned]
        found[f"simulated from real, frames {name}"] = classifier.auc(some, simulated, seeds)
    found["real from real, random halves"] = classifier.auc_within(real, seeds)
    found["real from real with a tenth dropped"] = classifier.auc_within(real, seeds, classifier.drop_a_tenth)
    found["simulated from simulated, random halves"] = classifier.auc_within(simulated, seeds)
    return {name: {"auc": mean, "std": std} for name, (mean, std) in found.items()}


def print_distances(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print one row a statistic; `halves` and `sources` are distances between real frames and real frames."""
    table = Table(title=title)
    heads = ("", "real", "simulated", "W1", "halves", "sources", "JS, bit", "halves", "sources")
    for head in heads:
        table.add_column(head, justify="right" if head else "left")
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.3g}" for value in row.values()))
    Console(width=125).print(table)


def print_aucs(rows: dict[str, dict[str, float]], parameters: int) -> None:
    """Print one row a question."""
    table = Table("", "AUC on held-out frames", title=f"A classifier of {parameters} parameters, 0.5 = can't tell")
    for name, row in rows.items():
        table.add_row(name, f"{row['auc']:.3f} +- {row['std']:.3f}")
    Console(width=125).print(table)


def write_picture(
    path: Path, real: list[DepthImage], simulated: list[DepthImage], max_m: float, **samples: Any
) -> None:
    """Real frames of different places above simulated ones, and the histograms below."""
    places = {frame.group: frame for frame in real}
    count = min(3, len(places))
    chosen = [places[name] for name in sorted(places)][:: max(len(places) // count, 1)][:count]
    shown = [[f.depth_m for f in frames] for frames in (chosen, simulated[: len(chosen)])]
    size = (min(f.shape[0] for f in shown[0] + shown[1]), min(620, *(f.shape[1] for f in shown[0] + shown[1])))
    views = pictures.side_by_side(shown[0], shown[1], size=size, max_m=max_m)
    histograms = pictures.draw_histograms(samples["real_samples"], samples["simulated_samples"], size=(130, 465))
    cv2.imwrite(str(path), cv2.cvtColor(pictures.above_each_other(views, histograms), cv2.COLOR_RGB2BGR))


def measure_lidar(root: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """The LiDAR on streets: distances, and how well the classifier does."""
    real = real_lidar_frames(root)
    simulated = simulated_frames(
        "hdl64",
        DrivingWorld(),
        [frame.camera for frame in real],
        arguments.frames,
        arguments.out / "frames",
        difficulty=arguments.difficulty,
        overrides=["min_lines=64", *arguments.sensor],
    )
    samples = [lidar_samples(frame) for frame in real], [lidar_samples(frame) for frame in simulated]
    write_picture(
        arguments.out / "lidar.png", real, simulated, 80.0, real_samples=samples[0], simulated_samples=samples[1]
    )
    distances = compare(*samples, [frame.group for frame in real])
    print_distances(f"LiDAR: {len(real)} real and {len(simulated)} simulated frames", distances)
    aucs = tell_apart(real, simulated, arguments.seeds) if arguments.seeds else {}
    print_aucs(aucs, sum(p.numel() for p in classifier.small_network().parameters()))
    return {"real": len(real), "simulated": len(simulated), "distances": _known(distances), "auc": aucs}


def measure_depth_camera(kind: DepthCamera, root: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """A depth camera in rooms: distances alone, there are too few real frames for a classifier."""
    real = real_depth_frames(root, kind)
    simulated = simulated_frames(
        kind.sensor,
        HouseholdWorld(),
        [kind.camera],
        arguments.frames // 2,
        arguments.out / "frames",
        difficulty=arguments.difficulty,
    )
    samples = [depth_samples(frame) for frame in real], [depth_samples(frame) for frame in simulated]
    path = arguments.out / f"{kind.sensor}.png"
    write_picture(path, real, simulated, 5.0, real_samples=samples[0], simulated_samples=samples[1])
    distances = compare(*samples, [frame.group for frame in real])
    print_distances(f"{kind.sensor}: {len(real)} real and {len(simulated)} simulated frames", distances)
    return {"real": len(real), "simulated": len(simulated), "distances": _known(distances)}


def _known(rows: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Without what too few frames leave unknown: JSON has no NaN."""
    return {name: {key: value for key, value in row.items() if value == value} for name, row in rows.items()}


def main() -> None:
    """Measure, print, draw, and write what was measured."""
    kinds = {kind.sensor: kind for kind in DEPTH_CAMERAS}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for pictures and rendered frames")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument(
        "--frames", type=int, default=48, help="how many streets to simulate, and twice as many as rooms"
    )
    parser.add_argument("--seeds", type=int, default=5, help="classifiers trained for each question; 0 = none")
    parser.add_argument("--difficulty", type=float, default=1.0, help="of the sensors, from 0 to 1")
    parser.add_argument("--only", nargs="+", choices=["hdl64", *kinds], default=["hdl64", *kinds], help="sensors")
    parser.add_argument("--sensor", nargs="*", default=[], metavar="KEY=VALUE", help="other settings of the LiDAR")
    arguments = parser.parse_args()
    root = Path(os.environ.get("DEPTHREG_REAL_DATA", Path(__file__).resolve().parents[2] / "shared/real"))
    missing = [name for name in FOLDERS if not (root / name).is_dir()]
    if missing:
        parser.error(f"no real frames in {root / missing[0]}: set DEPTHREG_REAL_DATA to the folder that holds them")
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    results = {}
    for name in arguments.only:
        if name == "hdl64":
            results[name] = measure_lidar(root, arguments)
        else:
            results[name] = measure_depth_camera(kinds[name], root, arguments)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
