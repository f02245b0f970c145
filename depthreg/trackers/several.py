"""All trackers of a run at once."""

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig

from depthreg.config import build
from depthreg.devices import is_first_process
from depthreg.errors import InputError
from depthreg.report import Results
from depthreg.run_folder import read_record
from depthreg.trackers.base import Run, Tracker
from depthreg.trackers.csv_file import ResumableCSVLogger

_PACKAGES = ("wandb", "mlflow", "tensorboard")  # which the choices of these names need


def check_trackers(config: DictConfig) -> None:
    """Refuse a tracker whose package isn't installed.

    Raises:
        InputError: Naming what to install.
    """
    for name in _chosen(config):
        if name in _PACKAGES and importlib.util.find_spec(name) is None:
            raise InputError(f"logger={name} needs a package that isn't installed: pip install 'depthreg[trackers]'")


def _chosen(config: DictConfig) -> dict[str, DictConfig]:
    return {name: node for name, node in (config.get("logger") or {}).items() if node}


class Trackers:
    """What a run tells all its trackers, and the CSV file of every stage, which `depthreg compare` reads.

    Args:
        trackers: Open ones; none in the processes of a distributed run that aren't the first.
    """

    def __init__(self, trackers: Sequence[Tracker]) -> None:
        self.trackers = trackers

    def stage_loggers(self, stage: str, folder: Path, first_step: int = 0) -> list[Logger]:
        """Lightning's loggers for a stage; see `Tracker.stage_logger`."""
        return [
            ResumableCSVLogger(folder, first_step),
            *(tracker.stage_logger(stage, first_step) for tracker in self.trackers),
        ]

    def log_checkpoints(self, stage: str, folder: Path) -> None:
        """Keep what a stage left in its folder."""
        paths = [path for path in (folder / "best.ckpt", folder / "last.ckpt") if path.is_file()]
        for tracker in self.trackers:
            tracker.log_checkpoints(stage, paths)

    def log_results(self, results: Results) -> None:
        """Keep the final table."""
        for tracker in self.trackers:
            tracker.log_results(results)

    @property
    def hints(self) -> list[str]:
        """Commands that show the run."""
        return [tracker.hint for tracker in self.trackers]


@contextmanager
def open_trackers(
    config: DictConfig, folder: Path, stages: Sequence[str], choices: Mapping[str, Any]
) -> Iterator[Trackers]:
    """The trackers that `logger` names; an error within the context marks the run in them as failed.

    Args:
        config: Of the run.
        folder: Of the run, with its `run.yaml`.
        stages: Labels of the curriculum's steps.
        choices: See `Run`.
    """
    with ExitStack() as stack:
        trackers = []
        if is_first_process():
            run = Run(folder, read_record(folder), tuple(stages), choices)
            nodes = _chosen(config).values()
            trackers = [stack.enter_context(build(node, _partial_=True)(run)) for node in nodes]
        yield Trackers(trackers)
