"""`depthreg complete`: align and complete a user's own files, one pair or two folders of pairs."""

import argparse
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor, nn

from depthreg.checkpoint import find_checkpoint, load_network
from depthreg.data import io
from depthreg.data.sample import Measurement
from depthreg.errors import ArgumentParser, InputError
from depthreg.geometry import decompose_affine, unproject, warp_affine
from depthreg.networks import JointOutput
from depthreg.viz import sample_panel, to_picture

MIN_SIDE_PX = 64  # the smallest picture that the network takes


class Pair(NamedTuple):
    """Two files of one moment."""

    stem: str
    rgb: Path
    depth: Path


def main(argv: Sequence[str]) -> int:
    """Run the command: every input is checked before the network is loaded and before anything is written."""
    args = _parse(argv)
    io.check_new_folder(args.out)
    pairs = find_pairs(args.rgb, args.depth)
    intrinsics = None if args.intrinsics is None else io.read_intrinsics(args.intrinsics)
    device = _choose_device(args.device)
    checkpoint = find_checkpoint(args.checkpoint)
    for pair in pairs:
        read_pair(pair, args.depth_scale)
    network = load_network(checkpoint).to(device).eval()

    facts = []
    with io.atomic_folder(args.out) as folder:
        for pair in _progress(pairs):
            sample = read_pair(pair, args.depth_scale, intrinsics)
            start = time.perf_counter()
            output = complete(network, sample["rgb"], sample["depth_m"])
            seconds = time.perf_counter() - start
            write_results(folder / pair.stem if args.rgb.is_dir() else folder, sample, output, args.depth_scale)
            facts.append({"seconds": seconds, **_describe(sample["depth_m"], output)})
    Console().print(_summary(facts, args.out, args.depth_scale, checkpoint))
    return 0


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="depthreg complete",
        description="Align colour with sparse depth and complete the depth.",
        epilog="Writes depth.npy (metres), depth.png, rgb_aligned.png, affine.json, panel.png and, with "
        "--intrinsics, cloud.ply. RGB and DEPTH may be two folders of files of the same names: then each "
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


def read_pair(pair: Pair, scale: float, intrinsics: np.ndarray | None = None) -> Measurement:
    """Read a pair as a batch of one; `scale` is the depth file's stored value per metre.

    Raises:
        InputError: A file that can't be used, sizes that differ, or pictures that are too small.
    """
    rgb, depth_m = io.read_rgb(pair.rgb), io.read_depth_m(pair.depth, scale)
    rgb_size, depth_size = (f"{array.shape[1]}x{array.shape[0]}" for array in (rgb, depth_m))
    if rgb_size != depth_size:
        raise InputError(f"{pair.rgb} is {rgb_size} but {pair.depth} is {depth_size}: one size was expected")
    if min(depth_m.shape) < MIN_SIDE_PX:
        raise InputError(f"{pair.rgb} is {rgb_size}: at least {MIN_SIDE_PX}x{MIN_SIDE_PX} was expected")
    sample = Measurement(
        rgb=torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255,
        depth_m=torch.from_numpy(depth_m)[None, None],
        name=[pair.stem],
    )
    if intrinsics is not None:
        sample["intrinsics"] = torch.from_numpy(intrinsics)[None]
    return sample


def _progress(pairs: Sequence[Pair]) -> Iterable[Pair]:
    return track(pairs, "Completing", console=Console(stderr=True), transient=True, disable=len(pairs) == 1)


@torch.inference_mode()
def complete(network: nn.Module, rgb: Tensor, depth_m: Tensor) -> JointOutput:
    """Align colour with depth and complete the depth.

    Args:
        network: Any of `depthreg.networks` in evaluation mode, on whatever device.
        rgb: Colour in [0, 1], (B, 3, H, W).
        depth_m: Sparse z-depth, (B, 1, H, W) metres, 0 = none.

    Returns:
        The network's output on the CPU, without `matches`, which only training needs.
    """
    device = next(network.parameters()).device
    output = network(rgb.to(device), depth_m.to(device))
    tensors: dict[str, Any] = {name: part.cpu() for name, part in output._asdict().items() if isinstance(part, Tensor)}
    return output._replace(matches=[], **tensors)


def write_results(folder: Path, sample: Measurement, output: JointOutput, scale: float) -> None:
    """Write into a folder, made if need be, all that `depthreg complete` writes for a batch of one."""
    folder.mkdir(exist_ok=True)
    completed_m = output.depth_m[0, 0].numpy()
    height, width = completed_m.shape
    affine = output.affine_rgb_from_depth[0].tolist()
    io.write_npy(folder / "depth.npy", completed_m)
    io.write_depth_png(folder / "depth.png", completed_m, scale)
    io.write_png(folder / "rgb_aligned.png", to_picture(output.rgb_aligned[0]))
    io.write_json(folder / "affine.json", {"affine_rgb_from_depth": affine, "width": width, "height": height})
    io.write_png(folder / "panel.png", sample_panel(sample["rgb"], sample["depth_m"], output))
    if "intrinsics" in sample:
        io.write_ply(folder / "cloud.ply", *colored_cloud(sample, output))


def colored_cloud(sample: Measurement, output: JointOutput) -> tuple[np.ndarray, np.ndarray]:
    """The completed depth as points, where it has a colour and can be believed.

    Believable is what lies between the returns: inside their convex hull in the image and within their range
    of depths, give or take 5 %. The sky above a LiDAR's highest beam is not.

    Args:
        sample: A batch of one, with intrinsics.
        output: What the network made of it.

    Returns:
        Points (N, 3) float32 in camera coordinates, metres, and their colours (N, 3) uint8.
    """
    sparse_m, completed_m = sample["depth_m"][0, 0], output.depth_m[0, 0]
    returns_m = sparse_m[sparse_m > 0]
    in_range = (completed_m >= 0.95 * returns_m.min()) & (completed_m <= 1.05 * returns_m.max())
    _, seen = warp_affine(sample["rgb"], output.affine_rgb_from_depth)
    kept = (seen[0, 0] & in_range).numpy() & _hull(sparse_m.numpy() > 0)
    points_m = unproject(completed_m, sample["intrinsics"][0]).numpy()
    return points_m[kept], to_picture(output.rgb_aligned[0])[kept]


def _hull(mask: np.ndarray) -> np.ndarray:
    """The convex hull of a mask's pixels, (H, W) bool."""
    corners = cv2.convexHull(cv2.findNonZero(mask.astype(np.uint8)))
    return cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), corners, 1) > 0


def _describe(depth_m: Tensor, output: JointOutput) -> dict[str, float]:
    """What happened to one sample, in numbers."""
    height, width = depth_m.shape[-2:]
    moves = decompose_affine(output.affine_rgb_from_depth[0], (height, width))
    x_px, y_px = moves["translation_px"].tolist()
    return {
        "width": width,
        "height": height,
        "returns_percent": 100 * (depth_m > 0).float().mean().item(),
        "x_px": x_px,
        "y_px": y_px,
        "rotation_deg": moves["rotation_deg"].item(),
        "scale_percent": 100 * (moves["scale"].item() - 1),
        "nearest_m": output.depth_m.min().item(),
        "farthest_m": output.depth_m.max().item(),
    }


def _summary(facts: Sequence[dict[str, float]], out: Path, scale: float, checkpoint: Path) -> Table:
    """A few lines for the terminal: of one pair, or the medians of several."""
    middle = {key: float(np.median([fact[key] for fact in facts])) for key in facts[0]}
    title = f"{out}" if len(facts) == 1 else f"{out}: {len(facts)} pairs, medians"
    table = Table(title=title, title_justify="left", show_header=False, box=None)
    rows = {
        "input": "{width:.0f}x{height:.0f}, {returns_percent:.1f} % of pixels with a return",
        "colour was off by": "({x_px:+.1f}, {y_px:+.1f}) px, {rotation_deg:+.2f} deg, {scale_percent:+.2f} %",
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
