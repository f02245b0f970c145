"""Sweeps: which jobs are tried before they start, and what is said of those that failed."""

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from hydra._internal.hydra import Hydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import Glob, IntervalSweep, Override
from hydra.core.utils import JobReturn
from hydra.types import RunMode
from omegaconf import DictConfig

from depthreg.config import is_group, parse_overrides
from depthreg.errors import InputError


@dataclass(frozen=True)
class Failure:
    """Why a job failed, in the place of its result, so that the other jobs of a sweep go on.

    Attributes:
        reason: One sentence.
        bad_input: Whether an `InputError` said it.
    """

    reason: str
    bad_input: bool

    def __float__(self) -> float:
        return math.nan  # a sweeper's objective


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
    choices = list(_choices(hydra, override.key_or_group))
    if not (chosen := glob.filter(choices)):
        raise InputError(f"{override.input_line} fits no choice: expected some of {', '.join(choices)}")
    return f"{override.get_key_element()}={','.join(chosen)}"


def _choices(hydra: Hydra, group: str, folder: str = "") -> Iterator[str]:
    loader = hydra.config_loader
    yield from (f"{folder}{name}" for name in sorted(loader.get_group_options(f"{group}/{folder}", ObjectType.CONFIG)))
    for name in sorted(loader.get_group_options(f"{group}/{folder}", ObjectType.GROUP)):
        yield from _choices(hydra, group, f"{folder}{name}/")


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
    """Say which jobs of a sweep failed, and why.

    Args:
        name: The command.
        batches: What the sweeper returned.

    Returns:
        The exit status: 0, 1, or 2 where bad input alone is to blame.
    """
    jobs = [job for batch in batches for job in batch]
    failed = {i: job.return_value for i, job in enumerate(jobs) if isinstance(job.return_value, Failure)}
    if not failed:
        return 0
    print(f"depthreg {name}: {len(failed)} of {len(jobs)} jobs failed:", file=sys.stderr)
    for i, failure in failed.items():
        print(f"  job {i} ({' '.join(_of_its_own(jobs, i))}): {failure.reason}", file=sys.stderr)
    return 2 if all(failure.bad_input for failure in failed.values()) else 1


def _of_its_own(jobs: Sequence[JobReturn], number: int) -> list[str]:
    """The overrides of a job that not all jobs share."""
    shared = set.intersection(*(set(job.overrides or ()) for job in jobs)) if len(jobs) > 1 else set()
    return [override for override in jobs[number].overrides or () if override not in shared]
