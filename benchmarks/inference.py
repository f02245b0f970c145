"""How long a frame takes, and how much memory: our network in every way it can run, beside others.

python benchmarks/inference.py --json runs/inference.json

Each row has a process of its own. A frame goes from what a camera gives (colour of 8 bits, sparse metres) to dense
metres; "files" read and write PNGs besides. Ratios are to our network in eager fp32 at the same size, on as many
threads. Memory is the process's peak while frames run, Python and libraries included. Others' networks have random
weights, which take as long: TinyU-Net; segmentation-models-pytorch's U-Net with its ResNet-18 (the same layers, built
here); and a U-Net of 30 M parameters with a ResNet-34, of CompletionFormer's order of size but without its attention.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table
from speed.measure import Timing, measure
from speed.methods import METHODS, Case

from depthreg.checkpoint import RELEASED, load_network
from depthreg.errors import InputError
from depthreg.export import Size

SIZES = ("640x480", "1242x375", "1920x1080")
YARDSTICK = ("ours, eager", "fp32")
HEADINGS = (
    "size",
    "threads",
    "method",
    "precision",
    "time (ms)",
    "frames/s",
    "x ours",
    "peak (MB)",
    "ready (MB)",
    "M param.",
    "runs",
)

Row = dict[str, Any]


def main() -> None:
    """Measure, print and write."""
    options = _parse()
    try:
        load_network(options.checkpoint)
    except InputError as error:
        sys.exit(f"inference.py: {error}")
    cases = list(make_cases(options.sizes, options.threads, options.methods, options.checkpoint))
    timings = [
        measure(case, options.runs, options.seconds)
        for case in track(cases, "Timing", console=Console(stderr=True), transient=True)
    ]
    rows = with_ratios(cases, timings)
    print_rows(rows)
    if options.json:
        text = json.dumps({"weights": options.checkpoint.name, "rows": rows}, indent=2, allow_nan=False)
        options.json.write_text(text + "\n", encoding="utf-8")


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--json", type=Path, help="file for the numbers")
    add("--checkpoint", type=Path, default=RELEASED, help="our weights; the released ones where not given")
    add("--sizes", nargs="+", default=SIZES, metavar="WxH", help=f"default: {' '.join(SIZES)}")
    add("--threads", nargs="+", type=int, default=[1, 2], help="default: 1 2")
    add("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="rows; default: all")
    add("--runs", type=int, default=10, help="of which the median counts; default: 10")
    add("--seconds", type=float, default=10.0, help="begin no further run of a row after so long; default: 10")
    return parser.parse_args()


def make_cases(
    sizes: Sequence[str], threads: Sequence[int], methods: Sequence[str], checkpoint: Path
) -> Iterator[Case]:
    """All rows, by size, threads and method."""
    for text in sizes:
        width, height = (int(side) for side in text.split("x"))
        for count in threads:
            for method in methods:
                for precision in METHODS[method][1]:
                    yield Case(method, precision, Size(height, width), count, checkpoint)


def with_ratios(cases: Sequence[Case], timings: Sequence[Timing]) -> list[Row]:
    """Rows with the time relative to `YARDSTICK`'s at the same size and threads; what is unknown is None."""
    ours = {
        (case.size, case.threads): timing.seconds
        for case, timing in zip(cases, timings, strict=True)
        if (case.method, case.precision) == YARDSTICK and not timing.reason
    }
    rows = []
    for case, timing in zip(cases, timings, strict=True):
        known = {key: None if timing.reason and key != "reason" else value for key, value in asdict(timing).items()}
        known = {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in known.items()}
        yardstick_s = ours.get((case.size, case.threads))
        told = {
            "size": f"{case.size.width}x{case.size.height}",
            "threads": case.threads,
            "method": case.method,
            "precision": case.precision,
            "frames_per_s": None if timing.reason else 1 / timing.seconds,
            "ratio": timing.seconds / yardstick_s if yardstick_s and not timing.reason else None,
        }
        rows.append(told | known)
    return rows


def print_rows(rows: Sequence[Row]) -> None:
    """Print the table; a row that couldn't be measured says why."""
    table = Table(*HEADINGS, box=None, padding=(0, 1, 0, 0))
    for row in rows:
        what = [row["size"], str(row["threads"]), row["method"], row["precision"]]
        if row["reason"]:
            table.add_row(*what, f"[dim]{row['reason'][:60]}[/dim]")
            continue
        figures = [
            1000 * row["seconds"],
            row["frames_per_s"],
            row["ratio"],
            row["peak_mb"],
            row["ready_mb"],
            row["parameters"],
        ]
        table.add_row(*what, *("-" if figure is None else f"{figure:.4g}" for figure in figures), str(row["runs"]))
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
