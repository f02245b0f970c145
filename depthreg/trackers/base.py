"""What a tracker is told, and what it has to know about the run."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch.loggers import Logger

from depthreg.report import OURS, Results


@dataclass(frozen=True)
class Run:
    """A run as every tracker shows it.

    Args:
        folder: The run's folder.
        record: What its `run.yaml` holds.
        stages: Labels of the curriculum's steps.
        choices: What Hydra's groups were set to; `experiment` and `preset` among them.
    """

    folder: Path
    record: Mapping[str, Any]
    stages: tuple[str, ...]
    choices: Mapping[str, Any]

    @property
    def id(self) -> str:
        """The same when the run is resumed."""
        return self.record["id"]

    @property
    def name(self) -> str:
        """In a sweep what is special about the run, otherwise when it was started."""
        return " ".join(self._swept()) or self.folder.name

    @property
    def group(self) -> str:
        """The sweep that the run belongs to; a single run is a group of its own."""
        return self.folder.parent.name if self._sweep_plan.is_file() else self.folder.name

    @property
    def job_type(self) -> str:
        """The experiment, so that runs of several seeds are one line, or `train`."""
        return self.choices.get("experiment") or "train"

    @property
    def tags(self) -> list[str]:
        """Experiment, preset and stages."""
        chosen = [self.choices.get(group) for group in ("experiment", "preset")]
        return list(dict.fromkeys([*filter(None, chosen), *self.stages]))

    @property
    def parameters(self) -> dict[str, Any]:
        """The composed configuration, and under `run` where and how it was run."""
        return {**self.record["config"], "run": {key: self.record[key] for key in self.record if key != "config"}}

    @property
    def _sweep_plan(self) -> Path:
        return self.folder.parent / "multirun.yaml"  # Hydra's

    def _swept(self) -> list[str]:
        """Overrides that not all runs of the sweep have."""
        if not self._sweep_plan.is_file():
            return []
        plan = yaml.safe_load(self._sweep_plan.read_text(encoding="utf-8"))
        return [override for override in self.record["overrides"] if override not in plan["hydra"]["overrides"]["task"]]


def final_scores(results: Results) -> dict[str, float]:
    """The network's part of the final table, as `final/<task>/<metric>`."""
    return {
        f"final/{task.replace(', ', '_')}/{metric}": value
        for task, methods in results.items()
        for metric, value in methods.get(OURS, {}).items()
    }


class Tracker(ABC):
    """One run in one tracker, from before its first stage until after its last; leaving the context closes it.

    Args:
        run: What it shows.
    """

    def __init__(self, run: Run) -> None:
        self.run = run

    @property
    @abstractmethod
    def hint(self) -> str:
        """The command that shows the run."""

    @abstractmethod
    def stage_logger(self, stage: str, first_step: int) -> Logger:
        """Writes a stage's curves, each under the stage's name, and its pictures by `log_image`.

        Args:
            stage: Label of the stage.
            first_step: With which the stage goes on; what an interrupted run logged from there on is void.
        """

    def log_checkpoints(self, stage: str, paths: list[Path]) -> None:  # noqa: B027  a tracker may have no place for files
        """Keep the checkpoints of a finished stage."""

    @abstractmethod
    def log_results(self, results: Results) -> None:
        """Keep the final table."""

    @abstractmethod
    def close(self, succeeded: bool) -> None:
        """Nothing more will come."""

    def __enter__(self) -> "Tracker":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(succeeded=kind is None)
