"""Pictures of the same validation frames by every run (the paper's Figure 8), small enough to lie in one page."""

import base64
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from depthreg.comparison.curves import stages_of
from depthreg.comparison.rows import Row
from depthreg.comparison.runs import Run
from depthreg.data import io

FINAL = "final evaluation"  # stands where a stage's name does
LAST = -1  # the last epoch that a run drew, whichever that is

_WIDTH_PX = 512
_QUALITY = 50  # of WebP: captions stay readable
_BUDGET_BYTES = 7_000_000  # of all pictures: in base64, and with plotly.js, the page stays below 15 MB


class Moment(NamedTuple):
    """When a picture was drawn."""

    stage: str
    epoch: int

    def __str__(self) -> str:
        if self.stage == FINAL:
            return FINAL
        return f"{self.stage}, {'last epoch' if self.epoch == LAST else f'epoch {self.epoch}'}"


@dataclass(frozen=True)
class Choice:
    """Which pictures are shown: every combination of these, for every row.

    Attributes:
        seeds: Of the runs; frames of one seed are the same in every row.
        moments: In the order of training.
        frames: Numbers of the validation frames.
    """

    seeds: list[int]
    moments: list[Moment]
    frames: list[int]


@dataclass(frozen=True)
class Album:
    """The pictures of a comparison.

    Attributes:
        choice: What can be looked at.
        paths: (position of the seed, of the moment, of the frame, of the row) -> the picture's file.
        found: How many pictures there are on disk.
    """

    choice: Choice
    paths: dict[tuple[int, int, int, int], Path]
    found: int
    images: dict[Path, str] = field(default_factory=dict)  # as data URLs


def make_album(rows: Sequence[Row], budget_bytes: int = _BUDGET_BYTES) -> Album:
    """Choose as many pictures as the page can bear, fewer seeds first, then fewer epochs, then fewer frames."""
    choice = everything(rows)
    found = {path for row in rows for run in row.runs for path in pictures_of(run).values()}
    paths = _paths(rows, choice)
    if paths:
        affordable = budget_bytes / _typical_bytes(sorted(set(paths.values())))
        while len(set(paths.values())) > affordable and (fewer := _thinned(choice)):
            choice, paths = fewer, _paths(rows, fewer)
    images = {path: _data_url(path) for path in paths.values()}
    return Album(choice, paths, len(found), images)


def pictures_of(run: Run) -> dict[tuple[Moment, int], Path]:
    """A run's pictures, by moment and frame."""
    found = {}
    for stage in run.stages:
        for path in (run.folder / stage / "panels").glob("epoch_*_frame_*.png"):
            if numbers := re.fullmatch(r"epoch_(\d+)_frame_(\d+)", path.stem):
                found[Moment(stage, int(numbers[1])), int(numbers[2])] = path
    for path in (run.folder / "panels").glob("*.png"):
        if path.stem.isdigit():
            found[Moment(FINAL, LAST), int(path.stem)] = path
    return found


def everything(rows: Sequence[Row]) -> Choice:
    """All seeds, moments and frames; frames are those that can be followed through all moments, if there are such."""
    seeds = sorted({run.seed for row in rows for run in row.runs})
    drawn = [pictures_of(run) for row in rows for run in row.runs]
    moments = []
    for stage in [*stages_of(rows), FINAL]:
        epochs = [sorted({moment.epoch for moment, _ in some if moment.stage == stage}) for some in drawn]
        before = {epoch for some in epochs for epoch in some[:-1]}
        moments += [Moment(stage, epoch) for epoch in [*sorted(before), *([LAST] if any(epochs) else [])]]
    of_stage: dict[str, set[int]] = {}
    for some in drawn:
        for moment, frame in some:
            of_stage.setdefault(moment.stage, set()).add(frame)
    frames = set.intersection(*of_stage.values()) or set.union(*of_stage.values()) if of_stage else set()
    return Choice(seeds, moments, sorted(frames))


def _paths(rows: Sequence[Row], choice: Choice) -> dict[tuple[int, int, int, int], Path]:
    paths = {}
    for r, row in enumerate(rows):
        for run in row.runs:
            if run.seed not in choice.seeds:
                continue
            drawn = pictures_of(run)
            for m, moment in enumerate(choice.moments):
                own = _own_moment(moment, drawn)
                for f, frame in enumerate(choice.frames):
                    if path := drawn.get((own, frame)):
                        paths[choice.seeds.index(run.seed), m, f, r] = path
    return paths


def _own_moment(moment: Moment, drawn: Iterable[tuple[Moment, int]]) -> Moment:
    """What the last epoch is in this run."""
    if moment.epoch != LAST:
        return moment
    return max((own for own, _ in drawn if own.stage == moment.stage), default=moment)


def _thinned(choice: Choice) -> Choice | None:
    """A smaller choice, or None: one seed, one frame and each stage's last epoch always stay."""
    if len(choice.seeds) > 1:
        return Choice(choice.seeds[:-1], choice.moments, choice.frames)
    passing = [moment for moment in choice.moments if moment.epoch != LAST]
    if passing and len(choice.frames) * 2 <= len(choice.moments):
        dropped = set(passing[::2])
        return Choice(choice.seeds, [moment for moment in choice.moments if moment not in dropped], choice.frames)
    if len(choice.frames) > 1:
        return Choice(choice.seeds, choice.moments, choice.frames[:-1])
    if passing:
        return Choice(choice.seeds, [moment for moment in choice.moments if moment.epoch == LAST], choice.frames)
    return None


def _typical_bytes(paths: Sequence[Path]) -> float:
    """Mean size of a few encoded pictures, on the safe side."""
    some = [paths[i] for i in np.linspace(0, len(paths) - 1, 8).round().astype(int)]
    return 1.2 * float(np.mean([len(_encoded(path)) for path in some]))


def _data_url(path: Path) -> str:
    return "data:image/webp;base64," + base64.b64encode(_encoded(path)).decode()


@cache
def _encoded(path: Path) -> bytes:
    """A picture as WebP of at most `_WIDTH_PX`."""
    picture = io.read_png(path)
    height, width = picture.shape[:2]
    if width > _WIDTH_PX:
        size = (_WIDTH_PX, round(height * _WIDTH_PX / width))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    stored = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    return cv2.imencode(".webp", stored, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
