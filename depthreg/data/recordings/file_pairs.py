"""Two files of one moment, and two folders of such files of the same names."""

from collections.abc import Callable, Sequence
from pathlib import Path

from depthreg.data import io
from depthreg.data.recordings.recording import RecordedFrame, Recording, Rgbd, check_frame
from depthreg.errors import InputError


def open_pairs(rgb: Path, depth: Path, scale: float) -> Recording:
    """The pair of two files, or the pairs of two folders by their files' names without suffix, sorted.

    Args:
        rgb: Colour, PNG or JPEG, or a folder of them.
        depth: Depth in any format that `io.read_depth_m` knows, or a folder of them.
        scale: Stored value per metre of the depth files.

    Raises:
        InputError: One file and one folder, an empty folder, or a file without exactly one partner.
    """
    if rgb.is_dir() != depth.is_dir():
        raise InputError(f"{rgb} and {depth} must be two files or two folders")
    if not rgb.is_dir():
        return Recording([RecordedFrame(rgb.stem, _reader(rgb, depth, scale))], scale)
    rgb_of_stem, depth_of_stem = _by_stem(rgb, io.RGB_SUFFIXES), _by_stem(depth, io.DEPTH_SUFFIXES)
    for ours, other_folder, others in ((rgb_of_stem, depth, depth_of_stem), (depth_of_stem, rgb, rgb_of_stem)):
        alone = [path for stem, path in ours.items() if stem not in others]
        if alone:
            raise InputError(f"{alone[0]} has no partner of the same name in {other_folder} ({len(alone)} without one)")
    frames = [RecordedFrame(stem, _reader(path, depth_of_stem[stem], scale)) for stem, path in rgb_of_stem.items()]
    return Recording(frames, scale)


def _by_stem(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The files of these kinds in a folder, sorted; hidden ones are left out."""
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


def _reader(rgb: Path, depth: Path, scale: float) -> Callable[[], Rgbd]:
    return lambda: check_frame(Rgbd(io.read_rgb(rgb), io.read_depth_m(depth, scale)), rgb, depth)
