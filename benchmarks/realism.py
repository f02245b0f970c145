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
import numpy as np
import torch
from likeness import classifier, pictures
from likeness.distances import between_halves, jensen_shannon, wasserstein
from likeness.frames import DepthImage, real_lidar_frames, simulated_lidar_frames
from likeness.lidar import lidar_samples
from rich.console import Console
from rich.table import Table


def compare(real: Sequence[DepthImage], simulated: Sequence[DepthImage]) -> dict[str, dict[str, float]]:
    """Means and distances of every statistic; each group of frames counts as much as every other.

    Returns:
        By statistic: means of the frames' means, Wasserstein-1 distance (`w1`) in the statistic's unit and
        Jensen-Shannon divergence (`js`) in bits, both also between two halves of the real frames (`_floor`) and
        between one drive and all other real frames (`_drives`).
    """
    samples = [lidar_samples(frame) for frame in real], [lidar_samples(frame) for frame in simulated]
    groups = [f.group for f in real], [f.group for f in simulated]
    one_drive = [s for s, g in zip(samples[0], groups[0], strict=True) if g == "odom_04"]
    others = [(s, g) for s, g in zip(samples[0], groups[0], strict=True) if g != "odom_04"]
    drives = one_drive, [s for s, _ in others]
    drive_groups = ["odom_04"] * len(one_drive), [g for _, g in others]
    rows = {}
    for name in samples[0][0]:
        rows[name] = {
            "real": float(np.mean([s[name].mean() for s in samples[0] if len(s[name])])),
            "simulated": float(np.mean([s[name].mean() for s in samples[1] if len(s[name])])),
        }
        for short, distance in (("w1", wasserstein), ("js", jensen_shannon)):
            rows[name] |= {
                short: distance(*samples, name, groups),
                f"{short}_floor": between_halves(distance, samples[0], name, groups[0]),
                f"{short}_drives": distance(*drives, name, drive_groups),
            }
    return rows


def tell_apart(real: Sequence[DepthImage], simulated: Sequence[DepthImage], seeds: int) -> dict[str, dict[str, float]]:
    """AUC of the small classifier, mean and spread over seeds, with controls that hold no difference."""
    found = {
        f"simulated from real, {channels}": classifier.auc(real, simulated, seeds, channels)
        for channels in classifier.CHANNELS
    }
    found["real from real, random halves"] = classifier.auc_within(real, seeds)
    found["simulated from simulated, random halves"] = classifier.auc_within(simulated, seeds)
    return {name: {"auc": mean, "std": std} for name, (mean, std) in found.items()}


def print_distances(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print one row a statistic."""
    table = Table(title=title)
    heads = ("", "real", "simulated", "W1", "real halves", "real drives", "JS, bit", "real halves", "real drives")
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


def draw_lidar(real: Sequence[DepthImage], simulated: Sequence[DepthImage], path: Path) -> None:
    """Three real frames of different places above three simulated ones, and the histograms."""
    places = {frame.group: frame for frame in real}
    chosen = [places[name] for name in sorted(places)][:: max(len(places) // 3, 1)][:3]
    views = pictures.side_by_side(
        [f.depth_m for f in chosen], [f.depth_m for f in simulated[:3]], size=(300, 620), max_m=80.0
    )
    samples = [lidar_samples(frame) for frame in real], [lidar_samples(frame) for frame in simulated]
    histograms = pictures.draw_histograms(*samples, size=(130, 465))
    cv2.imwrite(str(path), cv2.cvtColor(pictures.above_each_other(views, histograms), cv2.COLOR_RGB2BGR))


def main() -> None:
    """Measure, print, draw, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for pictures and rendered frames")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument("--frames", type=int, default=48, help="how many frames to simulate")
    parser.add_argument("--seeds", type=int, default=5, help="classifiers trained for each question")
    parser.add_argument("--difficulty", type=float, default=1.0, help="of the sensor, from 0 to 1")
    parser.add_argument("--sensor", nargs="*", default=[], metavar="KEY=VALUE", help="other settings of the LiDAR")
    arguments = parser.parse_args()
    root = Path(os.environ.get("DEPTHREG_REAL_DATA", Path(__file__).resolve().parents[2] / "shared/real"))
    if not root.is_dir():
        parser.error(f"no real frames at {root}: set DEPTHREG_REAL_DATA to their folder")
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)

    real = real_lidar_frames(root)
    simulated = simulated_lidar_frames(
        [frame.camera for frame in real],
        arguments.frames,
        arguments.out / "frames",
        difficulty=arguments.difficulty,
        overrides=arguments.sensor,
    )
    draw_lidar(real, simulated, arguments.out / "lidar.png")
    results: dict[str, Any] = {"frames": {"real": len(real), "simulated": len(simulated)}}
    results["lidar"] = compare(real, simulated)
    print_distances(f"LiDAR: {len(real)} real and {len(simulated)} simulated frames", results["lidar"])
    results["auc"] = tell_apart(real, simulated, arguments.seeds)
    print_aucs(results["auc"], sum(p.numel() for p in classifier.small_network().parameters()))
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
