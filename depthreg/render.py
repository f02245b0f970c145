"""`depthreg render`: a data set of one world, by many processes and machines, that goes on after any interruption."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from depthreg.config import build
from depthreg.data import io, rendered
from depthreg.data.frame_files import read_frame, write_frame
from depthreg.data.synthetic import FixedCamera, SyntheticFrames
from depthreg.errors import InputError
from depthreg.frame_pictures import frame_panel, overview
from depthreg.parallel import core_count, do_each
from depthreg.rendering import Camera, Rig

if sys.platform != "win32":
    import fcntl

_NOT_OF_THE_FRAMES = ("out", "workers", "shard", "shards", "verify")  # keys that no file depends on
_OVERVIEW_COUNT = 24


def check(config: DictConfig) -> None:
    """Refuse what can't be meant, before any work.

    Raises:
        InputError: In one sentence.
    """
    focal_px = config.camera.focal_px
    if isinstance(focal_px, str):
        raise InputError(f"camera.focal_px={focal_px}: expected a positive number of pixels")
    frames = build_frames(config)
    if not config.verify:
        rendered.check_folder(Path(config.out), rendered.describe(_recipe(config), frames))


def run(config: DictConfig) -> None:
    """Render what is missing and say where it is.

    Raises:
        InputError: The folder can't be written or holds something else; of several shards, the sentence names its own.
    """
    out = Path(to_absolute_path(config.out))  # on a cluster's machines, the working directory may be another
    try:
        if config.verify:
            _verify(out)
        else:
            _render(config, out)
    except OSError as error:
        raise InputError(_of_shard(config, f"{out} can't be written: {error.strerror or error}")) from error
    except InputError as error:
        raise InputError(_of_shard(config, str(error))) from error


def _of_shard(config: DictConfig, sentence: str) -> str:
    return f"shard {config.shard} of {config.shards}: {sentence}" if config.shards > 1 else sentence


def build_frames(config: DictConfig) -> SyntheticFrames:
    """What the composed configuration renders.

    Raises:
        InputError: A value can't be meant.
    """
    camera = build(config.camera)
    offset = build(config.offset) if config.get("offset") else None
    return SyntheticFrames(
        build(config.world),
        FixedCamera(camera) if isinstance(camera, Camera) else camera,
        build(config.sensor).rig | Rig(right=True, offset=offset),
        config.seed,
        config.count,
        max_depth_m=np.inf,
        renderer=build(config.rendering),
    )


def _recipe(config: DictConfig) -> dict[str, Any]:
    """The part of the configuration that frames depend on, in plain containers."""
    content: Any = OmegaConf.to_container(config, resolve=True)
    return {key: value for key, value in content.items() if key not in _NOT_OF_THE_FRAMES}


def _render(config: DictConfig, out: Path) -> None:
    frames = build_frames(config)
    rendered.begin(out, rendered.describe(_recipe(config), frames))
    writer = FrameWriter(out, frames, config.depth_scale, config.panels)
    indices = shard_indices(config.count, config.shard, config.shards)
    with claim(out, indices):
        made = render_missing(writer, indices, config.workers or core_count())
    there = sum((out / rendered.frame_name(index)).is_dir() for index in range(config.count))
    console = Console()
    console.print(f"{there} of {config.count} frames in {out}, {made} of them new", soft_wrap=True)
    if there == config.count:
        _finish(out, config.seed, config.count)
        console.print(f"some of them {out / rendered.OVERVIEW}", soft_wrap=True)


def shard_indices(count: int, shard: int, shards: int) -> range:
    """The frames of one of `shards` nearly equal parts of `count` frames."""
    return range(count * shard // shards, count * (shard + 1) // shards)


@contextmanager
def claim(folder: Path, indices: range) -> Iterator[None]:
    """Keep other processes from rendering the same frames; a killed process's claim ends with it.

    Raises:
        InputError: Another process renders some of them.
    """
    lock = folder / ".lock"  # a byte for each frame
    with lock.open("ab") as file:
        if indices and sys.platform != "win32":
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, len(indices), indices.start)
            except (BlockingIOError, PermissionError) as error:
                raise InputError(f"{folder} is being filled by another process: expected one for each frame") from error
            except OSError:  # some network file systems have no locks
                pass
        yield


@dataclass(frozen=True)
class FrameWriter:
    """Renders frames into their folders, each of which appears whole or not at all.

    Attributes:
        folder: Of the data set.
        frames: What to render.
        depth_scale: Stored value per metre.
        panels: Whether each frame gets a picture of all its parts.
    """

    folder: Path
    frames: SyntheticFrames
    depth_scale: float
    panels: bool

    def path(self, index: int) -> Path:
        """Where a frame is."""
        return self.folder / rendered.frame_name(index)

    def __call__(self, index: int) -> None:
        """Render frame `index`."""
        scene = self.frames.world(self.frames.seed, index)
        frame = self.frames.look(scene, index)
        partial = self.folder / f".{rendered.frame_name(index)}.partial"
        io.remove_folder(partial)  # of a process that was killed
        partial.mkdir()
        try:
            write_frame(partial, frame, scene, self.depth_scale)
            if self.panels:
                io.write_png(partial / "panel.png", frame_panel(frame))
            rendered.write_checksums(partial)
            partial.rename(self.path(index))
        finally:
            io.remove_folder(partial)


def render_missing(writer: FrameWriter, indices: Sequence[int], workers: int) -> int:
    """Render those frames that aren't there yet; returns how many that were."""
    missing = [index for index in indices if not writer.path(index).is_dir()]
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames"),
        _Speed(),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with _progress(*columns) as progress:
        bar = progress.add_task("", total=len(indices), completed=len(indices) - len(missing))
        for _ in do_each(writer, missing, min(workers, len(missing))):
            progress.advance(bar)
    return len(missing)


def _progress(*columns: str | ProgressColumn) -> Progress:
    """A bar on a terminal, nothing in a log."""
    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


class _Speed(ProgressColumn):
    """Frames a second."""

    def render(self, task: Task) -> Text:
        """What to show now."""
        return Text(f"{task.speed:.1f}/s," if task.speed else "")


def _finish(out: Path, seed: int, count: int) -> None:
    """Write the overview and the manifest; whichever shards end last do it, and write the same."""
    if (out / rendered.MANIFEST).exists():
        return
    some = np.unique(np.linspace(0, count - 1, min(count, _OVERVIEW_COUNT)).round().astype(int))
    pictures = {f"seed {seed}, index {i}": read_frame(out / rendered.frame_name(i), Rig()) for i in some.tolist()}
    io.write_png(out / rendered.OVERVIEW, overview(pictures))
    rendered.write_manifest(out, count)
    (out / ".lock").unlink(missing_ok=True)


def _verify(out: Path) -> None:
    total = len(rendered.manifest_lines(out))
    with _progress(*Progress.get_default_columns()) as progress:
        bar = progress.add_task("Comparing", total=total)
        for _ in rendered.verify(out):
            progress.advance(bar)
    Console().print(f"{total} files in {out} are as they were written", soft_wrap=True)
