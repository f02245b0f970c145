"""Completing all frames of a recording into a folder, which goes on where it was stopped."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from depthreg.data import io
from depthreg.data.recordings import RecordedFrame, Recording, Rgbd
from depthreg.errors import InputError
from depthreg.model import Model
from depthreg.pipeline import WriteBehind, read_ahead
from depthreg.result import Result
from depthreg.rig import FrameAffine, Rig, summarize_rig
from depthreg.rig_page import write_page
from depthreg.view import FrameLog

_Read = tuple[RecordedFrame, Rgbd]
MADE_WITH = "made_with.json"  # in the results' folder: what every frame in it was made with
_STAGING = re.compile(r"\..+\.[0-9a-f]{8}")  # what `io.atomic_folder` leaves behind where the process was killed


class Outcome(NamedTuple):
    """What became of the frames."""

    made: int
    kept: int  # were there already
    failed: int
    seconds: float  # for those that were made


def check_folder(out: Path) -> None:
    """Raise `InputError` unless `claim_folder` could claim it: nobody's files get lost."""
    if not (out / MADE_WITH).exists():
        io.check_new_folder(out)


def claim_folder(out: Path, made_with: Mapping[str, Any]) -> None:
    """Make a folder for results, or go on in one whose results were made with the same.

    Args:
        out: A new or empty folder, or one that this function claimed before.
        made_with: What decides about the results, in plain containers.

    Raises:
        InputError: There are other files in it, or results that were made with something else.
    """
    check_folder(out)
    if not (out / MADE_WITH).exists():
        out.mkdir(parents=True, exist_ok=True)
        io.write_json(out / MADE_WITH, dict(made_with))
        return
    before = io.read_json(out / MADE_WITH)
    for key, value in made_with.items():
        if before.get(key) != value:
            raise InputError(
                f"{out} holds results of {key} {before.get(key)}, not {value}: the same or a new folder was expected"
            )
    for left in out.iterdir():
        if left.is_dir() and _STAGING.fullmatch(left.name):
            io.remove_folder(left)


def fingerprint(model: Model) -> str:
    """The SHA-256 of a model's weights, wherever they came from."""
    digest = hashlib.sha256()
    for name, weight in model.network.state_dict().items():
        digest.update(name.encode() + weight.cpu().numpy().tobytes())
    return digest.hexdigest()


def complete_series(
    model: Model,
    recording: Recording,
    out: Path,
    batch_size: int,
    intrinsics: np.ndarray | None = None,
    log: FrameLog | None = None,
) -> Outcome:
    """Write each frame's results into a folder of its name, whole or not at all; those that are there are left alone.

    What can't be read is named on standard error and left out.

    Args:
        model: What completes.
        recording: Whose frames.
        out: A folder that `claim_folder` made.
        batch_size: How many frames of one size the model gets at a time.
        intrinsics: K (3, 3) instead of the recording's own.
        log: What else gets each frame that is made.
    """
    todo = [frame for frame in recording.frames if not (out / frame.name).is_dir()]
    kept, failed = len(recording.frames) - len(todo), 0

    def read(frame: RecordedFrame) -> Rgbd | InputError:
        try:
            found = frame.read()
        except InputError as error:
            return error
        return found if intrinsics is None else found._replace(intrinsics=intrinsics)

    def write(frame: RecordedFrame, result: Result[np.ndarray]) -> None:
        with io.atomic_folder(out / frame.name) as staging:
            result.save(staging, recording.depth_scale)
        if log:
            log.log(frame.name, result, frame.time_s)

    with _progress(len(recording.frames), kept) as (progress, task), WriteBehind(2 * batch_size) as write_behind:

        def usable() -> Iterator[_Read]:
            nonlocal failed
            for frame, found in zip(todo, read_ahead(read, todo, 2 * batch_size), strict=True):
                if isinstance(found, Rgbd):
                    yield frame, found
                    continue
                failed += 1
                progress.console.print(f"depthreg complete: {found}; left out", soft_wrap=True, markup=False)
                progress.advance(task)

        for batch in _batches(usable(), batch_size):
            for (frame, _), result in zip(batch, _complete(model, [found for _, found in batch]), strict=True):
                write_behind(write, frame, result)
                progress.advance(task)
        seconds = progress.tasks[0].elapsed or 0.0
    return Outcome(len(todo) - failed, kept, failed, seconds)


def _complete(model: Model, frames: Sequence[Rgbd]) -> Iterable[Result[np.ndarray]]:
    """The results of frames of one form."""
    matrices = [frame.intrinsics for frame in frames if frame.intrinsics is not None]
    return model(
        np.stack([frame.rgb for frame in frames]),
        np.stack([frame.depth_m for frame in frames]),
        np.stack(matrices) if matrices else None,
    )


def _batches(frames: Iterable[_Read], batch_size: int) -> Iterator[list[_Read]]:
    """Neighbours of one size, all with a camera matrix or all without."""
    batch: list[_Read] = []
    for item in frames:
        if batch and (len(batch) == batch_size or _form(batch[0][1]) != _form(item[1])):
            yield batch
            batch = []
        batch.append(item)
    if batch:
        yield batch


def _form(frame: Rgbd) -> tuple[tuple[int, ...], bool]:
    return frame.rgb.shape, frame.intrinsics is None


class _FramesPerSecond(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} frames/s" if task.speed else "", style="progress.data.speed")


@contextmanager
def _progress(total: int, done: int) -> Iterator[tuple[Progress, Any]]:
    columns = (TextColumn("Completing"), BarColumn(), MofNCompleteColumn(), _FramesPerSecond(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        yield progress, progress.add_task("", total=total, completed=done)


def write_rig(recording: Recording, out: Path) -> tuple[Rig, str] | None:
    """Summarise what the frames' results say about the rig in `rig.json` and `rig.html`.

    Returns:
        The summary, and the unit of its times; None where there are no results, or their sizes differ.
    """
    timed = all(frame.time_s is not None for frame in recording.frames)
    affines, sizes = [], set()
    for number, frame in enumerate(recording.frames):
        path = out / frame.name / "affine.json"
        if path.exists():
            told = io.read_json(path)
            time = frame.time_s if timed and frame.time_s is not None else number
            affines.append(FrameAffine(frame.name, time, np.array(told["affine_rgb_from_depth"]), told["trust"]))
            sizes.add((told["height"], told["width"]))
    if len(sizes) != 1:
        return None
    rig, unit = summarize_rig(affines, sizes.pop()), "s" if timed else "frames"
    io.write_json(out / "rig.json", {**rig.as_json(), "unit_of_duration": unit})
    write_page(out / "rig.html", rig, affines, unit)
    return rig, unit
