"""The table of bars: how the network does on real frames, beside what could be done without it.

python benchmarks/bars.py --json runs/bars/bars.json --out runs/bars

Reads real frames from the folder DEPTHREG_REAL_DATA, else from ../shared/real beside the checkout. Tables are of
numbers alone; pictures of the frames go to --out: their licences forbid publishing them.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from judging import classical, colour, cost, depth, pictures, readers, registration, second_camera
from judging.readers import Frames
from judging.table import Row, markdown, print_table, write_json
from rich.console import Console
from rich.progress import track
from torch import nn

from depthreg.checkpoint import RELEASED, load_network
from depthreg.data.sample import Measurement
from depthreg.errors import InputError

Progress = Callable[[Iterable, str], Iterable]


@dataclass(frozen=True)
class Counts:
    """How many frames each part takes; with half a second a frame, all of it takes about ten minutes."""

    depth: int = 11  # frames of each set that has truth, or held-out returns
    lines: int = 6  # frames for the curves over scan lines and misalignment, 17 runs each
    lidar: int = 12  # frames that get known affines
    rooms: int = 11
    draws: int = 3  # affines a frame
    compared: int = 12  # frames on which the classical methods run too, seconds each
    rendered: int = 12  # streets, and as many rooms
    pairs: int = 11  # of each second camera
    colours: int = 6  # frames that get another's colour, 3 runs each


PARTS = ("depth", "lines", "registration", "cameras", "colour", "others", "cost")


def measure(network: nn.Module, root: Path, parts: Sequence[str], counts: Counts, progress: Progress) -> list[Row]:
    """All rows of the chosen parts."""
    kitti = readers.cut(readers.kitti_depth(root), counts.depth)
    streets = readers.spread([*kitti[readers.OFFICIAL], *kitti[readers.DERIVED]], counts.lines)
    measured: dict[str, Callable[[], list[Row]]] = {
        "depth": partial(_depth, network, kitti, readers.cut(readers.indoor_depth(root), counts.depth), progress),
        "lines": partial(depth.curve_rows, network, streets, progress),
        "registration": partial(_registration, network, root, counts, progress),
        "cameras": partial(_cameras, network, root, counts, progress),
        "colour": partial(_colour, network, root, kitti, counts, progress),
        "others": partial(_others, network, root, counts, progress),
        "cost": partial(cost.rows, network, torch.get_num_threads()),
    }
    return [row for part in parts for row in measured[part]()]


def _sizes(sets: Frames) -> dict[str, int]:
    return {name: len(frames) for name, frames in sets.items()}


def _depth(network: nn.Module, kitti: Frames, rooms: Frames, progress: Progress) -> list[Row]:
    scores = depth.score(network, kitti, progress, "KITTI depth")
    rows = depth.kitti_rows(scores, _sizes(kitti))
    return rows + depth.room_rows(depth.score(network, rooms, progress, "rooms"), _sizes(rooms))


def _others(network: nn.Module, root: Path, counts: Counts, progress: Progress) -> list[Row]:
    sets = depth.held_out_sets(readers.cut(readers.other_lidars(root), counts.depth))
    return depth.held_out_rows(depth.score(network, sets, progress, "other LiDARs"), _sizes(sets))


def _registration(network: nn.Module, root: Path, counts: Counts, progress: Progress) -> list[Row]:
    methods, rows = classical.methods(), []
    streets = readers.spread(readers.lidar_pairs(root), counts.lidar)
    rooms = readers.spread(readers.room_pairs(root), counts.rooms)
    for name, frames, most_px in (
        ("KITTI", streets, registration.LIDAR_SHIFT_PX),
        ("rooms", rooms, registration.ROOM_SHIFT_PX),
    ):
        for kind, shares in (("large", registration.LARGE), ("any size", registration.ANY)):
            samples = registration.known_affines(frames, most_px, shares, counts.draws)
            compared = min(counts.compared, len(frames)) if shares == registration.LARGE else 0
            what, of = f"{name}, {kind}", f"{len(frames)} frames x {counts.draws}"
            doing = f"registration, {what}"
            errors = registration.measure(network, samples, progress, doing, methods, compared, frames)
            rows += [*registration.rows_of(errors, what, 2.5, 1.0, of), registration.consistency(errors, what, of)]
            if compared:
                rows.append(registration.beside_classical(errors, what, compared))
    samples = registration.rendered(counts.rendered)
    errors = registration.measure(network, samples, progress, "registration, rendered", {})
    return rows + registration.rows_of(errors, "rendered", 1.0, 0.3, f"{len(samples)} frames")


def _cameras(network: nn.Module, root: Path, counts: Counts, progress: Progress) -> list[Row]:
    rows = []
    for name, pairs, judged in (
        ("kitti_odom_04", second_camera.kitti_pairs(root), "correlation with the grey image"),
        ("realsense_f200_apc", second_camera.realsense_pairs(root), "colour's gradients at depth's edges"),
    ):
        found = second_camera.measure(network, pairs[: counts.pairs], progress, f"second camera, {name}")
        rows += second_camera.rows(found, name, judged)
    return rows


def _colour(network: nn.Module, root: Path, kitti: Frames, counts: Counts, progress: Progress) -> list[Row]:
    frames = readers.spread([*kitti[readers.OFFICIAL], *kitti[readers.DERIVED]], counts.colours)
    others = readers.spread(readers.lidar_pairs(root)[6:], counts.colours)  # other drives
    others = [others[index % len(others)] for index in range(len(frames))]
    return colour.rows(colour.measure(network, frames, others, progress))


def kinds_to_draw(root: Path) -> dict[str, Measurement]:
    """One frame of each kind, misaligned where nothing else is to be seen."""
    depths = readers.kitti_depth(root) | readers.indoor_depth(root)
    held_out = depth.held_out_sets(readers.other_lidars(root))
    kinds = {name: frames[0] for name, frames in (depths | held_out).items()}
    streets, rooms = readers.lidar_pairs(root), readers.room_pairs(root)
    kinds["motorway"] = streets[1]
    for frames, most_px in (([streets[0], streets[5], streets[7]], 24.0), (rooms, registration.ROOM_SHIFT_PX)):
        for sample in registration.known_affines(frames, most_px, registration.LARGE, 1):
            kinds[f"misaligned {sample['name'][0]}"] = sample
    kinds["second camera, kitti_odom_04"] = second_camera.kitti_pairs(root)[0].sample
    kinds["second camera, realsense"] = second_camera.realsense_pairs(root)[0].sample
    return kinds


def write(rows: Sequence[Row], json_path: Path, **context: object) -> None:
    """The numbers as JSON, and beside it as Markdown."""
    json_path.parent.mkdir(parents=True, exist_ok=True)
    write_json(rows, json_path, **context)
    json_path.with_suffix(".md").write_text(markdown(rows), encoding="utf-8")


def _progress(items: Sequence, doing: str) -> Iterable:
    return track(items, doing, console=Console(stderr=True), transient=True)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="file for the numbers; Markdown goes beside it")
    parser.add_argument("--out", type=Path, help="folder for pictures; none without")
    parser.add_argument("--checkpoint", type=Path, default=RELEASED, help="weights; the released ones where not given")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="rows to fill in")
    parser.add_argument("--threads", type=int, default=2, help="of PyTorch, for all that is timed too")
    return parser.parse_args(arguments)


def main() -> None:
    """Measure, print, write and draw."""
    options = parse()
    root = Path(os.environ.get("DEPTHREG_REAL_DATA", Path(__file__).resolve().parents[2] / "shared/real"))
    missing = [name for name in readers.FOLDERS if not (root / name).is_dir()]
    if missing:
        sys.exit(
            f"bars.py: no real frames in {root / missing[0]}: set DEPTHREG_REAL_DATA to the folder that holds them"
        )
    try:
        network = load_network(options.checkpoint)
    except InputError as error:
        sys.exit(f"bars.py: {error}")
    torch.set_num_threads(options.threads)
    counts, start, name = Counts(), time.perf_counter(), options.checkpoint.name
    rows = measure(network, root, options.parts, counts, _progress)
    seconds = time.perf_counter() - start
    print_table(rows)
    print(f"{name}; {options.threads} threads, {seconds / 60:.1f} minutes; seed {registration.SEED}; {counts}")
    context: Mapping[str, object] = {"weights": name, "threads": options.threads, "counts": vars(counts)}
    write(rows, options.json, **context)
    if options.out:
        pictures.draw(network, kinds_to_draw(root), options.out, _progress)


if __name__ == "__main__":
    main()
