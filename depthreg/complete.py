"""`depthreg complete`: align and complete a user's own files, a pair, two folders of pairs, or a recording."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from depthreg import view
from depthreg.checkpoint import RELEASED
from depthreg.data import io
from depthreg.data.recordings import KINDS, Recording, Settings, open_pairs, open_recording
from depthreg.errors import ArgumentParser, InputError
from depthreg.model import load
from depthreg.rig_page import describe
from depthreg.series import Outcome, check_folder, claim_folder, complete_series, fingerprint, write_rig

SKIPPED = 3  # exit status where some frames couldn't be used


def main(argv: Sequence[str]) -> int:
    """Run the command: what can be checked is checked before the network is loaded and before anything is written."""
    args = _parse(argv)
    view.check(args.view, args.rrd)
    if args.depth is None or args.rgb.is_dir():
        return _complete_series(args)
    _complete_pair(args)
    return 0


def _complete_pair(args: argparse.Namespace) -> None:
    """Two files: the results appear all at once or not at all."""
    io.check_new_folder(args.out)
    (frame,) = open_pairs(args.rgb, args.depth, args.depth_scale).frames
    intrinsics = _read_intrinsics(args)
    device = _choose_device(args.device)
    rgb, depth_m, _ = frame.read()
    model = load(args.checkpoint, device)
    with io.atomic_folder(args.out) as folder, view.open_log(args.view, args.rrd) as log:
        start = time.perf_counter()
        result = model(rgb, depth_m, intrinsics)
        seconds = time.perf_counter() - start
        result.save(folder, args.depth_scale)
        if log:
            log.log(frame.name, result)
    Console().print(_pair_summary({"seconds": seconds, **result.describe()}, args, args.checkpoint))


def _complete_series(args: argparse.Namespace) -> int:
    """A recording, or two folders: each frame's results appear by themselves, and what is there is not made again."""
    check_folder(args.out)
    recording = _open(args)
    intrinsics = _read_intrinsics(args)
    device = _choose_device(args.device)
    model = load(args.checkpoint, device)
    made_with = {
        "files": [str(path.absolute()) for path in (args.rgb, args.depth) if path],
        "--depth-scale": recording.depth_scale,
        "--intrinsics": None if intrinsics is None else intrinsics.tolist(),
        "--rgb-topic": args.rgb_topic,
        "--depth-topic": args.depth_topic,
        "weights": fingerprint(model),
    }
    claim_folder(args.out, made_with)
    with view.open_log(args.view, args.rrd) as log:
        outcome = complete_series(model, recording, args.out, args.batch_size, intrinsics, log)
    Console().print(_series_summary(outcome, recording, args.out, args.checkpoint))
    return SKIPPED if outcome.failed else 0


def _open(args: argparse.Namespace) -> Recording:
    if args.depth is not None:
        recording = open_pairs(args.rgb, args.depth, args.depth_scale)
    else:
        recording = open_recording(args.rgb, Settings(args.depth_scale, args.rgb_topic, args.depth_topic))
    return replace(recording, frames=recording.frames[:: args.every])


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    kinds = "; ".join(f"{kind.name} ({kind.holds})" for kind in KINDS)
    parser = ArgumentParser(
        prog="depthreg complete",
        description="Align colour with sparse depth and complete the depth: of two files, of two folders of files of "
        "the same names, or of a recording.",
        epilog="Writes depth.npy (metres), depth.png, confidence.png, rgb_aligned.png, affine.json, panel.png and, "
        "where K is known, cloud.ply; for folders and recordings, a subfolder for each frame, and rig.json and "
        "rig.html on how the sensors are aligned. The same command goes on where it was stopped. Exit status 3: some "
        f"frames could not be used and were left out. Recordings: {kinds}.",
    )
    add = parser.add_argument
    add("rgb", type=Path, metavar="RGB|RECORDING", help="PNG or JPEG, a folder of them, or a recording")
    depth_help = "16-bit PNG, TIFF, EXR, NPY or NPZ (0 or NaN = none), or a folder; not with a recording"
    add("depth", type=Path, nargs="?", metavar="DEPTH", help=depth_help)
    scale_help = "stored value per metre: 256 for KITTI, 1000 for millimetres, 1 for metres; recordings have their own"
    add("--depth-scale", type=_scale, metavar="S", help=scale_help)
    intrinsics_help = "text file with the 9 numbers of the camera's K; recordings may have their own"
    add("--intrinsics", type=Path, metavar="K.txt", help=intrinsics_help)
    out_help = "new or empty folder, or one of this very command that was stopped"
    add("--out", type=Path, required=True, metavar="DIR", help=out_help)
    checkpoint_help = "weights, of any stage of `depthreg train`; by default the released ones"
    add("--checkpoint", type=Path, default=RELEASED, metavar="CKPT", help=checkpoint_help)
    add("--device", metavar="NAME", help="cpu, cuda, cuda:1, ...; a GPU by default where there is one")
    add("--batch-size", type=_positive, default=1, metavar="N", help="frames at a time (default 1)")
    add("--every", type=_positive, default=1, metavar="N", help="only every N-th frame")
    add("--rgb-topic", metavar="TOPIC", help="of a ROS bag that has several for colour")
    add("--depth-topic", metavar="TOPIC", help="of a ROS bag that has several for depth")
    add("--view", action="store_true", help="open Rerun and show each frame: pictures and, with K, the cloud")
    add("--rrd", type=Path, metavar="FILE.rrd", help="save that for later: `rerun FILE.rrd` shows it")
    args = parser.parse_args(argv)
    if args.depth is not None and args.depth_scale is None:
        parser.error("--depth-scale is required with RGB and DEPTH: the stored value per metre was expected")
    return args


def _positive(text: str) -> int:
    if not (text.isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"a whole number of at least 1 was expected, got {text}")
    return int(text)


def _scale(text: str) -> float:
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if not (np.isfinite(scale) and scale > 0):
        message = f"the depth scale must be a positive number of stored units per metre, got {text}"
        raise argparse.ArgumentTypeError(message)
    return scale


def _read_intrinsics(args: argparse.Namespace) -> np.ndarray | None:
    return None if args.intrinsics is None else io.read_intrinsics(args.intrinsics)


def _choose_device(name: str | None) -> torch.device:
    """The device of that name, or a GPU where none is named and one is there."""
    try:
        device = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:  # PyTorch without CUDA asserts
        raise InputError(f"--device {name} can't be used here: cpu, or a GPU of this machine, was expected") from error
    return device


def _pair_summary(facts: dict[str, float], args: argparse.Namespace, checkpoint: Path) -> Table:
    """A few lines for the terminal."""
    table = _table(str(args.out))
    rows = {
        "input": "{width:.0f}x{height:.0f}, {returns_percent:.1f} % of pixels with a return",
        "colour was off by": "({x_px:+.1f}, {y_px:+.1f}) px, {rotation_deg:+.2f} deg, {scale_percent:+.2f} %",
        "trust in that": "{trust:.2f} of 1",
        "depth": "{nearest_m:.2f} to {farthest_m:.2f} m",
        "network": "{seconds:.2f} s",
    }
    for name, text in rows.items():
        table.add_row(name, text.format(**facts))
    table.add_row("weights", str(checkpoint))
    longest_m = np.iinfo(np.uint16).max / args.depth_scale
    if facts["farthest_m"] > longest_m:
        table.add_row("depth.png", f"ends at {longest_m:.2f} m at this scale; depth.npy has it all")
    return table


def _series_summary(outcome: Outcome, recording: Recording, out: Path, checkpoint: Path) -> Table:
    """What became of the frames, and what they say about the rig, which is written too."""
    table = _table(str(out))
    frames = [f"{outcome.made} completed"]
    if outcome.kept:
        frames.append(f"{outcome.kept} were there already")
    if outcome.failed:
        frames.append(f"{outcome.failed} could not be used and were left out")
    table.add_row("frames", ", ".join(frames))
    if recording.unpaired:
        table.add_row("no partner for", f"{recording.unpaired} images of the recording")
    if outcome.made:
        table.add_row("speed", f"{outcome.made / outcome.seconds:.2f} frames/s")
    rig = write_rig(recording, out)
    if rig:
        for name, text in zip(("rig", "", ""), describe(*rig), strict=True):
            table.add_row(name, text)
        table.add_row("over time", str(out / "rig.html"))
    else:
        table.add_row("rig", "no summary: results of one size were expected")
    table.add_row("weights", str(checkpoint))
    return table


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", show_header=False, box=None)
