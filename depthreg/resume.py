"""Resuming a run: the same command in the same folder, from what `run.yaml` recorded of it."""

import os
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf

from depthreg.config import compose_config
from depthreg.errors import InputError
from depthreg.run_folder import read_record

_OF_THIS_START = ("resume=", "hydra.run.dir=", "hydra.output_subdir=")  # overrides that a later start doesn't repeat


def resume_arguments(argv: Sequence[str]) -> list[str]:
    """The arguments of `depthreg train`, and where one is `resume=RUN`, those that RUN was started with before them.

    Raises:
        InputError: RUN isn't a run's folder, or today's defaults would make another experiment of it.
    """
    chosen = [argument for argument in argv if argument.startswith("resume=")]
    if not chosen or chosen[-1] in ("resume=", "resume=null"):
        return list(argv)
    run = Path(chosen[-1].removeprefix("resume=").strip("'\""))
    others = [argument for argument in argv if not argument.startswith(_OF_THIS_START)]
    if clashing := [argument for argument in others if argument.startswith(("init_from=", "-m", "--multirun"))]:
        raise InputError(f"resume={run} takes everything from there: expected no {clashing[0]} beside it")
    record = read_record(run)
    before = [override for override in record["overrides"] if not override.startswith(_OF_THIS_START)]
    _check_defaults(run, before, record["config"])
    place = str(run.resolve()).replace("\\", "\\\\").replace("'", "\\'")
    return [*before, *others, f"resume='{place}'", f"hydra.run.dir='{place}'", "hydra.output_subdir=null"]


def was_requeued() -> bool:
    """Whether Slurm starts this job again, with the same command, after it was preempted or asked to be queued."""
    return int(os.environ.get("SLURM_RESTART_COUNT", 0)) > 0


def _check_defaults(run: Path, overrides: Sequence[str], recorded: dict) -> None:
    """Refuse a run that another version's defaults began: it would go on as a different experiment."""
    today = _flat(OmegaConf.to_container(compose_config("train", overrides), resolve=True))
    then = _flat(recorded)
    different = sorted(key for key in today.keys() | then.keys() if key != "resume" and today.get(key) != then.get(key))
    if different:
        key = different[0]
        raise InputError(
            f"{run} was started with {key}={then.get(key)}, which this version composes to {today.get(key)}: "
            "expected the version that started it"
        )


def _flat(node: object, prefix: str = "") -> dict[str, object]:
    """Leaves of nested mappings, by their dotted keys."""
    if not isinstance(node, dict):
        return {prefix: node}
    children = (_flat(child, f"{prefix}.{name}" if prefix else str(name)) for name, child in node.items())
    return {key: leaf for leaves in children for key, leaf in leaves.items()}
