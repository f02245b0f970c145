"""How far exported networks are from PyTorch's on real frames, and what that does to their errors.

python benchmarks/exported.py --markdown runs/exported.md

Reads real frames from the folder DEPTHREG_REAL_DATA, else from ../shared/real beside the checkout. Differences are of
depths up to 80 m, beyond which KITTI's scanner sees nothing; RMSE is over all frames of a set, each counting as much.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from judging import readers
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track

from depthreg.checkpoint import RELEASED, load_network
from depthreg.data.sample import Measurement
from depthreg.errors import InputError
from depthreg.export import export, open_exported
from depthreg.frame_network import FrameNetwork
from depthreg.networks import Network

FAR_M = 80.0
WAYS = (("torchscript", "fp32"), ("onnx", "fp32"), ("onnx", "fp16"), ("onnx", "int8"))
HEADINGS = ("frames", "format", "precision", "MB", "largest (mm)", "mean (mm)", "RMSE (m)", "PyTorch's RMSE (m)")

Row = dict[str, Any]


def main() -> None:
    """Export, compare, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, default=RELEASED, help="weights; the released ones where not given")
    parser.add_argument("--frames", type=int, default=4, help="of each set; default: 4")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument("--markdown", type=Path, help="file for the table")
    options = parser.parse_args()
    root = Path(os.environ.get("DEPTHREG_REAL_DATA", Path(__file__).resolve().parents[2] / "shared/real"))
    if not (root / "kitti_odom_04").is_dir():
        sys.exit(f"exported.py: no real frames in {root}: set DEPTHREG_REAL_DATA to the folder that holds them")
    try:
        network = load_network(options.checkpoint)
    except InputError as error:
        sys.exit(f"exported.py: {error}")
    sets = readers.cut(readers.kitti_depth(root) | readers.indoor_depth(root), options.frames)
    rows = list(compare(network, {name: frames for name, frames in sets.items() if name in CHOSEN}))
    table = markdown(rows)
    Console(width=160).print(Markdown(table))
    if options.json:
        text = json.dumps({"weights": options.checkpoint.name, "rows": rows}, indent=2)
        options.json.write_text(text + "\n", encoding="utf-8")
    if options.markdown:
        options.markdown.write_text(table, encoding="utf-8")


CHOSEN = (readers.OFFICIAL, readers.DERIVED, "nyu/kitchenette (500 points)", "rgbdd_tof/4 (phone ToF)")


def compare(network: Network, sets: readers.Frames) -> Iterator[Row]:
    """A row for each set and way of exporting."""
    for kind, precision in track(WAYS, "Exporting", console=Console(stderr=True), transient=True):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"network.{kind}"
            export(network, path, kind, precision, None, {})
            exported, megabytes = open_exported(path, kind), path.stat().st_size / 1e6
            for name, frames in sets.items():
                answers = [(_frame(sample), sample["truth_depth_m"][0, 0].numpy()) for sample in frames]
                yield {"frames": name, "format": kind, "precision": precision, "megabytes": megabytes} | differences(
                    [(exported(*frame)["depth_m"], _eager(network, frame), truth_m) for frame, truth_m in answers]
                )


def _frame(sample: Measurement) -> tuple[torch.Tensor, torch.Tensor]:
    rgb = (255 * sample["rgb"][0]).round().to(torch.uint8)
    return rgb.permute(1, 2, 0).contiguous(), sample["depth_m"][0, 0]


@torch.inference_mode()
def _eager(network: Network, frame: tuple[torch.Tensor, torch.Tensor]) -> np.ndarray:
    return FrameNetwork(network)(*frame)[0].numpy()


def differences(answers: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Of (exported, PyTorch's, true) depths of some frames, in the unit that the key says."""
    apart_m = [np.abs(theirs - ours)[ours < FAR_M] for theirs, ours, _ in answers]
    return {
        "largest_mm": 1000 * max(float(part.max()) for part in apart_m),
        "mean_mm": 1000 * float(np.mean([part.mean() for part in apart_m])),
        "rmse_m": float(np.mean([_rmse(theirs, truth) for theirs, _, truth in answers])),
        "rmse_pytorch_m": float(np.mean([_rmse(ours, truth) for _, ours, truth in answers])),
    }


def _rmse(depth_m: np.ndarray, truth_m: np.ndarray) -> float:
    known = truth_m > 0
    return float(np.sqrt(np.square(depth_m - truth_m)[known].mean()))


def markdown(rows: Sequence[Row]) -> str:
    """The table in Markdown."""
    lines = [HEADINGS, ("---",) * 3 + ("---:",) * 5]
    lines += [tuple(value if isinstance(value, str) else f"{value:.4g}" for value in row.values()) for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    main()
