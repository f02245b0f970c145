"""Rows of the comparison: runs that differ in nothing but the seed, named by what tells them from the others."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from depthreg.comparison.runs import Run
from depthreg.errors import InputError
from depthreg.report import METRICS, OURS, Results, best_of

Column = tuple[str, str]  # task, metric

_SAME_EXPERIMENT = ("seed", "resume")  # keys in which runs of one row may differ
_ABSENT = object()


class Spread(NamedTuple):
    """Mean and sample standard deviation over seeds; the deviation of a single value is NaN."""

    mean: float
    std: float
    values: tuple[float, ...]

    def __str__(self) -> str:
        if math.isnan(self.mean):
            return "-"
        return f"{self.mean:.3f}" + self._deviation

    @property
    def signed(self) -> str:
        """As text, with the sign of a difference."""
        return "-" if math.isnan(self.mean) else f"{self.mean:+.3f}" + self._deviation

    @property
    def _deviation(self) -> str:
        return "" if math.isnan(self.std) else f" ± {self.std:.3f}"


def spread(values: Sequence[float]) -> Spread:
    """Mean and sample standard deviation; NaN as soon as one value is, so that no diverged seed is hidden."""
    with np.errstate(invalid="ignore"):  # infinity minus infinity
        mean = float(np.mean(values)) if values else math.nan
        std = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return Spread(mean, std, tuple(values))


@dataclass(frozen=True)
class Row:
    """Runs of one configuration.

    Attributes:
        name: What tells this row from the others, in the user's words.
        differences: Configuration key -> value, of the keys in which the rows differ; None where it isn't there.
        runs: Of several seeds, in the order of these.
    """

    name: str
    differences: Mapping[str, str | None]
    runs: Sequence[Run]

    @property
    def finished(self) -> list[Run]:
        """The runs that have a final table."""
        return [run for run in self.runs if run.finished]

    @property
    def seeds(self) -> str:
        """Such as `1, 2, 3`."""
        return ", ".join(str(run.seed) for run in self.runs)

    @property
    def state(self) -> str:
        """`finished`, or what the runs are that aren't."""
        others = [f"seed {run.seed} {run.state}" for run in self.runs if not run.finished]
        return "; ".join(others) or "finished"

    def count(self, what: str) -> str:
        """Steps or frames of a run, as a range where the runs differ."""
        counts = [getattr(run, what) for run in self.runs]
        ends = dict.fromkeys((min(counts), max(counts)))
        return " to ".join(f"{count:,}".replace(",", " ") for count in ends)

    def score(self, column: Column) -> Spread:
        """Our scores in the final tables, over seeds."""
        return spread([_score_of(run, column) for run in self.finished])

    def difference(self, reference: "Row", column: Column) -> Spread:
        """How much larger this row's scores are than another's, over the seeds that both have finished.

        Scores spread over seeds mostly since some validation frames are harder than others; what is hard for one row is
        so for the other, and drops out here.
        """
        theirs = {run.seed: _score_of(run, column) for run in reference.finished}
        shared = [run for run in self.finished if run.seed in theirs]
        return spread([_score_of(run, column) - theirs[run.seed] for run in shared])


def _score_of(run: Run, column: Column) -> float:
    task, metric = column
    return (run.results or {}).get(task, {}).get(OURS, {}).get(metric, math.nan)


def find_row(rows: Sequence[Row], words: str) -> Row:
    """The row of that name, or the one whose name ends in it.

    Raises:
        InputError: There is none, or there are several.
    """
    found = [row for row in rows if row.name == words] or [row for row in rows if row.name.endswith(words)]
    if len(found) != 1:
        raise InputError(f"--against {words}: expected one of {', '.join(row.name for row in rows)}")
    return found[0]


def make_rows(runs: Sequence[Run]) -> list[Row]:
    """Group runs by configuration without the seed; rows stay in the order of their first runs."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        same = {key: value for key, value in run.config.items() if key not in _SAME_EXPERIMENT}
        groups.setdefault(json.dumps(same, sort_keys=True, default=str), []).append(run)
    members = [sorted(group, key=lambda run: (str(type(run.seed)), run.seed)) for group in groups.values()]
    flat = [flatten(group[0].config) for group in members]
    differences = [{key: _shown(config, key) for key in differing_keys(flat)} for config in flat]
    names = row_names([group[0].record["overrides"] for group in members], differences)
    return [Row(*row) for row in zip(names, differences, members, strict=True)]


def flatten(node: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by dotted key; lists and empty mappings are values."""
    flat: dict[str, Any] = {}
    for key, value in node.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) and value else {f"{prefix}{key}": value}
    return flat


def differing_keys(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Keys whose values aren't the same in all flat configurations, without those that any row's runs may differ in."""
    keys = dict.fromkeys(key for config in configs for key in config if key not in _SAME_EXPERIMENT)
    return [key for key in keys if any(config.get(key, _ABSENT) != configs[0].get(key, _ABSENT) for config in configs)]


def _shown(config: Mapping[str, Any], key: str) -> str | None:
    return _words(config[key]) if key in config else None


def _words(value: Any) -> str:
    """A value as it would be given on the command line."""
    if isinstance(value, list):
        return f"[{','.join(map(_words, value))}]"
    return value if isinstance(value, str) else json.dumps(value, default=str)


def row_names(overrides: Sequence[Sequence[str]], differences: Sequence[Mapping[str, str | None]]) -> list[str]:
    """Short names: overrides that not all rows have, with the value of a key that only others override.

    Where the overrides don't tell the rows apart, since the code's defaults changed between them, the differences do.
    """
    words = [{_key(word): word for word in row if _key(word) not in _SAME_EXPERIMENT} for row in overrides]
    shared = set.intersection(*(set(row.values()) for row in words)) if words else set()
    keys = list(dict.fromkeys(key for row in words for key, word in row.items() if word not in shared))
    names = []
    for row, differs in zip(words, differences, strict=True):
        given = (row.get(key) or _default(key, differs) for key in keys)
        names.append(" ".join(word for word in given if word) or "defaults")
    if len(set(names)) < len(names):
        names = [" ".join(f"{key}={value}" for key, value in differs.items()) for differs in differences]
    return names


def _key(override: str) -> str:
    return override.split("=", 1)[0].lstrip("+")


def _default(key: str, differences: Mapping[str, str | None]) -> str | None:
    """A key that only other rows override, with this row's value; a group's choice isn't in the configuration."""
    value = differences.get(key)
    return None if value is None else f"{key}={value}"


def columns(rows: Sequence[Row]) -> list[Column]:
    """Task and metric of all scores that any row has."""
    tables = [run.results for row in rows for run in row.finished if run.results]
    tasks = dict.fromkeys(task for table in tables for task in table)
    ours = {(task, metric) for table in tables for task in table for metric in table[task].get(OURS, {})}
    return [(task, metric) for task in tasks for metric in METRICS if (task, metric) in ours]


def best_rows(rows: Sequence[Row], column: Column) -> list[bool]:
    """Which rows have the best mean."""
    return best_of(column[1], [row.score(column).mean for row in rows])


def warnings(rows: Sequence[Row]) -> list[str]:
    """What makes the rows hard to compare, a sentence each."""
    runs = [run for row in rows for run in row.runs]
    found = []
    revisions = dict.fromkeys(run.revision for run in runs)
    if len(revisions) > 1:
        found.append(f"The runs are of {len(revisions)} revisions of the code: {', '.join(revisions)}.")
    if any(revision.endswith("+") for revision in revisions):
        found.append("A + marks a revision with changes that weren't committed.")
    for what, name in (("steps", "optimisation steps"), ("frames", "training frames")):
        if len({getattr(run, what) for run in runs if run.finished}) > 1:
            found.append(f"Finished runs differ in their number of {name}.")
    if len({row.seeds for row in rows}) > 1:
        found.append("The rows have different seeds.")
    for row in rows:
        if repeated := [seed for seed, count in Counter(run.seed for run in row.runs).items() if count > 1]:
            found.append(f"{row.name}: seed {repeated[0]} was run more than once, and counts each time.")
    seen: dict[Any, set[tuple[str, ...]]] = {}
    for run in runs:
        if run.results:
            seen.setdefault(run.seed, set()).add(_fingerprint(run.results))
    if differing := [str(seed) for seed, frames in seen.items() if len(frames) > 1]:
        seeds = f"seed{'s' * (len(differing) > 1)} {', '.join(differing)}"
        found.append(f"Runs of {seeds} were evaluated on different frames, as the baselines' scores differ.")
    return found


def _fingerprint(results: Results) -> tuple[str, ...]:
    """The baselines' scores tell which frames a run was evaluated on; times differ always."""
    return tuple(
        f"{value:.4g}"
        for methods in results.values()
        for method, scores in methods.items()
        for metric, value in scores.items()
        if method in ("nearest", "identity") and metric != "seconds"
    )
