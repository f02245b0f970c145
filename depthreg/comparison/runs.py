"""The runs below a folder, as `depthreg train` left them: configuration, curves, final scores, pictures.

A run may still be going on or have been killed at any moment, so whatever it hasn't written yet is simply not there.
"""

import csv
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from depthreg.errors import InputError
from depthreg.report import Results, read_report
from depthreg.run_folder import RECORD, read_record
from depthreg.walk import walk

Curve = Mapping[int, float]  # epoch, from 0 -> value


@dataclass(frozen=True)
class StageLog:
    """What one stage of a run has logged.

    Attributes:
        folder: The stage's folder.
        curves: Column of Lightning's `metrics.csv`, such as `val/loss` -> its value at the end of each epoch.
        steps: Optimisation steps done.
    """

    folder: Path
    curves: Mapping[str, Curve]
    steps: int

    @property
    def epochs(self) -> int:
        """Epochs logged so far."""
        return 1 + max((epoch for curve in self.curves.values() for epoch in curve), default=-1)


@dataclass(frozen=True)
class Run:
    """One run's folder.

    Attributes:
        folder: As the user named it.
        record: What `run.yaml` holds.
        stages: In the order in which they were walked, as far as they were reached.
        results: The final table; None where the run hasn't ended.
    """

    folder: Path
    record: Mapping[str, Any]
    stages: Mapping[str, StageLog]
    results: Results | None

    @property
    def config(self) -> Mapping[str, Any]:
        """The composed configuration."""
        return self.record["config"]

    @property
    def seed(self) -> Any:
        """First number of every random draw."""
        return self.config.get("seed")

    @property
    def revision(self) -> str:
        """Short git revision, with a `+` where the checkout was changed."""
        git = self.record.get("git") or {}
        return f"{git.get('revision', 'unknown')[:8]}{'+' if git.get('dirty') else ''}"

    @property
    def steps(self) -> int:
        """Optimisation steps of all stages together."""
        return sum(stage.steps for stage in self.stages.values())

    @property
    def frames(self) -> int:
        """Training frames seen in these steps."""
        trainer = self.config.get("trainer") or {}
        devices = trainer.get("devices", "auto")
        if not isinstance(devices, int) or devices < 1:  # what Lightning finds: all GPUs, or the CPU
            devices = len((self.record.get("hardware") or {}).get("gpus") or ()) or 1
        batches = devices * trainer.get("num_nodes", 1) * trainer.get("accumulate_grad_batches", 1)
        return self.steps * batches * (self.config.get("data") or {}).get("batch_size", 1)

    @property
    def state(self) -> str:
        """`finished`, or how far it has come and whether it failed."""
        if self.results is not None:
            return "finished"
        if not self.stages:
            return "unfinished: no stage begun"
        name, stage = list(self.stages.items())[-1]
        losses = stage.curves.get("train/loss", {})
        if losses and not math.isfinite(losses[max(losses)]):
            return f"failed: loss isn't finite in {name}, epoch {max(losses)}"
        return f"unfinished: {name}, {stage.epochs} epochs"

    @property
    def finished(self) -> bool:
        """Whether the final table is there."""
        return self.results is not None


def find_runs(folders: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Folders of runs, each once: the given ones, or all below them, in natural order.

    Returns:
        The runs, and the jobs of sweeps that failed before they could become one.

    Raises:
        InputError: No such folder, or no run below it.
    """
    found: dict[Path, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder} can't be read: the folder of a run or of a sweep was expected")
        below = sorted(_walk(folder), key=_natural)
        if not any((path / RECORD).is_file() for path in below):
            raise InputError(f"{folder} holds no run: a folder with {RECORD} of depthreg train was expected")
        for path in below:
            found.setdefault(path.resolve(), path)
    runs = [path for path in found.values() if (path / RECORD).is_file()]
    return runs, [path for path in found.values() if path not in runs]


def _walk(folder: Path) -> Iterator[Path]:
    for name, folders, files in os.walk(folder):
        path = Path(name)
        is_job = ".hydra" in folders and (path.parent / "multirun.yaml").is_file()
        if RECORD in files or is_job:
            yield path
        if RECORD in files or is_job or "dataset.json" in files:  # rendered frames are many thousands of files
            folders.clear()


def _natural(path: Path) -> list[tuple[int, str]]:
    """Job 2 of a sweep comes before job 10."""
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", str(path))]


def read_run(folder: Path) -> Run:
    """Read a run's folder.

    Raises:
        InputError: A file of it isn't what `depthreg train` writes.
    """
    record = read_record(folder)
    if missing := {"curriculum", "seed", "stages"} - record["config"].keys():
        raise InputError(f"{folder / RECORD} has no config.{min(missing)}: what depthreg train wrote was expected")
    names = [entry.label for entry in walk(OmegaConf.create(record["config"]))]
    stages = {name: read_stage(folder / name) for name in names if (folder / name / "metrics.csv").is_file()}
    results = read_report(folder) if (folder / "metrics.csv").is_file() else None
    return Run(folder, record, stages, results)


def read_stage(folder: Path) -> StageLog:
    """Read Lightning's `metrics.csv`, whose last line may be cut off.

    Raises:
        InputError: It isn't one.
    """
    path = folder / "metrics.csv"
    curves: dict[str, dict[int, float]] = {}
    steps = 0
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        for row in csv.DictReader(line for line in lines if line.endswith("\n")):
            steps = max(steps, 1 + int(row.pop("step")))
            epoch = row.pop("epoch")
            for column, value in row.items():
                if epoch and value:
                    curves.setdefault(column, {})[int(epoch)] = float(value)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path} can't be read: Lightning's metrics.csv with epoch and step was expected") from error
    return StageLog(folder, curves, steps)
