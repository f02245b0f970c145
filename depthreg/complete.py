"""`depthreg complete`: align and complete a user's own files, one pair or two folders of pairs."""

import argparse
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from depthreg import view
from depthreg.checkpoint import find_checkpoint
from depthreg.data import io
from depthreg.errors import ArgumentParser, InputError
from depthreg.model import MIN_SIDE_PX, load


class Pair(NamedTuple):
    """Two files of one moment."""

    stem: str
    rgb: Path
    depth: Path


def main(argv: Sequence[str]) -> int:
    """Run the command: every input is checked before the network is loaded and before anything is written."""
    args = _parse(argv)
    io.check_new_folder(args.out)
    view.check(args.view, args.rrd)
    pairs = find_pairs(args.rgb, args.depth)
    intrinsics = None if args.intrinsics is None else io.read_intrinsics(args.intrinsics)
    device = _choose_device(args.device)
    checkpoint = find_checkpoint(args.checkpoint)
    for pair in pairs:
        read_pair(pair, args.depth_scale)
    model = load(checkpoint, device)

    facts = []
    with io.atomic_folder(args.out) as folder, view.open_log(args.view, args.rrd) as log:
        for pair in _progress(pairs):
            rgb, depth_m = read_pair(pair, args.depth_scale)
            start = time.perf_counter()
            result = model(rgb, depth_m, intrinsics)
            seconds = time.perf_counter() - start
            result.save(folder / pair.stem if args.rgb.is_dir() else folder, args.depth_scale)
            if log:
                log.log(pair.stem, result)
            facts.append({"seconds": seconds, **result.describe()})
    Console().print(_summary(facts, args.out, args.depth_scale, checkpoint))
    return 0


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="depthreg complete",
        description="Align colour with sparse depth and complete the depth.",
        epilog="Writes depth.npy (metres), depth.png, confidence.png, rgb_aligned.png, affine.json, panel.png and, "
        "with --intrinsics, cloud.ply. RGB and DEPTH may be two folders of files of the same names: then each "
        "pair gets a subfolder.",
    )
    add = parser.add_argument
    add("rgb", type=Path, metavar="RGB", help="PNG or JPEG, or a folder of them")
    add(
        "depth",
        type=Path,
        metavar="DEPTH",
        help="16-bit PNG, TIFF, EXR, NPY or NPZ (0 or NaN = none), or a folder",
    )
    scale_help = "stored value per metre: 256 for KITTI, 1000 for millimetres, 1 for metres"
    add("--depth-scale", type=float, required=True, metavar="S", help=scale_help)
    add("--intrinsics", type=Path, metavar="K.txt", help="text file with the 9 numbers of the camera's K")
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="new or empty folder; appears whole or not at all",
    )
    add(
        "--checkpoint",
        type=Path,
        metavar="CKPT",
        help="weights, of any stage of `depthreg train`; by default the newest in runs/",
    )
    add("--device", metavar="NAME", help="cpu, cuda, cuda:1, ...; a GPU by default where there is one")
    add("--view", action="store_true", help="open Rerun and show each frame: pictures and, with K, the cloud")
    add("--rrd", type=Path, metavar="FILE.rrd", help="save that for later: `rerun FILE.rrd` shows it")
    return parser.parse_args(argv)


def _choose_device(name: str | None) -> torch.device:
    """The device of that name, or a GPU where none is named and one is there."""
    try:
        device = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # PyTorch without CUDA asserts
        raise InputError(f"--device {name} can't be used here: cpu, or a GPU of this machine, was expected") from error
    return device


def find_pairs(rgb: Path, depth: Path) -> list[Pair]:
    """The pair of two files, or the pairs of two folders by their files' names without suffix, sorted.

    Raises:
        InputError: One file and one folder, an empty folder, or a file without exactly one partner.
    """
    if rgb.is_dir() != depth.is_dir():
        raise InputError(f"{rgb} and {depth} must be two files or two folders")
    if not rgb.is_dir():
        return [Pair(rgb.stem, rgb, depth)]
    rgb_of_stem, depth_of_stem = _by_stem(rgb, io.RGB_SUFFIXES), _by_stem(depth, io.DEPTH_SUFFIXES)
    for ours, other_folder, others in (
        (rgb_of_stem, depth, depth_of_stem),
        (depth_of_stem, rgb, rgb_of_stem),
    ):
        alone = [path for stem, path in ours.items() if stem not in others]
        if alone:
            raise InputError(f"{alone[0]} has no partner of the same name in {other_folder} ({len(alone)} without one)")
    return [Pair(stem, path, depth_of_stem[stem]) for stem, path in sorted(rgb_of_stem.items())]


def _by_stem(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The files of these kinds in a folder; hidden ones are left out."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.stem in found:
            raise InputError(f"{found[path.stem]} and {path} have one name: one file of each name was expected")
        found[path.stem] = path
    if not found:
        raise InputError(f"{folder} holds no file of a known kind: {', '.join(suffixes)} were expected")
    return found


def read_pair(pair: Pair, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) uint8 and depth (H, W) metres of a pair; `scale` is the depth file's stored value per metre.

    Raises:
        InputError: A file that can't be used, sizes that differ, or pictures that are too small.
    """
    rgb, depth_m = io.read_rgb(pair.rgb), io.read_depth_m(pair.depth, scale)
    rgb_size, depth_size = (f"{array.shape[1]}x{array.shape[0]}" for array in (rgb, depth_m))
    if rgb_size != depth_size:
        raise InputError(f"{pair.rgb} is {rgb_size} but {pair.depth} is {depth_size}: one size was expected")
    if min(depth_m.shape) < MIN_SIDE_PX:
        raise InputError(f"{pair.rgb} is {rgb_size}: at least {MIN_SIDE_PX}x{MIN_SIDE_PX} was expected")
    return rgb, depth_m


def _progress(pairs: Sequence[Pair]) -> Iterable[Pair]:
    return track(pairs, "Completing", console=Console(stderr=True), transient=True, disable=len(pairs) == 1)


def _summary(facts: Sequence[dict[str, float]], out: Path, scale: float, checkpoint: Path) -> Table:
    """A few lines for the terminal: of one pair, or the medians of several."""
    middle = {key: float(np.median([fact[key] for fact in facts])) for key in facts[0]}
    title = f"{out}" if len(facts) == 1 else f"{out}: {len(facts)} pairs, medians"
    table = Table(title=title, title_justify="left", show_header=False, box=None)
    rows = {
        "input": "{width:.0f}x{height:.0f}, {returns_percent:.1f} % of pixels with a return",
        "colour was off by": "({x_px:+.1f}, {y_px:+.1f}) px, {rotation_deg:+.2f} deg, {scale_percent:+.2f} %",
        "trust in that": "{trust:.2f} of 1",
        "depth": "{nearest_m:.2f} to {farthest_m:.2f} m",
        "network": "{seconds:.2f} s",
    }
    for name, text in rows.items():
        table.add_row(name, text.format(**middle))
    table.add_row("weights", str(checkpoint))
    longest_m = np.iinfo(np.uint16).max / scale
    if max(fact["farthest_m"] for fact in facts) > longest_m:
        table.add_row("depth.png", f"ends at {longest_m:.2f} m at this scale; depth.npy has it all")
    return table
