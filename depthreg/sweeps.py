"""Sweeps: which jobs are tried before they start, and what is said of those that failed."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from hydra._internal.hydra import Hydra
from hydra.core.override_parser.types import Glob, IntervalSweep, Override
from hydra.core.utils import JobReturn
from hydra.types import RunMode
from omegaconf import DictConfig

from depthreg.config import choices_of, is_group, one_line, parse_overrides
from depthreg.errors import InputError, RunError


class Pruned(Exception):
    """A sweeper has seen enough of this job."""


@dataclass(frozen=True)
class Failure:
    """Why a job gave no result, in the place of its result, so that the other jobs of a sweep go on.

    Attributes:
        kind: `input` where an `InputError` said so, `pruned` where the sweeper stopped it, `error` for all else.
        reason: One sentence.
    """

    kind: Literal["input", "pruned", "error"]
    reason: str

    @classmethod
    def of(cls, error: Exception) -> "Failure":
        """What an error makes of its job."""
        if isinstance(error, InputError | Pruned):
            return cls("input" if isinstance(error, InputError) else "pruned", str(error))
        while isinstance(error.__context__, Exception) and not error.__suppress_context__:
            error = error.__context__  # what happened first; cleaning up after it may have failed too
        return cls("error", str(error) if isinstance(error, RunError) else f"{type(error).__name__}: {one_line(error)}")


def expand_globs(hydra: Hydra, overrides: Sequence[str]) -> list[str]:
    """Overrides with `group=glob(...)` as a list of choices; Hydra's own glob doesn't look into a group's folders.

    Raises:
        InputError: No choice fits.
    """
    return [_expanded(hydra, item) for item in parse_overrides(hydra, overrides)]


def _expanded(hydra: Hydra, override: Override) -> str:
    glob = override._value
    if not (isinstance(glob, Glob) and is_group(hydra, override)):
        return str(override.input_line)
    choices = list(choices_of(hydra, override.key_or_group))
    if not (chosen := glob.filter(choices)):
        raise InputError(f"{override.input_line} fits no choice: expected some of {', '.join(choices)}")
    return f"{override.get_key_element()}={','.join(chosen)}"


def samples_of(hydra: Hydra, overrides: Sequence[str], settings: DictConfig) -> list[list[str]]:
    """Overrides of few jobs in which each value of each swept key occurs: of a sweep, the sum, not the product.

    Args:
        hydra: Reads the overrides.
        overrides: Of all jobs.
        settings: Hydra's own configuration, whose sweeper may have more keys.
    """
    if settings.mode != RunMode.MULTIRUN:
        return [list(overrides)]
    of_sweeper = [f"{key}={value}" for key, value in (settings.sweeper.get("params") or {}).items()]
    parsed = {item.get_key_element(): item for item in parse_overrides(hydra, [*of_sweeper, *overrides])}
    values = {key: _values(item) for key, item in parsed.items()}
    first = {key: some[0] for key, some in values.items()}
    samples = [first] + [first | {key: value} for key, some in values.items() for value in some[1:]]
    return [list(sample.values()) for sample in samples]


def _values(override: Override) -> list[str]:
    """An override for each value of a sweep; of an interval, its ends."""
    if not override.is_sweep_override():
        return [str(override.input_line)]
    value = override.value()
    if isinstance(value, IntervalSweep):
        ends: list[Any] = [value.start, value.end]
    else:
        ends = list(override.sweep_string_iterator())
    return [f"{override.get_key_element()}={end}" for end in ends]


def report(name: str, batches: Sequence[Sequence[JobReturn]]) -> int:
    """Say what the jobs of a sweep gave, and which of them failed.

    Args:
        name: The command.
        batches: What the sweeper returned.

    Returns:
        The exit status: 0, 1, or 2 where bad input alone is to blame.
    """
    jobs = {int(job.hydra_cfg.hydra.job.num): job for batch in batches for job in batch if job.hydra_cfg}
    words = _of_their_own(jobs)
    failed = {number: job.return_value for number, job in jobs.items() if isinstance(job.return_value, Failure)}
    for number, job in jobs.items():
        if isinstance(job.return_value, float):
            print(f"job {number}  RMSE {job.return_value:.4g} m  {words[number]}")
    for number, failure in failed.items():
        if failure.kind == "pruned":
            print(f"job {number}  {failure.reason}  {words[number]}")
    failed = {number: failure for number, failure in failed.items() if failure.kind != "pruned"}
    if not failed:
        return 0
    print(f"depthreg {name}: {len(failed)} of {len(jobs)} jobs failed:", file=sys.stderr)
    for number, failure in failed.items():
        print(f"  job {number} ({words[number]}): {failure.reason}", file=sys.stderr)
    return 2 if all(failure.kind == "input" for failure in failed.values()) else 1


def _of_their_own(jobs: Mapping[int, JobReturn]) -> dict[int, str]:
    """The overrides of each job that not all jobs share."""
    overrides = {number: job.overrides or () for number, job in jobs.items()}
    shared = set.intersection(*map(set, overrides.values())) if len(jobs) > 1 else set()
    return {number: " ".join(item for item in items if item not in shared) for number, items in overrides.items()}
