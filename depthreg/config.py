"""Hydra configuration: where it lies, what it composes to, and how a bad override is refused."""

import difflib
import functools
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, InstantiationException, OverrideParseException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from depthreg.checks import check_ranges, check_type
from depthreg.errors import InputError

if TYPE_CHECKING:  # PyTorch takes seconds, and a mistake is to be answered at once
    from depthreg.sensors import SensorSimulator

_PACKAGE = Path(__file__).parent
# A wheel carries conf/ inside the package; a checkout and an editable install have it beside the package.
CONF_DIR = next(path for path in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if path.is_dir())

OmegaConf.register_new_resolver("sum", lambda *numbers: sum(numbers))  # experiments add up epochs with it


@contextmanager
def open_hydra(name: str, config_dir: str | None = None) -> Iterator[Hydra]:
    """Hydra with our configurations and, first, those of another folder; what was open before is so again afterwards.

    Raises:
        InputError: `config_dir` is no folder.
    """
    version.setbase("1.3")
    search_path = create_config_search_path(str(CONF_DIR))
    if config_dir:
        folder = Path(config_dir).resolve()
        if not folder.is_dir():
            raise InputError(f"--config-dir {config_dir}: expected a folder")
        schema = SearchPathQuery(provider="schema")
        search_path.prepend(provider="command-line", path=f"file://{folder}", anchor=schema)
    instance = GlobalHydra.instance()
    before, instance.hydra = instance.hydra, None
    try:
        yield Hydra.create_main_hydra2(name, search_path)
    finally:
        instance.hydra = before


def compose_config(name: str, overrides: Sequence[str] = (), config_dir: str | None = None) -> DictConfig:
    """Compose a primary configuration with every reference resolved, as `depthreg NAME OVERRIDES` would.

    Raises:
        InputError: In one sentence, naming the override and the nearest key, the choices, or what was expected.
    """
    with open_hydra(name, config_dir) as hydra, refusing_overrides(hydra, name):
        parsed = parse_overrides(hydra, overrides)
        groups = [str(item.input_line) for item in parsed if is_group(hydra, item)]
        keys = [item.key_or_group for item in parsed if not (is_group(hydra, item) or item.is_hydra_override())]
        config = _compose(hydra, name, overrides)
        values = OmegaConf.to_container(config)
        defaults = OmegaConf.to_container(_compose(hydra, name, groups), resolve=True) if keys else {}
        for key in keys:
            check_type(key, _select(defaults, key), _select(values, key))
        OmegaConf.to_container(config, resolve=True)  # raises where a reference leads nowhere
    check_ranges(config)
    return config


def _compose(hydra: Hydra, name: str, overrides: Sequence[str]) -> DictConfig:
    config = hydra.compose_config(name, list(overrides), RunMode.RUN, from_shell=False)
    with open_dict(config):
        config.pop("hydra", None)
    return config


def _select(node: Any, key: str) -> Any:
    for part in key.split("."):
        node = node.get(part) if isinstance(node, dict) else None
    return node


def parse_overrides(hydra: Hydra, overrides: Sequence[str]) -> list[Override]:
    """Overrides as Hydra reads them.

    Raises:
        InputError: One is no `key=value`, or `group=choice` names no choice.
    """
    parser = OverridesParser.create(hydra.config_loader)
    parsed = []
    for override in overrides:
        try:
            parsed += parser.parse_overrides([override])
        except OverrideParseException as error:
            reason = "" if "missing EQUAL" in str(error) else f" ({one_line(error)})"
            raise InputError(f"{override} can't be read{reason}: expected key=value, or quotes around it") from error
    for item in parsed:
        single = not (item.is_delete() or item.is_sweep_override() or isinstance(item.value(), str | list))
        if single and is_group(hydra, item):
            choices = ", ".join(choices_of(hydra, item.key_or_group))
            raise InputError(f"{item.input_line}: expected one of {choices}, or ~{item.get_key_element()} for none")
    return parsed


def is_group(hydra: Hydra, override: Override) -> bool:
    """Whether an override chooses a file of a group, instead of setting a key."""
    return any(choices_of(hydra, override.key_or_group))


def choices_of(hydra: Hydra, group: str, folder: str = "") -> Iterator[str]:
    """The choices of a group, also those in folders of it."""
    options = functools.partial(hydra.config_loader.get_group_options, f"{group}/{folder}")
    yield from (f"{folder}{name}" for name in sorted(options(ObjectType.CONFIG)))
    for name in sorted(options(ObjectType.GROUP)):
        yield from choices_of(hydra, group, f"{folder}{name}/")


@contextmanager
def refusing_overrides(hydra: Hydra, name: str) -> Iterator[None]:
    """Turn what Hydra says about overrides into one sentence.

    Raises:
        InputError: For each of Hydra's and OmegaConf's own errors.
    """
    try:
        yield
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise InputError(_explain(hydra, error, name)) from error


def _explain(hydra: Hydra, error: Exception, name: str) -> str:
    text = one_line(error)
    if unknown := re.search(r"Could not (?:override|delete)[^']*'([^']+)'", text):
        near = nearest(unknown[1], _all_keys(OmegaConf.to_container(_compose(hydra, name, []))))
        return f"unknown configuration key '{unknown[1]}'" + (
            f": did you mean '{near}'?" if near else f"; see `depthreg {name} --help`"
        )
    if missing := re.search(
        r"Could not find '(.+)/([^/']+)'.*Available options in '[^']+':(.*?)(Config search path|$)", text
    ):
        plugins = "; pip install 'depthreg[sweeps,cluster]' adds more" if missing[1] == "hydra/launcher" else ""
        return f"unknown choice '{missing[1]}={missing[2]}': expected one of {', '.join(missing[3].split())}{plugins}"
    if ambiguous := re.search(r"Ambiguous value for argument '([^']+)'", text):
        return f"{ambiguous[1]}: expected one value, a list in brackets, or -m before it to run one job for each value"
    return text


def one_line(error: BaseException) -> str:
    """What an error says, without line breaks and links."""
    return " ".join(str(error).split(" See https://")[0].split("\nSee https://")[0].split())


def nearest(word: str, keys: Sequence[str]) -> str | None:
    """The key that is most likely meant, whole or by its last part."""
    last_parts = {key.rpartition(".")[2]: key for key in reversed(keys)}
    whole = difflib.get_close_matches(word, keys, n=1, cutoff=0.75)
    near = whole or difflib.get_close_matches(word, [*keys, *last_parts], n=1, cutoff=0.6)
    return last_parts.get(near[0], near[0]) if near else None


def _all_keys(node: Any, prefix: str = "") -> list[str]:
    if not isinstance(node, dict):
        return []
    keys = [f"{prefix}{key}" for key in node]
    return keys + [deep for key, value in node.items() for deep in _all_keys(value, f"{prefix}{key}.")]


def build(node: DictConfig, **arguments: Any) -> Any:
    """What a configuration node's `_target_` makes, with plain containers for arguments.

    Raises:
        InputError: The target refuses a value, in its own words.
    """
    try:
        return instantiate(node, _convert_="all", **arguments)
    except InstantiationException as error:
        raise InputError(f"{node._target_}: {error.__cause__ or error}") from error


def build_simulator(node: DictConfig) -> "SensorSimulator":
    """The sensor simulator of a stage, or of another node with a sensor and a largest misalignment.

    Raises:
        InputError: A part refuses a value.
        ValueError: The simulator does.
    """
    from depthreg.sensors import SensorSimulator

    parts = {key: build(node[key]) for key in ("offset", "color", "weather") if node.get(key)}
    return SensorSimulator(build(node.sensor), node.max_corner_shift_px, offset_share=node.offset_share, **parts)
