"""Reading a user's colour, depth and intrinsics, and writing results that appear whole or not at all.

What a user gives is checked here, once: whatever is wrong with a file becomes an `InputError` that names it.
"""

import json
import os
import re
import shutil
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from depthreg.data.memory import MemoryFile
from depthreg.errors import InputError

RGB_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".npy", ".npz")
_MAX_UINT16 = np.iinfo(np.uint16).max


def read_rgb(path: Path) -> np.ndarray:
    """Read a PNG or JPEG as (H, W, 3) uint8 RGB: grey is expanded, 16 bits become 8, alpha is dropped."""
    _check_suffix(path, RGB_SUFFIXES, "colour image")
    return cv2.cvtColor(_decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_depth_m(path: Path, scale: float) -> np.ndarray:
    """Read a depth map in metres, (H, W) float32, 0 = no return.

    Args:
        path: 16-bit PNG, TIFF (integer or float), EXR (one channel, or one named Z), NPY or NPZ (one
            array, or one named depth). NaN counts as no return.
        scale: Stored value per metre: 256 for KITTI, 1000 for millimetres, 1 for metres.

    Raises:
        InputError: Unreadable, 8-bit values, several channels, a negative or infinite depth, or no return.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the depth scale must be a positive number of stored units per metre, got {scale}")
    _check_suffix(path, DEPTH_SUFFIXES, "depth map")
    stored = _read_stored_depth(path)
    if stored.ndim == 3 and stored.shape[-1] == 1:
        stored = stored[..., 0]
    if stored.ndim != 2 or 0 in stored.shape:
        raise InputError(f"{path} holds an array of shape {stored.shape}: one depth channel (H, W) was expected")
    if stored.dtype.kind not in "iuf" or stored.dtype.itemsize < 2:
        raise InputError(f"{path} holds {stored.dtype} values: depth of 16 bits or more, or float, was expected")
    with np.errstate(over="ignore"):  # what overflows is infinite, and refused as such
        depth_m = np.nan_to_num(stored / np.float64(scale), nan=0.0, posinf=np.inf, neginf=-np.inf).astype(np.float32)
    if np.isinf(depth_m).any() or (depth_m < 0).any():
        raise InputError(f"{path} holds negative or infinite depths: positive depths, and 0 for none, were expected")
    if not depth_m.any():
        raise InputError(f"{path} holds no valid return: at least one depth above 0 was expected")
    return depth_m


def read_intrinsics(path: Path) -> np.ndarray:
    """Read K, (3, 3) float32: a text file with its 9 numbers, row by row, parted by spaces or commas.

    Raises:
        InputError: Unreadable file, other than 9 numbers, or no pinhole camera without skew.
    """
    try:
        words = re.split(r"[\s,;\[\]]+", path.read_text(encoding="utf-8").strip(" \t\r\n,;[]"))
        numbers = np.array([float(word) for word in words])
    except OSError as error:
        raise InputError(f"{path} can't be read as intrinsics: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path} must hold the 9 numbers of K and nothing else") from error
    if numbers.size != 9:
        raise InputError(f"{path} must hold the 9 numbers of K, row by row, but holds {numbers.size}")
    intrinsics = numbers.reshape(3, 3)
    form = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=bool)  # where fx, fy, cx and cy stand
    is_pinhole = np.array_equal(intrinsics[~form], [0, 0, 0, 0, 1])
    if not (is_pinhole and np.isfinite(numbers).all() and min(intrinsics[0, 0], intrinsics[1, 1]) > 0):
        raise InputError(f"{path} must hold K as fx 0 cx 0 fy cy 0 0 1 with positive focal lengths")
    return intrinsics.astype(np.float32)


def _check_suffix(path: Path, suffixes: tuple[str, ...], what: str) -> None:
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path} is not a {what} of a known kind: one of {', '.join(suffixes)} was expected")


def _decode(path: Path | MemoryFile, flags: int) -> np.ndarray:
    """Decode an image file; OpenCV's own complaints would only repeat ours, so they are silenced."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        content = path.read_bytes()
        image = None if _is_cut_jpeg(content) else cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except OSError as error:
        raise InputError(f"{path} can't be read: {error.strerror}") from error
    except cv2.error:  # an empty file
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise InputError(f"{path} can't be decoded: an intact {path.suffix[1:].upper()} image was expected")
    return image


def _is_cut_jpeg(content: bytes) -> bool:
    """Whether a JPEG's last scan has no end: OpenCV would paint the missing part grey (ITU-T T.81, B.1.1.3)."""
    return content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9") < content.rfind(b"\xff\xda")


def _read_stored_depth(path: Path) -> np.ndarray:
    """The array as it is stored, whatever its shape and type."""
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        return _read_numpy(path)
    if suffix == ".exr":
        return _read_exr(path)
    return _decode(path, cv2.IMREAD_UNCHANGED)


def _read_numpy(path: Path) -> np.ndarray:
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded as arrays:
            name = arrays.files[0] if len(arrays.files) == 1 else "depth"
            return arrays[name]
    except KeyError as error:
        raise InputError(f"{path} must hold one array, or one named depth, but holds {loaded.files}") from error
    except OSError as error:
        raise InputError(f"{path} can't be read: {error.strerror or error}") from error
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path} can't be decoded: an intact {path.suffix[1:].upper()} of numbers was expected"
        ) from error


def _read_exr(path: Path) -> np.ndarray:
    try:
        openexr = import_module("OpenEXR")  # OpenCV's wheels have no EXR reader since 5.0
    except ImportError as error:
        raise InputError(f"{path} needs the OpenEXR package: install it with `pip install OpenEXR`") from error
    if not path.is_file():
        raise InputError(f"{path} can't be read: no such file")
    try:
        with openexr.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, OSError) as error:
        raise InputError(f"{path} can't be decoded: an intact EXR image was expected") from error
    name = next(iter(channels)) if len(channels) == 1 else "Z"
    if name not in channels:
        raise InputError(f"{path} must hold one channel, or one named Z, but holds {sorted(channels)}")
    return channels[name]


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` (same suffix) that becomes `path` if the block ends well."""
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_folder(path: Path) -> None:
    """Remove a folder of files, where it is there."""
    if path.exists():
        shutil.rmtree(path)


def check_new_folder(path: Path, ignore_hidden: bool = False) -> None:
    """Raise `InputError` unless `path` is an empty folder or can become one: nobody's files get lost."""
    if path.is_dir() and any(not (ignore_hidden and child.name.startswith(".")) for child in path.iterdir()):
        raise InputError(f"{path} isn't empty: a new or an empty folder was expected")
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise InputError(f"{path} can't be made a folder, since {nearest} is a file")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"{path} can't be written: {nearest} is write-protected")


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path`, a new or an empty folder, if the block ends well.

    Raises:
        InputError: `path` isn't empty, or it can't be written.
    """
    check_new_folder(path)
    path = path.absolute()
    # An empty folder of the user's own is filled, not replaced: it may be a mount point.
    home = path if path.is_dir() else path.parent
    staging = home / f".{path.name}.{uuid.uuid4().hex[:8]}"
    try:
        staging.mkdir(parents=True)
        yield staging
        if home == path:
            for child in staging.iterdir():
                child.rename(path / child.name)
        else:
            staging.rename(path)
    except OSError as error:
        raise InputError(f"{path} can't be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write RGB (H, W, 3) uint8, or one channel (H, W) of uint8 or uint16."""
    stored = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    with atomic_write(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", stored)[1].tobytes())


def write_depth_png(path: Path, depth_m: np.ndarray, scale: float) -> None:
    """Write (H, W) metres as a 16-bit PNG of `scale` stored units per metre, rounded.

    16 bits end at 65535 / scale metres (256 m for KITTI's 256): depths beyond that are stored as 65535.
    """
    stored = np.rint(depth_m.astype(np.float64) * scale)
    write_png(path, np.clip(stored, 0, _MAX_UINT16).astype(np.uint16))


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write one array, without pickling."""
    with atomic_write(path) as temporary:
        np.save(temporary, array, allow_pickle=False)


def write_json(path: Path, content: Any) -> None:
    """Write indented, strict JSON (NaN is refused)."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path | MemoryFile) -> Any:
    """Read a JSON file.

    Raises:
        InputError: Unreadable, or no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} can't be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"{path} can't be decoded: intact JSON was expected") from error


def read_png(path: Path | MemoryFile) -> np.ndarray:
    """Read a PNG as it is stored: (H, W, 3) RGB or (H, W), of uint8 or uint16."""
    stored = _decode(path, cv2.IMREAD_UNCHANGED)
    return cv2.cvtColor(stored, cv2.COLOR_BGR2RGB) if stored.ndim == 3 else stored


def write_ply(path: Path, points_m: np.ndarray, rgb: np.ndarray) -> None:
    """Write a coloured point cloud as binary PLY: points (N, 3) in metres, colours (N, 3) uint8."""
    position, colour = ("x", "y", "z"), ("red", "green", "blue")
    vertices = np.empty(len(points_m), [(name, "<f4") for name in position] + [(name, "u1") for name in colour])
    for names, columns in ((position, points_m), (colour, rgb)):
        for name, column in zip(names, columns.T, strict=True):
            vertices[name] = column
    write_ply_vertices(path, vertices)


_PLY_TYPES = {"float": "<f4", "uchar": "|u1", "short": "<i2"}


def write_ply_vertices(path: Path, vertices: np.ndarray) -> None:
    """Write a structured array (N,) of float32, uint8 or int16 fields as binary PLY, a property for each field."""
    names = {stored: name for name, stored in _PLY_TYPES.items()}
    fields = cast(dict[str, tuple[np.dtype, int]], vertices.dtype.fields)
    properties = [f"property {names[kind.str]} {name}" for name, (kind, _) in fields.items()]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *properties,
        "end_header",
    ]
    with atomic_write(path) as temporary:
        temporary.write_bytes("\n".join([*lines, ""]).encode() + vertices.tobytes())


def read_ply_vertices(path: Path | MemoryFile) -> np.ndarray:
    """Read what `write_ply_vertices` wrote, as a structured array (N,).

    Raises:
        InputError: Unreadable, cut off, or of another layout.
    """
    try:
        header, _, content = path.read_bytes().partition(b"end_header\n")
        words = [line.split() for line in header.decode("ascii").splitlines()]
        dtype = np.dtype([(line[2], _PLY_TYPES[line[1]]) for line in words if line[0] == "property"])
        (count,) = (int(line[2]) for line in words if line[:2] == ["element", "vertex"])
        if words[1][1] != "binary_little_endian" or len(content) != count * dtype.itemsize:
            raise ValueError
        return np.frombuffer(content, dtype)
    except OSError as error:
        raise InputError(f"{path} can't be read: {error.strerror}") from error
    except (ValueError, LookupError) as error:
        raise InputError(f"{path} can't be decoded: an intact binary PLY of one vertex list was expected") from error
