"""A stage's curves as a CSV file, which a resumed stage goes on with."""

import csv
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from depthreg.data import io

Row = dict[str, Any]


class ResumableCSVLogger(Logger):
    """Writes `metrics.csv`, a row for each call and a column for each metric, beside `epoch` and `step`.

    Lightning's own logger deletes the file of an interrupted run, and loses it if it is killed when a column is added.
    This one keeps the rows before the step with which training goes on; those from there on will come again.

    Args:
        folder: An existing one.
        first_step: With which training goes on.
    """

    def __init__(self, folder: Path, first_step: int = 0) -> None:
        super().__init__()
        self.path = folder / "metrics.csv"
        self.rows = rows_before(self.path, first_step)
        self.columns = sorted(set().union(*self.rows))
        self._written = 0  # how many of them the file has
        self._rewrite = True  # the file as a whole, as its columns have changed or rows are void

    @property
    def name(self) -> str:
        """Nothing beside the folder."""
        return ""

    @property
    def version(self) -> str:
        """Nothing beside the folder."""
        return ""

    @property
    def save_dir(self) -> str:
        """The folder."""
        return str(self.path.parent)

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """They are in the run's `run.yaml`."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Add a row; `save` writes it."""
        row = {**metrics, "step": step}
        if not row.keys() <= set(self.columns):
            self.columns, self._rewrite = sorted({*self.columns, *row}), True
        self.rows.append(row)

    def add_missing(self, metrics: Mapping[str, float], step: int) -> None:
        """Write a row, unless there is one of that step with these metrics."""
        at_step = [row for row in self.rows if int(row["step"]) == step]
        if not any(all(row.get(name) for name in metrics) for row in at_step):
            self.log_metrics(metrics, step)
            self.save()

    @rank_zero_only
    def save(self) -> None:
        """Append new rows; with a new column the file is written anew, as a whole."""
        if self._rewrite and self.rows:
            with io.atomic_write(self.path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
                self._writer(file).writeheader()
                self._writer(file).writerows(self.rows)
            self._rewrite = False
        elif new := self.rows[self._written :]:
            with self.path.open("a", newline="", encoding="utf-8") as file:
                self._writer(file).writerows(new)
        self._written = len(self.rows)

    def _writer(self, file: Any) -> csv.DictWriter:
        return csv.DictWriter(file, fieldnames=self.columns, lineterminator="\n")


def rows_before(path: Path, step: int) -> list[Row]:
    """Rows of a log before a step, without the half row that a process leaves when it is killed."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    whole = [line for line in lines if line.endswith("\n")]
    return [row for row in csv.DictReader(whole) if int(row["step"]) < step]
