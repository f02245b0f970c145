"""A rendered data set: a folder of frames, what generated them, and a checksum of every file.

dataset.json     the generating configuration, its hash, the version, and what the frames hold
000000/ ...      a folder a frame, see `frame_files.FILES`; files.sha256 has its checksums
manifest.sha256  checksums of all files, for `sha256sum -c manifest.sha256`; it is there once all frames are
overview.png     some of the frames
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from torch.utils.data import Dataset

from depthreg import __version__
from depthreg.data import io
from depthreg.data.frame_files import FILES, read_frame
from depthreg.data.memory import MemoryFolder
from depthreg.data.synthetic import SyntheticFrames, code_of, pack, pack_rng
from depthreg.errors import InputError
from depthreg.rendering import Rig
from depthreg.sensors.misalignment import REFERENCE_WIDTH_PX, margin_for

DESCRIPTION, MANIFEST, OVERVIEW = "dataset.json", "manifest.sha256", "overview.png"
_CHECKSUMS = "files.sha256"  # of one frame
_FORMAT = 1

Place = TypeVar("Place")


def frame_name(index: int) -> str:
    """The folder of a frame."""
    return f"{index:06d}"


def describe(config: Mapping[str, Any], frames: SyntheticFrames) -> dict[str, Any]:
    """What `dataset.json` says: enough to render the same again, and to know whether a sensor can be simulated.

    Args:
        config: Plain containers: everything that the frames depend on.
        frames: What the configuration makes.
    """
    camera = frames.camera(np.random.default_rng(0))
    canonical = json.dumps(config, sort_keys=True).encode()
    return {
        "format": _FORMAT,
        "depthreg": __version__,
        "code_sha256": hashlib.sha256(code_of("worlds", "rendering")).hexdigest(),
        "config": config,
        "config_sha256": hashlib.sha256(canonical).hexdigest(),
        "holds": {
            **{name: getattr(camera, name) for name in ("width", "height", "margin_px")},
            **_needs(frames.rig),
        },
        "files": FILES,
    }


def _needs(rig: Rig) -> dict[str, Any]:
    """What a rig asks for, in JSON's types."""
    needs = {
        "scans": [asdict(scan) for scan in rig.scans],
        "right": rig.right or bool(rig.matchers),
        "offset": asdict(rig.offset) if rig.offset else None,
    }
    return json.loads(json.dumps(needs))


def begin(folder: Path, description: Mapping[str, Any]) -> None:
    """Make the folder of a data set, or go on with one of the same description.

    Raises:
        InputError: As `check_folder`.
    """
    check_folder(folder, description)
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / DESCRIPTION).exists():
        io.write_json(folder / DESCRIPTION, description)


def check_folder(folder: Path, description: Mapping[str, Any]) -> None:
    """Check that a data set of this description can be begun in a folder, or goes on there.

    Raises:
        InputError: It can't be written, or it holds something else; the first key that differs is named.
    """
    if not (folder / DESCRIPTION).exists():
        io.check_new_folder(folder, ignore_hidden=True)  # what other shards are about to write
        return
    found, asked = (dict(_flat(each)) for each in (read_description(folder), description))
    for key in [*asked, *found]:
        before, now = found.get(key, "nothing"), asked.get(key, "nothing")
        if before != now and not key.startswith("files."):
            raise InputError(
                f"{folder} was begun with {key.removeprefix('config.')}={before}, not {now}: "
                "expected the same, or another folder"
            )


def _flat(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of nested dictionaries, by its dotted key; the configuration first, as it is what a user knows."""
    for key, value in sorted(node.items(), key=lambda item: item[0] != "config"):
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def read_description(folder: Path) -> dict[str, Any]:
    """What `dataset.json` says.

    Raises:
        InputError: Not a data set of this format.
    """
    description = io.read_json(folder / DESCRIPTION)
    if not isinstance(description, dict) or description.get("format") != _FORMAT:
        raise InputError(f"{folder / DESCRIPTION} isn't of a rendered data set of format {_FORMAT}")
    return description


def write_checksums(folder: Path) -> None:
    """Note the checksums of a frame's files, in its folder."""
    sums = [f"{_sha256(path)}  {path.name}\n" for path in sorted(folder.iterdir())]
    (folder / _CHECKSUMS).write_text("".join(sums), encoding="utf-8")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_manifest(folder: Path, count: int) -> None:
    """Gather the checksums of all frames, and of the files beside them."""
    lines = [f"{_sha256(folder / name)}  {name}" for name in (DESCRIPTION, OVERVIEW)]
    for name in map(frame_name, range(count)):
        sums = (folder / name / _CHECKSUMS).read_text(encoding="utf-8")
        lines += [line.replace("  ", f"  {name}/", 1) for line in sums.splitlines()]
    with io.atomic_write(folder / MANIFEST) as temporary:
        temporary.write_text("\n".join([*lines, ""]), encoding="utf-8")


def verify(folder: Path) -> Iterator[int]:
    """Compare every file with the manifest; yields the number of files compared so far, after each.

    Raises:
        InputError: The data set isn't complete, or a file is missing or has changed.
    """
    for number, line in enumerate(manifest_lines(folder), 1):
        expected, _, name = line.partition("  ")
        frame = Path(name).parent
        advice = f": remove {folder / frame} and render again" if frame.name else ""
        try:
            found = _sha256(folder / name)
        except FileNotFoundError as error:
            raise InputError(f"{folder / name} is missing{advice}") from error
        except OSError as error:
            raise InputError(f"{folder / name} can't be read: {error.strerror}") from error
        if found != expected:
            raise InputError(f"{folder / name} has changed since it was written{advice}")
        yield number


def manifest_lines(folder: Path) -> list[str]:
    """A checksum and a file's name a line.

    Raises:
        InputError: The data set isn't complete.
    """
    try:
        return (folder / MANIFEST).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError(
            f"{folder / MANIFEST} can't be read: a complete data set was expected, which the same "
            "`depthreg render` makes of an interrupted one"
        ) from error


class Store(Protocol):
    """Where the frames of a finished data set are."""

    name: str  # for messages
    description: dict[str, Any]  # dataset.json

    def frame(self, index: int) -> Path | MemoryFolder:
        """The files of one frame."""


class FolderStore:
    """A finished data set, as `depthreg render` left it.

    Args:
        folder: Of the data set.

    Raises:
        InputError: It isn't complete.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.name = folder, str(folder)
        self.description = read_description(folder)
        manifest_lines(folder)

    def frame(self, index: int) -> Path:
        """The folder of one frame."""
        return self.folder / frame_name(index)


def folders_in(root: Path) -> dict[Path, dict[str, Any]]:
    """The descriptions of the data sets that are `root` itself or folders in it."""
    places = [path.parent for path in sorted([*root.glob(DESCRIPTION), *root.glob(f"*/{DESCRIPTION}")])]
    return {place: read_description(place) for place in places}


def of_world(descriptions: Mapping[Place, dict[str, Any]], root: str, world: Mapping[str, Any]) -> Place:
    """The place of the one data set of a world.

    Args:
        descriptions: `dataset.json` by place.
        root: What was searched, for messages.
        world: The world's configuration, as it stands in `dataset.json`.

    Raises:
        InputError: None is there, or several are.
    """
    if not descriptions:
        raise InputError(
            f"{root} holds no {DESCRIPTION}: a data set, or a folder with one for each world, was expected"
        )
    fitting = [place for place, description in descriptions.items() if description["config"]["world"] == world]
    if len(fitting) != 1:
        kind = world.get("_target_", "").rpartition(".")[2]
        raise InputError(f"{root} holds {len(fitting) or 'no'} data sets of the world {kind}: one was expected")
    return fitting[0]


def check_holds(store: Store, rig: Rig, max_corner_shift_px: float) -> None:
    """Check that the frames of a data set hold what a sensor simulator needs.

    Args:
        store: Of the data set.
        rig: What the depth sensor needs.
        max_corner_shift_px: Largest misalignment that the colour's margin has to serve, for an image 1242 pixels wide.

    Raises:
        InputError: They don't; the sentence says how to render others.
    """
    holds, needs = store.description["holds"], _needs(rig)
    shift_px = max_corner_shift_px * holds["width"] / REFERENCE_WIDTH_PX
    margin_px = margin_for(shift_px) if shift_px else 0
    if holds["margin_px"] < margin_px:
        raise InputError(
            f"{store.name} holds colour with a margin of {holds['margin_px']} px, but misalignment needs {margin_px}: "
            "expected frames of `depthreg render` with a larger camera.margin_px or camera.max_corner_shift_px"
        )
    lacking = {
        "the scans of the sensor's LiDAR": needs["scans"] and holds["scans"] != needs["scans"],
        "a right view": needs["right"] and not holds["right"],
        "the colour camera that stands beside the depth camera": needs["offset"] and holds["offset"] != needs["offset"],
    }
    for what, lacks in lacking.items():
        if lacks:
            raise InputError(
                f"{store.name} lacks {what}: expected frames of `depthreg render` with the stage's sensor= and offset="
            )


class RenderedFrames(Dataset[dict[str, Any]]):
    """Some frames of a rendered data set, as `SyntheticFrames` would give them if it rendered them anew.

    Args:
        store: Where they are.
        indices: Which frames.
        rig: What the sensor simulator needs.
        max_corner_shift_px: Largest misalignment that the colour's margin has to serve, for an image 1242 pixels wide.
        max_depth_m: Depth beyond this is unknown (0).

    Raises:
        InputError: They lack what is needed.
    """

    def __init__(
        self, store: Store, indices: Sequence[int], rig: Rig, max_corner_shift_px: float, max_depth_m: float
    ) -> None:
        check_holds(store, rig, max_corner_shift_px)
        self.store, self.indices, self.rig, self.max_depth_m = store, indices, rig, max_depth_m
        self.seed = store.description["config"]["seed"]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, number: int) -> dict[str, Any]:
        """What the simulator needs of a frame, as NumPy arrays; see `collate_frames`."""
        index = self.indices[number]
        frame = read_frame(self.store.frame(index), self.rig)
        return {**pack(frame, self.rig, pack_rng(self.seed, index), self.max_depth_m), "index": index}


def split(count: int, val_share: float) -> tuple[range, range]:
    """The first of so many frames, to train on, and its last ones, to validate on.

    Raises:
        InputError: One of the two would be empty.
    """
    first = count - round(val_share * count)
    if not 0 < first < count:
        raise InputError(f"val_share={val_share:g} of {count} frames leaves none to train or none to validate on")
    return range(first), range(first, count)
