"""What the values of a configuration may be, told by their names and defaults: checked before PyTorch is imported."""

from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from typing import Any

from omegaconf import DictConfig, OmegaConf

from depthreg.errors import InputError
from depthreg.walk import walk

_OTHERS = ("trainer", "callbacks", "logger")  # arguments of other libraries, which have rules of their own
_OPTIONAL = ("offset", "color", "weather", "freeze", "patience")  # may be null whatever they are by default


def check_type(key: str, default: Any, value: Any) -> None:
    """Compare an overridden value with the default in whose place it is, in plain containers.

    Raises:
        InputError: The value is of another type, as an integer isn't where the default is one or a float.
    """
    last = key.rpartition(".")[2]
    if key.split(".")[0] in _OTHERS or default is None or default == "???" or _is_reference(value):
        return
    if value is None:
        if isinstance(default, str | list) or last in _OPTIONAL:
            return
        raise InputError(f"{key}=null: expected {_type_name(default)}, such as {shown(default)}")
    if isinstance(default, dict) and isinstance(value, dict):
        for part in value.keys() & default.keys():
            check_type(f"{key}.{part}", default[part], value[part])
    elif isinstance(default, list) and isinstance(value, list):
        for i, element in enumerate(value if default else []):
            check_type(f"{key}[{i}]", default[0], element)
    elif not _is_alike(default, value):
        raise InputError(f"{key}={shown(value)}: expected {_type_name(default)}, such as {shown(default)}")


def _is_reference(value: Any) -> bool:
    return isinstance(value, str) and "${" in value


def _is_alike(default: Any, value: Any) -> bool:
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    return isinstance(value, int | float if isinstance(default, float) else type(default))


def _type_name(default: Any) -> str:
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", list: "a list"}
    return names.get(type(default), "keys")


def shown(value: Any) -> str:
    """A value as one writes it on the command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, dict):
        return "{" + ", ".join(key for key in value if not key.startswith("_")) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(shown, value)) + "]"
    return str(value)


Rule = tuple[Callable[[float], bool], str]


def _whole(at_least: int) -> Rule:
    return lambda value: isinstance(value, int) and value >= at_least, f"a whole number, at least {at_least}"


def _within(lowest: float, highest: float) -> Rule:
    return lambda value: lowest <= value <= highest, f"a number from {lowest} to {highest}"


_POSITIVE: Rule = (lambda value: value > 0, "a number above 0")
_NOT_NEGATIVE: Rule = (lambda value: value >= 0, "a number, at least 0")

# The first pattern that fits a key's name says what its numbers may be.
RANGES: dict[str, Rule] = {
    "seed": _whole(0),
    "shard": _whole(0),
    "panels": _whole(0),
    "worst": _whole(0),
    "curves": _whole(0),
    "data.workers": _whole(0),  # 0 is this process itself
    "workers": _whole(1),
    "count": _whole(1),
    "*_count": _whole(1),
    "batch_size": _whole(1),
    "scenes": _whole(1),
    "shards": _whole(1),
    "limit": _whole(1),
    "epochs": _whole(1),
    "epochs.*": _whole(1),
    "patience": _whole(1),
    "period": _whole(1),
    "steps": _whole(1),
    "values": _within(0, 1),
    "data.width": _whole(64),
    "data.height": _whole(64),
    "camera.width": _whole(1),
    "camera.height": _whole(1),
    "share": _within(0, 1),
    "*_share": _within(0, 1),
    "difficulty": _within(0, 1),
    "difficulties": _within(0, 1),
    "*.difficulty.start": _within(0, 1),
    "*.difficulty.end": _within(0, 1),
    "max_corner_shift_px": _within(0, 200),
    "trainer.accumulate_grad_batches": _whole(1),
    "learning_rate": _POSITIVE,
    "depth_scale": _POSITIVE,
    "focal_px": _POSITIVE,
    "max_depth_m": _POSITIVE,
    "weight": _NOT_NEGATIVE,
    "weight_decay": _NOT_NEGATIVE,
}

CHOICES: dict[str, tuple[object, ...]] = {
    "stages.*.difficulty.shape": ("linear", "cosine", "steps"),
    "trainer.accelerator": ("auto", "cpu", "gpu", "cuda", "mps", "tpu"),
    "trainer.strategy": ("auto", "ddp", "ddp_find_unused_parameters_true"),
    "trainer.precision": ("32-true", "16-mixed", "bf16-mixed", "16-true", "bf16-true", "64-true", 32, 64, 16, "bf16"),
}


def check_ranges(config: DictConfig) -> None:
    """Check every number whose key `RANGES` knows, and every word whose key `CHOICES` knows.

    Raises:
        InputError: Naming the first key that is out of range, and its range.
    """
    leaves = _leaves(OmegaConf.to_container(config, resolve=True))
    for key, value in sorted(leaves, key=lambda item: item[0].count(".")):  # what others refer to comes first
        for choices in (choices for pattern, choices in CHOICES.items() if fnmatchcase(key, pattern)):
            if value not in choices:
                raise InputError(f"{key}={value}: expected one of {', '.join(map(str, choices))}")
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        last = key.rpartition(".")[2]
        for pattern, (fits, expected) in RANGES.items():
            if fnmatchcase(key if "." in pattern else last, pattern):
                if not fits(value):
                    raise InputError(f"{key}={value}: expected {expected}")
                break


def _leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Every value below a node with its key; those of a list have the list's."""
    if isinstance(node, dict):
        for name, value in node.items():
            if key or name not in ("callbacks", "logger"):
                yield from _leaves(value, f"{key}.{name}" if key else str(name))
    elif isinstance(node, list):
        for value in node:
            yield from _leaves(value, key)
    elif node is not None:
        yield key, node


def check_together(config: DictConfig) -> None:
    """Check that nothing is missing, and that no two keys contradict each other.

    Raises:
        InputError: Naming the keys.
    """
    if missing := sorted(OmegaConf.missing_keys(config)):
        raise InputError(f"{missing[0]} is missing: expected {missing[0]}=... on the command line")
    if "curriculum" in config:
        walk(config)
    if "shard" in config and config.shard >= config.shards:
        raise InputError(f"shard={config.shard} of shards={config.shards}: expected at most {config.shards - 1}")
    train_count, batch_size = (OmegaConf.select(config, f"data.{key}") for key in ("train_count", "batch_size"))
    if train_count is not None and train_count < batch_size:
        raise InputError(
            f"data.train_count={train_count} is below data.batch_size={batch_size}: expected at least one batch"
        )
