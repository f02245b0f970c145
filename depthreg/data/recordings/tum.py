"""A recording of the TUM RGB-D benchmark: `rgb.txt` and `depth.txt`, each a time and a file in every line.

Format, depth scale and cameras: J. Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from depthreg.data import io
from depthreg.data.recordings.recording import (
    Kind,
    RecordedFrame,
    Recording,
    Rgbd,
    Settings,
    associate,
    check_frame,
)
from depthreg.errors import InputError

DEPTH_SCALE = 5000.0  # stored value per metre
_CAMERAS = {  # fx, fy, cx, cy of the colour cameras, by the name of the recording
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}


def _is_tum(path: Path) -> bool:
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def _open(path: Path, settings: Settings) -> Recording:
    colours, depths = _read_list(path / "rgb.txt"), _read_list(path / "depth.txt")
    pairs = associate([float(time) for time, _ in colours], [float(time) for time, _ in depths], path)
    scale, intrinsics = settings.depth_scale or DEPTH_SCALE, _intrinsics(path)
    frames = []
    for i, j in pairs:
        time, image = colours[i]
        frames.append(RecordedFrame(time, _reader(image, depths[j][1], scale, intrinsics), float(time)))
    return Recording(frames, scale, len(colours) + len(depths) - 2 * len(pairs))


def _read_list(path: Path) -> list[tuple[str, Path]]:
    """Times as they are written, and files."""
    found: dict[str, Path] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        if len(words) != 2 or not _is_time(words[0]):
            raise InputError(f"{path} holds {line!r} in line {number}: a time in seconds and a file were expected")
        found.setdefault(words[0], path.parent / words[1])
    return list(found.items())


def _is_time(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def _intrinsics(path: Path) -> np.ndarray | None:
    numbers = next((camera for name, camera in _CAMERAS.items() if name in path.absolute().name), None)
    if numbers is None:
        return None
    fx, fy, cx, cy = numbers
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)


def _reader(image: Path, depth: Path, scale: float, intrinsics: np.ndarray | None) -> Callable[[], Rgbd]:
    def read() -> Rgbd:
        return check_frame(Rgbd(io.read_rgb(image), io.read_depth_m(depth, scale), intrinsics), image, depth)

    return read


KIND = Kind("TUM RGB-D", "rgb.txt and depth.txt", _is_tum, _open)
