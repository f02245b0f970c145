"""The commands that Hydra composes: `depthreg NAME` is conf/NAME.yaml, and `check` and `run` of depthreg/NAME.py."""

import argparse
import functools
import importlib.util
import multiprocessing
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.utils import _run_hydra, get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from depthreg.checks import check_together
from depthreg.config import CONF_DIR, compose_config, one_line, open_hydra, refusing_overrides
from depthreg.errors import InputError
from depthreg.help import help_text
from depthreg.resume import resume_arguments
from depthreg.sweeps import Failure, expand_globs, report, samples_of


def run_application(name: str, argv: Sequence[str]) -> int:
    """Run a command with overrides and Hydra's own flags; what can't be meant is refused before anything is written.

    Returns:
        The exit status: 0, or of a sweep 1 where jobs failed, 2 where their input was to blame.

    Raises:
        InputError: In one sentence.
    """
    parser = get_args_parser()
    parser.error = functools.partial(_refuse_flags, name)  # type: ignore[method-assign]
    arguments = parser.parse_args(resume_arguments(argv) if name == "train" else list(argv))
    if arguments.help:
        print(help_text(name))
        return 0
    config_name = arguments.config_name or name
    with open_hydra(name, arguments.config_dir) as hydra, refusing_overrides(hydra, config_name):
        overrides = expand_globs(hydra, arguments.overrides)
        several = arguments.multirun or hydra.get_mode(config_name, overrides) == RunMode.MULTIRUN
        overrides.append(f"hydra.mode={'MULTIRUN' if several else 'RUN'}")
        settings = hydra.compose_config(config_name, overrides, RunMode.MULTIRUN, validate_sweep_overrides=False).hydra
        samples = samples_of(hydra, overrides, settings)
        if several and "pruner" in settings.sweeper and not importlib.util.find_spec("optuna"):
            raise InputError("hydra/sweeper=optuna needs Optuna: expected pip install 'depthreg[sweeps]' before it")
    configs = [compose_config(config_name, sample, arguments.config_dir) for sample in samples]
    if _only_shows(arguments):
        return _show(name, arguments, parser)
    for config in configs:
        check_together(config)
    if name == "train":  # PyTorch and all that from here on: seconds
        importlib.import_module("depthreg.devices").check_start(configs[0], settings, overrides)
    _check(name, configs)
    with open_hydra(name, arguments.config_dir) as hydra, refusing_overrides(hydra, config_name):
        task = functools.partial(run_job, name)
        if several:
            return _sweep(name, lambda: hydra.multirun(config_name, task, overrides))
        job: JobReturn = hydra.run(config_name, task, overrides)
    if isinstance(job.return_value, Exception):
        raise job.return_value
    return 0


def _sweep(name: str, run: Callable[[], Sequence[Sequence[JobReturn]]]) -> int:
    """Run a sweep and report on it; a job that fails is a result, so that an error here is its launcher's."""
    try:
        batches = run()
    except (InputError, HydraException, OmegaConfBaseException):
        raise
    except Exception as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        reason = f"{type(error).__name__}: {one_line(error)[:200]}"
        print(f"depthreg {name}: the sweep broke off, perhaps as a job was killed ({reason})", file=sys.stderr)
        return 1
    return report(name, batches)


def _refuse_flags(name: str, complaint: str) -> NoReturn:
    raise InputError(f"{complaint}; see `depthreg {name} --help`")


def _only_shows(arguments: argparse.Namespace) -> bool:
    shows = ("cfg", "info", "hydra_help", "shell_completion", "experimental_rerun")
    return any(getattr(arguments, name) not in (None, False) for name in shows)


def _show(name: str, arguments: argparse.Namespace, parser: argparse.ArgumentParser) -> int:
    try:
        _run_hydra(arguments, parser, functools.partial(run_job, name), str(CONF_DIR), name)
    except ValueError as error:  # two flags that exclude each other
        raise InputError(one_line(error)) from error
    return 0


def _check(name: str, configs: Sequence[DictConfig]) -> None:
    """Check what takes the parts of a configuration themselves."""
    module = importlib.import_module(f"depthreg.{name}")
    for config in configs:
        try:
            module.check(config)
        except OmegaConfBaseException as error:
            raise InputError(one_line(error)) from error


def run_job(name: str, config: DictConfig) -> Any:
    """Run one job, perhaps in another process or on another machine.

    Returns:
        What the command's `run` returns; where it failed, its error, and in a sweep a `Failure`.
    """
    hydra = HydraConfig.get()
    methods = multiprocessing.get_all_start_methods()  # the platform's own first
    if multiprocessing.get_start_method(allow_none=True) not in (None, *methods):
        multiprocessing.set_start_method(methods[0], force=True)  # joblib's starts no loader processes
    try:
        return importlib.import_module(f"depthreg.{name}").run(config)
    except Exception as error:
        if hydra.mode == RunMode.RUN:
            return error  # raised, Hydra would print about it
        failure = Failure.of(error)
        if failure.kind == "error":
            (Path(hydra.runtime.output_dir) / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
        return failure
