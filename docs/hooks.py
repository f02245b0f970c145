"""What MkDocs does beside Markdown: the page of every configuration key, and links that leave docs/."""

import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from depthreg.cli import APPLICATIONS
from depthreg.config import CONF_DIR
from depthreg.help import help_text

if TYPE_CHECKING:  # the tests ask for the page without MkDocs
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

KEYS_PAGE = "keys.md"
_INTRODUCTION = """---
search: {boost: 0.3}
---

# Every configuration key

Drawn from `conf/` when this page was built. [Configuration](configuration.md) says how keys and choices are written.

The first sections are what `--help` prints. Below them stands each file of `conf/` with its keys, their values and
comments. A key is written with its group before it, `trainer.precision=bf16-mixed`. World, sensor, offset, colour and
weather belong to a stage in `depthreg train`, `stages.full.sensor.min_lines=16`, and stand alone in `evaluate` and
`render`, `sensor.min_lines=16`.
"""


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the page of every key."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, KEYS_PAGE, content=keys_page()))
    return files


def on_page_markdown(markdown: str, page: "Page", config: "MkDocsConfig", files: "Files") -> str:
    """Send links to files outside docs/ to the repository, or take them for plain text where it isn't known."""
    source = rf"[\1]({config.repo_url.rstrip('/')}/blob/main/\2)" if config.repo_url else r"\1"
    return re.sub(r"\[([^]]*)\]\(\.\./([^)]*)\)", source, markdown)


def keys_page() -> str:
    """The page, in Markdown."""
    commands = [f"## depthreg {name}\n\n```text\n{help_text(name)}\n```\n" for name in APPLICATIONS]
    files = sorted(CONF_DIR.rglob("*.yaml"))
    groups = groupby((path for path in files if path.parent != CONF_DIR), lambda path: _group_and_choice(path)[0])
    sections = [line for group, paths in groups for line in (f"## {group}\n", *map(_choice, paths))]
    return "\n".join([_INTRODUCTION, *commands, *sections])


def _group_and_choice(path: Path) -> tuple[str, str]:
    """What to write on both sides of the = to choose a file: `experiment` and `ablation/no_ramp`."""
    parts = path.relative_to(CONF_DIR).with_suffix("").parts
    depth = 2 if parts[0] == "hydra" else 1
    return "/".join(parts[:depth]), "/".join(parts[depth:])


def _choice(path: Path) -> str:
    """A file of a group: its opening comment, what it is composed of, and a table of its own keys."""
    text = path.read_text(encoding="utf-8")
    opening = re.match(r"(?:#.*\n)*", text)
    said = [line.lstrip("# ") for line in opening[0].splitlines() if "@package" not in line] if opening else []
    said = [f"\n    {line}\n" if line.startswith("depthreg ") else line for line in said]
    parts = [part for part in _defaults(text) if part != "_self_"]
    composed = ["", "Composed of " + ", ".join(f"`{part}`" for part in parts) + ".", ""] if parts else [""]
    rows = ["| `{}` | `{}` | {} |".format(*(cell.replace("|", "\\|") for cell in row)) for row in rows_of(text)]
    table = ["| Key | Value | |", "|---|---|---|", *rows, ""] if rows else []
    return "\n".join(["### " + "=".join(_group_and_choice(path)) + "\n", *said, *composed, *table])


def _defaults(text: str) -> list[str]:
    """The other files that a configuration file takes over: a choice of its own group, or GROUP=CHOICE."""
    entries = (yaml.safe_load(text) or {}).get("defaults", [])
    pairs = (next(iter(entry.items())) if isinstance(entry, dict) else (entry,) for entry in entries)
    return ["=".join(part or "null" for part in pair).removeprefix("override ").lstrip("/") for pair in pairs]


def rows_of(text: str) -> Iterator[tuple[str, str, str]]:
    """Each key of a YAML file but for its defaults list: dotted, with its value and its comment as they are written."""
    lines = text.splitlines()
    told = set()  # lines whose comment stands in a row already: it is about the first of their keys

    def walk(node: yaml.Node, prefix: str) -> Iterator[tuple[str, str, str]]:
        if isinstance(node, yaml.MappingNode) and node.value:
            for key, value in node.value:
                if f"{prefix}{key.value}" != "defaults":
                    yield from walk(value, f"{prefix}{key.value}.")
            return
        written = " ".join(text[node.start_mark.index : node.end_mark.index].split())
        end = node.end_mark
        after = lines[end.line][end.column :] if end.line < len(lines) and end.line not in told else ""
        told.add(end.line)
        yield prefix[:-1], written, after.partition("# ")[2].strip()

    root = yaml.compose(text)
    if root is not None:
        yield from walk(root, "")
