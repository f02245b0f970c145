"""From two uploaded files to what a page shows of them; whatever can't be used becomes one sentence."""

import shutil
import tempfile
import warnings
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

from depthreg.data import io
from depthreg.demonstration.examples import Example
from depthreg.errors import InputError
from depthreg.geometry import corner_errors_px
from depthreg.model import Model
from depthreg.result import Result
from depthreg.viz import depth_limits_m, depth_tile, edges_overlay, error_with_bar

MAX_PIXELS = 4_000_000  # twice of full HD; what a network needs grows with it
DEPTH_SUFFIXES = tuple(suffix for suffix in io.DEPTH_SUFFIXES if suffix != ".exr")  # whose size no header check bounds
_MAX_POINTS = 400_000  # more make a browser slow
_SHOWN_MEDIANS = 3  # of depth: the farthest few points would make all others small
_STEP_BACK = 1.25  # from where the camera was: pixels close up, and the cloud is seen to be one
_KEPT_ANSWERS = 8


class Upload(NamedTuple):
    """Files as a user gave them."""

    rgb: Path
    depth: Path
    depth_scale: float  # stored units per metre
    intrinsics: Path | None = None


class CloudView(NamedTuple):
    """A PLY file with y up, and from where to look at it, see `orbit`."""

    path: Path
    camera: tuple[float, float, float]


class Answer(NamedTuple):
    """What a page shows: text, pictures (H, W, 3) uint8, and files."""

    words: str
    before: np.ndarray  # colour as given, with the completed depth's edges
    after: np.ndarray  # colour aligned, with the same edges
    sparse: np.ndarray
    completed: np.ndarray
    expected_error: np.ndarray | None  # None from a network that can't tell
    true_error: np.ndarray | None  # None where the truth isn't known
    cloud: CloudView | None  # None without K
    files: list[Path]


def answer(model: Model, upload: Upload, folder: Path, example: Example | None = None) -> Answer:
    """Align, complete, and draw.

    Args:
        model: Does it.
        upload: What it is given.
        folder: Where files for downloading may be made; those of earlier answers are removed from it.
        example: What these files come from, where the truth is known.

    Raises:
        InputError: The files can't be used; it names them without their folders.
    """
    try:
        result = _complete(model, upload)
    except InputError as error:
        raise InputError(_without_folders(str(error), upload)) from error
    files = _new_folder(folder)
    result.save(files, upload.depth_scale)
    truth_m = None if example is None else example.truth_depth_m
    limits_m = depth_limits_m(result.sparse_depth_m, result.depth_m if truth_m is None else truth_m)
    max_error_m = limits_m[1] / 20  # relative to the scene: both errors have one scale
    expected_m = result.expected_error_m
    return Answer(
        words=in_words(result, example),
        before=edges_overlay(result.rgb, result.depth_m),
        after=edges_overlay(result.rgb_aligned, result.depth_m),
        sparse=depth_tile(result.sparse_depth_m, limits_m, 1),
        completed=depth_tile(result.depth_m, limits_m, 1),
        expected_error=error_with_bar(expected_m, max_error_m) if np.isfinite(expected_m).all() else None,
        true_error=None if truth_m is None else error_with_bar(_error_m(result, truth_m), max_error_m),
        cloud=None if result.K is None else _write_view(result, files.with_name(f"{files.name}.ply")),
        files=sorted(files.iterdir()),
    )


def in_words(result: Result[np.ndarray], example: Example | None = None) -> str:
    """What happened to a frame, as one would say it."""
    facts = result.describe()
    side = "right" if facts["x_px"] > 0 else "left"
    level = "lower" if facts["y_px"] > 0 else "higher"
    sense = "clockwise" if facts["rotation_deg"] > 0 else "anticlockwise"  # y points down
    size = "larger" if facts["scale_percent"] > 0 else "smaller"
    sentences = [
        f"In the colour image, things are {abs(facts['x_px']):.1f} px further to the {side} and "
        f"{abs(facts['y_px']):.1f} px {level} than in the depth, turned by {abs(facts['rotation_deg']):.2f}° {sense} "
        f"and {abs(facts['scale_percent']):.2f} % {size}; the network trusts that at {facts['trust']:.2f} of 1.",
        f"{facts['returns_percent']:.1f} % of {facts['width']}x{facts['height']} pixels had a depth, and now all "
        f"have, from {facts['nearest_m']:.2f} to {facts['farthest_m']:.2f} m.",
    ]
    if example is not None:
        error_m = np.nanmean(_error_m(result, example.truth_depth_m))
        ours, truth = (
            torch.as_tensor(np.asarray(affine, np.float32))[None]
            for affine in (result.affine_rgb_from_depth, example.truth_affine_rgb_from_depth)
        )
        corner_px = corner_errors_px(ours, truth, result.depth_m.shape).mean().item()
        left = f"colour is off by {corner_px:.1f} px at the corners and depth by {error_m:.2f} m"
        sentences.append(f"The truth is known here: now {left}, on average.")
    if result.K is None:
        sentences.append("A cloud needs K, the camera matrix.")
    return "\n".join(sentences)


def _complete(model: Model, upload: Upload) -> Result[np.ndarray]:
    _check_size_in_header(upload.rgb)
    _check_size_in_header(upload.depth)
    rgb, depth_m = io.read_rgb(upload.rgb), io.read_depth_m(upload.depth, upload.depth_scale)
    intrinsics = None if upload.intrinsics is None else io.read_intrinsics(upload.intrinsics)
    if rgb.shape[:2] != depth_m.shape:
        sizes = [f"{shape[1]}x{shape[0]}" for shape in (rgb.shape, depth_m.shape)]
        raise InputError(f"{upload.rgb} is {sizes[0]} but {upload.depth} is {sizes[1]}: one size was expected")
    _check_pixels(upload.rgb, depth_m.size)
    try:
        return model(rgb, depth_m, intrinsics)
    except ValueError as error:  # too small
        raise InputError(str(error)) from error


def _check_size_in_header(path: Path) -> None:
    """Refuse what would fill the memory while it is unpacked, whatever it weighs."""
    if path.suffix.lower() == ".npy":  # as large in memory as it is on disk
        return
    if path.suffix.lower() == ".npz":
        try:
            with zipfile.ZipFile(path) as archive:
                _check_pixels(path, sum(member.file_size for member in archive.infolist()) // 8)
        except (zipfile.BadZipFile, OSError) as error:
            raise InputError(f"{path} can't be decoded: an intact NPZ of numbers was expected") from error
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                width, height = image.size
    except Image.DecompressionBombError:
        width = height = MAX_PIXELS
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{path} can't be decoded: an intact image was expected") from error
    _check_pixels(path, width * height)


def _check_pixels(path: Path, pixels: int) -> None:
    if pixels > MAX_PIXELS:
        raise InputError(f"{path} is too large for this page: at most {MAX_PIXELS / 1e6:g} megapixels were expected")


def _without_folders(sentence: str, upload: Upload) -> str:
    """A sentence as a person should read it who knows files, but not where a server keeps them."""
    for path in (upload.rgb, upload.depth, upload.intrinsics):
        if path is not None:
            sentence = sentence.replace(str(path), path.name)
    return sentence


def _new_folder(parent: Path) -> Path:
    """A folder for an answer's files; the oldest answers go."""
    answers = sorted(parent.glob("answer-*"), key=lambda path: path.stat().st_mtime)
    for old in answers[: -2 * _KEPT_ANSWERS]:  # a folder and a cloud each
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    return Path(tempfile.mkdtemp(prefix="answer-", dir=parent))


def _error_m(result: Result[np.ndarray], truth_m: np.ndarray) -> np.ndarray:
    """How far off the completed depth is, NaN where the truth isn't known."""
    return np.where(truth_m > 0, np.abs(result.depth_m - truth_m), np.nan)


def _write_view(result: Result[np.ndarray], path: Path) -> CloudView:
    """The cloud as viewers of models have it: y up, and not too many points."""
    points_m, rgb = result.point_cloud()
    near = points_m[:, 2] <= _SHOWN_MEDIANS * np.median(points_m[:, 2]) if len(points_m) else slice(0)
    points_m, rgb = points_m[near] * np.array([1, -1, -1], np.float32), rgb[near]
    step = max(1, -(-len(points_m) // _MAX_POINTS))
    io.write_ply(path, points_m[::step], rgb[::step])
    azimuth, inclination, distance = orbit(points_m)
    return CloudView(path, (azimuth, inclination, _STEP_BACK * distance))


def orbit(points_m: np.ndarray) -> tuple[float, float, float]:
    """Where a viewer that turns about the middle of a cloud (N, 3) has to be to see it as the origin does.

    Returns:
        Azimuth from x towards z and inclination from y, in degrees, and the distance.
    """
    if not len(points_m):
        return 90.0, 90.0, 1.0
    x, y, z = -(points_m.min(axis=0) + points_m.max(axis=0)) / 2.0
    distance = float(np.linalg.norm([x, y, z]))
    return float(np.degrees(np.arctan2(z, x))), float(np.degrees(np.arccos(y / distance))), distance
