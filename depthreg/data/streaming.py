"""A rendered data set as a few large tar files with an index, read frame by frame from a disk or an object storage.

    index.json       where each frame lies in which tar file, and the tar files' checksums
    dataset.json     as the rendered data set has it
    000000.tar ...   members such as 000017.rgb.png: what `tar` opens, and what WebDataset calls shards

A frame's files are neighbours, so that one ranged read fetches it: this gives random access, and with it the exact
shuffle, the exact resumption and the split over ranks and workers that every other data set has. The streaming
libraries were weighed against that. LitData 0.2.76 requires torchvision, whose wheel doesn't load beside a CPU build
of PyTorch, and has a container format of its own. MosaicML Streaming 0.13 requires NumPy below 2.2, xxhash below 4,
torchvision and 16 more packages. WebDataset 1.0 is light and its tar files are open, but it reads them from front to
back: shuffling is approximate, resumption within an epoch is not exact, and ranks get unequal numbers of frames where
the tar files don't divide. Its layout is kept, so that it reads these files too.
"""

import hashlib
import io as memory
import json
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import fsspec

from depthreg.data import io
from depthreg.data.memory import MemoryFolder
from depthreg.data.rendered import DESCRIPTION, MANIFEST, FolderStore, frame_name, verify
from depthreg.errors import InputError

INDEX = "index.json"


def pack_frames(source: Path, target: Path, frames_per_tar: int) -> Iterator[int]:
    """Put a finished data set into tar files; yields the number of frames packed so far. It goes on where it was.

    The same data set gives the same bytes. Every file is compared with its checksum first.

    Args:
        source: A folder of `depthreg render`.
        target: A new or an empty folder, or one of an interrupted run.
        frames_per_tar: How many frames share a tar file.

    Raises:
        InputError: `source` isn't complete or has changed; `target` can't be written, or holds something else.
    """
    store = FolderStore(source)
    description = target / DESCRIPTION
    if not description.exists():
        io.check_new_folder(target, ignore_hidden=True)
    elif (target / MANIFEST).exists() or io.read_json(description) != store.description:
        raise InputError(f"{target} holds another data set: a new or an empty folder was expected")
    count = store.description["config"]["count"]
    if (target / INDEX).exists():
        packed = len(io.read_json(target / INDEX)["tars"][0]["frames"])
        if packed != min(frames_per_tar, count):
            raise InputError(f"{target} has {packed} frames a tar file, not {frames_per_tar}: expected another folder")
    for _ in verify(source):
        pass
    tars: list[dict[str, Any]] = []
    try:
        target.mkdir(parents=True, exist_ok=True)
        io.write_json(description, store.description)
        for start in range(0, count, frames_per_tar):
            indices = range(start, min(start + frames_per_tar, count))
            path = target / f"{start // frames_per_tar:06d}.tar"
            content, places = _tar(store, indices)
            if not (path.exists() and path.read_bytes() == content):
                with io.atomic_write(path) as temporary:
                    temporary.write_bytes(content)
            tars.append({"name": path.name, "sha256": hashlib.sha256(content).hexdigest(), "frames": places})
            yield indices.stop
        for path in set(target.glob("*.tar")) - {target / tar["name"] for tar in tars}:
            path.unlink()  # of an interrupted run with fewer frames in each
        io.write_json(target / INDEX, {"tars": tars})
    except OSError as error:
        raise InputError(f"{target} can't be written: {error.strerror or error}") from error


def _tar(store: FolderStore, indices: Sequence[int]) -> tuple[bytes, list[tuple[int, int]]]:
    """A tar file of frames, and the offset and size of each one's members; nothing in it says when or by whom."""
    buffer, places = memory.BytesIO(), []
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for index in indices:
            start = tar.offset
            for path in sorted(store.frame(index).iterdir()):
                content = path.read_bytes()
                member = tarfile.TarInfo(f"{frame_name(index)}.{path.name}")
                member.size = len(content)
                tar.addfile(member, memory.BytesIO(content))
            places.append((start, tar.offset - start))
    return buffer.getvalue(), places


class TarStore:
    """A packed data set, wherever fsspec reaches: a folder, https://, s3:// (with s3fs), gs:// (with gcsfs), ...

    Args:
        url: Of the folder.

    Raises:
        InputError: It can't be read, or holds no packed data set.
    """

    def __init__(self, url: str) -> None:
        self.name = url.rstrip("/")
        self.description = _read_json(f"{self.name}/{DESCRIPTION}")
        tars = _read_json(f"{self.name}/{INDEX}")["tars"]
        self.places = [(tar["name"], *place) for tar in tars for place in tar["frames"]]

    def frame(self, index: int) -> MemoryFolder:
        """Fetch the files of one frame."""
        tar, start, size = self.places[index]
        url, name = f"{self.name}/{tar}", frame_name(index)
        content = _read(url, start, start + size)
        try:
            with tarfile.open(fileobj=memory.BytesIO(content), mode="r:") as members:
                files = {member.name: members.extractfile(member).read() for member in members}  # type: ignore[union-attr]
        except tarfile.TarError as error:
            raise InputError(f"{url} can't be decoded: intact members of frame {index} were expected") from error
        return MemoryFolder(f"{url}/{name}", {key.removeprefix(f"{name}."): value for key, value in files.items()})


def urls_in(url: str) -> dict[str, dict[str, Any]]:
    """The descriptions of the packed data sets that `url` itself is, or that are folders in it."""
    url = url.rstrip("/")
    try:
        files, root = fsspec.core.url_to_fs(url)
        if _is_there(files, f"{root}/{DESCRIPTION}"):
            places = [url]
        else:
            listed = sorted(path.rstrip("/") for path in files.ls(root, detail=False)) if files.exists(root) else []
            places = [
                f"{url}/{path.rpartition('/')[2]}" for path in listed if _is_there(files, f"{path}/{DESCRIPTION}")
            ]
    except Exception as error:  # every file system has errors of its own: of its network, its credentials
        raise InputError(f"data.url={url} can't be read: {error}") from error
    return {place: _read_json(f"{place}/{DESCRIPTION}") for place in places}


def _is_there(files: fsspec.AbstractFileSystem, path: str) -> bool:
    """Whether there is such a file; `exists` would take an unreachable host for one that lacks it."""
    try:
        files.cat_file(path, 0, 1)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _read(url: str, start: int | None = None, end: int | None = None) -> bytes:
    try:
        files, path = fsspec.core.url_to_fs(url)
        return files.cat_file(path, start, end)
    except Exception as error:  # as above
        raise InputError(f"{url} can't be read: {error}") from error


def _read_json(url: str) -> dict[str, Any]:
    try:
        return json.loads(_read(url))
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{url} can't be decoded: intact JSON was expected") from error
