"""A folder of a RealSense's images with `cam.info.txt` on both cameras: the Amazon Picking Challenge's layout.

Files are `NAME.color.png` with depth in 0.1 mm: already on colour's grid as `NAME.depth.png` or
`NAME.depth_aligned.png`, or as the depth camera saw it in `NAME.depth_raw.png` or `raw/NAME.depth.png`. Layout: A. Zeng
et al., "Multi-view Self-supervised Deep Learning for 6D Pose Estimation in the Amazon Picking Challenge", ICRA 2017.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from depthreg.data import io
from depthreg.data.recordings.projection import reproject_depth
from depthreg.data.recordings.recording import Kind, RecordedFrame, Recording, Rgbd, Settings, check_frame
from depthreg.errors import InputError

DEPTH_SCALE = 10000.0  # stored value per metre
_INFO = "cam.info.txt"
_COLOUR = ".color.png"
_ALIGNED = ("{}.depth_aligned.png", "{}.depth.png")
_RAW = ("{}.depth_raw.png", "raw/{}.depth.png")


class Cameras(NamedTuple):
    """Both cameras of the device."""

    rgb_intrinsics: np.ndarray  # K (3, 3) float32
    depth_intrinsics: np.ndarray  # K (3, 3) float32
    rgb_from_depth: np.ndarray  # (4, 4), rigid, metres


_HEADINGS = {  # the matrices' headings in the file, and how many numbers follow
    "Color camera intrinsic matrix": 9,
    "Depth camera intrinsic matrix": 9,
    "Depth-to-color camera extrinsic matrix": 16,
}


def _is_realsense(path: Path) -> bool:
    return (path / _INFO).is_file() and any(path.glob("*" + _COLOUR))


def _open(path: Path, settings: Settings) -> Recording:
    cameras = read_cameras(path / _INFO)
    scale = settings.depth_scale or DEPTH_SCALE
    frames, unpaired = [], 0
    for image in sorted(path.glob("*" + _COLOUR)):
        name = image.name.removesuffix(_COLOUR)
        aligned, raw = (_first(path, patterns, name) for patterns in (_ALIGNED, _RAW))
        if depth := aligned or raw:
            frames.append(RecordedFrame(name, _reader(image, depth, depth is raw, scale, cameras)))
        else:
            unpaired += 1
    if not frames:
        raise InputError(f"{path} holds no depth: files such as {_ALIGNED[0].format('NAME')} were expected")
    return Recording(frames, scale, unpaired)


def _first(path: Path, patterns: tuple[str, ...], name: str) -> Path | None:
    return next((path / pattern.format(name) for pattern in patterns if (path / pattern.format(name)).is_file()), None)


def _reader(image: Path, depth: Path, raw: bool, scale: float, cameras: Cameras) -> Callable[[], Rgbd]:
    def read() -> Rgbd:
        rgb, depth_m = io.read_rgb(image), io.read_depth_m(depth, scale)
        if raw:
            to_rgb = (cameras.depth_intrinsics, cameras.rgb_from_depth, cameras.rgb_intrinsics)
            depth_m = reproject_depth(depth_m, *to_rgb, (rgb.shape[0], rgb.shape[1]))
        return check_frame(Rgbd(rgb, depth_m, cameras.rgb_intrinsics), image, depth)

    return read


def read_cameras(path: Path) -> Cameras:
    """Read `cam.info.txt`: matrices, each under a heading such as `# Color camera intrinsic matrix`.

    Raises:
        InputError: A matrix is missing or isn't one.
    """
    blocks = {}
    for block in path.read_text(encoding="utf-8").split("#"):
        heading, _, numbers = block.partition("\n")
        blocks[heading.strip()] = numbers.split()
    matrices = []
    for heading, count in _HEADINGS.items():
        try:
            matrix = np.array(blocks.get(heading, []), np.float64)
        except ValueError:
            matrix = np.zeros(0)
        if matrix.size != count:
            raise InputError(f"{path} must hold {count} numbers below '# {heading}'")
        matrices.append(matrix.reshape(int(count**0.5), -1))
    rgb_intrinsics, depth_intrinsics, rgb_from_depth = matrices
    return Cameras(rgb_intrinsics.astype(np.float32), depth_intrinsics.astype(np.float32), rgb_from_depth)


KIND = Kind("RealSense folder", f"{_INFO} and NAME{_COLOUR}", _is_realsense, _open)
