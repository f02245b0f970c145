"""Hydra configuration: where it lies, how an application starts, and which values can't go together."""

import difflib
import functools
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from depthreg.errors import InputError
from depthreg.sensors import SensorSimulator

_PACKAGE = Path(__file__).parent
# A wheel carries conf/ inside the package; a checkout and an editable install have it beside the package.
CONF_DIR = next(path for path in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if path.is_dir())

OmegaConf.register_new_resolver("sum", lambda *numbers: sum(numbers))  # experiments add up epochs with it

Check = Callable[[DictConfig], None]


def run_application(
    name: str, task: Callable[[DictConfig], Any], argv: Sequence[str], check: Check | None = None
) -> int:
    """Run a Hydra application; bad overrides are reported before its folder is made.

    Args:
        name: The primary configuration, and the command's name.
        task: What to do with the composed configuration.
        argv: Overrides and Hydra's own flags.
        check: Raises `InputError` for values that can't be meant.

    Returns:
        The exit status.

    Raises:
        InputError: An override names no key, or `check` refused a value.
    """
    flagged = any(argument.startswith("-") for argument in argv)
    if not flagged:  # with flags, such as a sweep's, Hydra composes itself, perhaps several jobs
        config = compose_config(name, argv)
        if check:
            check(config)
    program = sys.argv[0]
    sys.argv = [f"depthreg {name}", *argv]  # what Hydra reads

    refused: list[InputError] = []

    @functools.wraps(task)
    def guarded(config: DictConfig) -> Any:
        sys.argv = [program, name, *argv]  # what Lightning starts again for each further device
        try:
            if flagged and check:
                check(config)
            return task(config)
        except InputError as error:
            if (
                HydraConfig.get().mode == RunMode.MULTIRUN
            ):  # the job, perhaps on another machine, has to count as failed
                raise
            refused.append(error)  # Hydra would say more than one sentence
            return None

    try:
        with _raising_errors():
            hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name=name)(guarded)()
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(_explain(error, name)) from error
    if refused:
        raise refused[0]
    return 0


@contextmanager
def _raising_errors() -> Iterator[None]:
    """Let Hydra raise what a sweep's job raised, for which it would print a traceback and exit with 1."""
    key, before = "HYDRA_FULL_ERROR", os.environ.get("HYDRA_FULL_ERROR")
    os.environ[key] = "1"
    try:
        yield
    finally:
        del os.environ[key]
        if before is not None:
            os.environ[key] = before


def compose_config(name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Compose a primary configuration with every reference resolved, as `depthreg NAME OVERRIDES` would.

    Raises:
        InputError: In one sentence, naming the override and the nearest key or the choices.
    """
    GlobalHydra.instance().clear()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF_DIR)):
        try:
            config = compose(name, overrides=list(overrides))
            OmegaConf.to_container(config, resolve=True)
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            raise InputError(_explain(error, name)) from error
    return config


def _explain(error: Exception, name: str) -> str:
    """Hydra's complaint as one sentence, with the nearest key where a key is unknown."""
    text = " ".join(str(error).split())
    if unknown := re.search(r"Could not override '([^']+)'", text):
        key = unknown[1]
        keys = _all_keys(OmegaConf.to_container(compose(name), resolve=False))
        near = difflib.get_close_matches(key, keys, n=1, cutoff=0.5)
        return f"unknown configuration key '{key}'" + (
            f": did you mean '{near[0]}'?" if near else f"; see `depthreg {name} --help`"
        )
    if missing := re.search(
        r"Could not find '([^']+)'.*Available options in '[^']+':(.*?)(Config search path|$)", text
    ):
        return f"unknown choice '{missing[1]}': expected one of {', '.join(missing[2].split())}"
    return text


def _all_keys(node: Any, prefix: str = "") -> list[str]:
    if not isinstance(node, dict):
        return []
    keys = [f"{prefix}{key}" for key in node]
    return keys + [deep for key, value in node.items() for deep in _all_keys(value, f"{prefix}{key}.")]


def require_positive(config: DictConfig, keys: Sequence[str]) -> None:
    """Check that each key holds a number above zero.

    Raises:
        InputError: Naming the key and its value.
    """
    for key in keys:
        value = OmegaConf.select(config, key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise InputError(f"{key}={value}: expected a number above 0")


def build(node: DictConfig, **arguments: Any) -> Any:
    """What a configuration node's `_target_` makes, with plain containers for arguments.

    Raises:
        InputError: The target refuses a value, in its own words.
    """
    try:
        return instantiate(node, _convert_="all", **arguments)
    except InstantiationException as error:
        raise InputError(f"{node._target_}: {error.__cause__ or error}") from error


def build_simulator(node: DictConfig) -> SensorSimulator:
    """The sensor simulator of a stage, or of another node with a sensor and a largest misalignment.

    Raises:
        InputError: A part refuses a value.
        ValueError: The simulator does.
    """
    parts = {key: build(node[key]) for key in ("offset", "color", "weather") if node.get(key)}
    return SensorSimulator(build(node.sensor), node.max_corner_shift_px, offset_share=node.offset_share, **parts)


def require_counts(config: DictConfig, keys: Sequence[str], at_least: int = 1) -> None:
    """Check that each key, where the configuration has it, holds a whole number of at least so much.

    Raises:
        InputError: Naming the key and its value.
    """
    for key in keys:
        value = OmegaConf.select(config, key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < at_least):
            raise InputError(f"{key}={value}: expected a whole number, at least {at_least}")
