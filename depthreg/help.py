"""What `depthreg NAME --help` prints, drawn from conf/NAME.yaml: its comments, its groups and its keys."""

import itertools
import re
import textwrap
from typing import Any

from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from depthreg.checks import shown
from depthreg.config import CONF_DIR, choices_of, open_hydra

_WIDTH = 110
_KEYS_OF = ("data", "trainer")  # groups whose single values are listed too
_FLAGS = """flags:
  ~GROUP             none of this group's choices
  -m KEY=A,B ...     one job for each value, or each combination of values; with hydra/launcher=joblib, ray or
                     submitit_slurm, several at a time
  --cfg job          print the composed configuration instead of running it
  --config-dir DIR   look into this folder for choices, too"""


def help_text(name: str) -> str:
    """How to use a command that Hydra composes."""
    what, examples = _head(name)
    with open_hydra(name) as hydra:
        config = hydra.compose_config(name, [], RunMode.RUN, from_shell=False)
        choices = {group: list(choices_of(hydra, group)) for group in _groups(config)}
    return "\n\n".join(
        [
            f"usage: depthreg {name} [GROUP=CHOICE] [KEY=VALUE] ...",
            what,
            "examples:\n" + "\n".join(f"  {example}" for example in examples),
            "groups, and their choices with the default first:\n" + _columns(_group_rows(config, choices)),
            "keys, and their defaults:\n" + _columns(_key_rows(name, config)),
            _FLAGS,
        ]
    )


def _groups(config: DictConfig) -> list[str]:
    """The groups of a primary configuration in its order; Hydra has the last first."""
    groups = reversed(list(config.hydra.runtime.choices))
    return [group for group in groups if not group.startswith("hydra/") and "@" not in group]


def _group_rows(config: DictConfig, choices: dict[str, list[str]]) -> list[tuple[str, str]]:
    rows = []
    for group, names in choices.items():
        default = config.hydra.runtime.choices[group] or "none"
        rows.append((group, ", ".join([default, *(name for name in names if name != default)])))
    return rows


def _head(name: str) -> tuple[str, list[str]]:
    """The comment that opens conf/NAME.yaml: what the command does, and command lines."""
    lines = (CONF_DIR / f"{name}.yaml").read_text().splitlines()
    comment = [line.removeprefix("# ") for line in itertools.takewhile(lambda line: line.startswith("#"), lines)]
    examples = [line for line in comment if line.startswith(f"depthreg {name} ")]
    return " ".join(line for line in comment if line not in examples), examples


def _comments(path: str) -> dict[str, str]:
    text = (CONF_DIR / f"{path}.yaml").read_text()
    return dict(re.findall(r"^(\w+):[^#\n]*# (.*)$", text, flags=re.MULTILINE))


def _key_rows(name: str, config: DictConfig) -> list[tuple[str, str]]:
    own = OmegaConf.load(CONF_DIR / f"{name}.yaml")
    values: Any = OmegaConf.to_container(config)
    rows = _rows({key: values[key] for key in map(str, own) if key not in ("defaults", "hydra")}, _comments(name))
    for group in _KEYS_OF:
        if choice := config.hydra.runtime.choices.get(group):
            single = {key: value for key, value in values[group].items() if not isinstance(value, dict)}
            rows += _rows(single, _comments(f"{group}/{choice}"), f"{group}.")
    return rows


def _rows(values: dict[str, Any], comments: dict[str, str], prefix: str = "") -> list[tuple[str, str]]:
    rows = []
    for key, value in values.items():
        parts = {f".{part}": item for part, item in value.items()} if isinstance(value, dict) else {"": value}
        rows += [(f"{prefix}{key}{part}={shown(item)}", comments.get(key, "")) for part, item in parts.items()]
    return [row for row in rows if not row[0].startswith(("data.name=", "data._target_="))]


def _columns(rows: list[tuple[str, str]]) -> str:
    width = max(len(left) for left, right in rows if right)
    indent = " " * (width + 4)
    return "\n".join(
        textwrap.fill(f"  {left:<{width}}  {right}", _WIDTH, subsequent_indent=indent, break_long_words=False).rstrip()
        for left, right in rows
    )
