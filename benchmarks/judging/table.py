"""The table of bars: what was measured, beside what, against which bar."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

HEADINGS = ("what", "ours", "beside", "compared", "bar", "aim", "met", "of")


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        part: Which of the parts it belongs to.
        what: What was measured, with its unit.
        ours: The network's figure.
        rivals: What it is compared with, by name.
        value: What the bar is about: a ratio, an error, a share.
        bar, aim: What has to be reached, and what is hoped for; None for a figure that has neither.
        most: Whether the value has to be at most, or at least, the bar.
        of: How many frames and draws.
    """

    part: str
    what: str
    ours: float
    rivals: Mapping[str, float] = field(default_factory=dict)
    value: float = math.nan
    bar: float | None = None
    aim: float | None = None
    most: bool = True
    of: str = ""

    def reaches(self, limit: float | None) -> bool | None:
        """Whether the value is at least as good as a limit; None where there is no limit."""
        if limit is None:
            return None
        return bool(self.value <= limit if self.most else self.value >= limit)

    @property
    def met(self) -> str:
        """In a word."""
        if self.bar is None:
            return ""
        if math.isnan(self.value):
            return "unknown"
        return "aim" if self.reaches(self.aim) else "yes" if self.reaches(self.bar) else "no"


def ratio_row(
    part: str,
    what: str,
    ours: float,
    rivals: Mapping[str, float],
    bar: float | None = None,
    aim: float | None = None,
    of: str = "",
) -> Row:
    """A row about the largest ratio of our error to a rival's."""
    ratios = [ours / theirs if theirs else (math.inf if ours else 1.0) for theirs in rivals.values()]
    return Row(part, what, ours, rivals, max(ratios), bar, aim, of=of)


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _limit(row: Row, limit: float | None) -> str:
    return "" if limit is None else f"{'<=' if row.most else '>='} {_number(limit)}"


def _cells(row: Row) -> list[str]:
    rivals = ", ".join(f"{name} {_number(value)}" for name, value in row.rivals.items())
    limits = [_limit(row, row.bar), _limit(row, row.aim)]
    return [row.what, _number(row.ours), rivals, _number(row.value), *limits, row.met, row.of]


def print_table(rows: Sequence[Row]) -> None:
    """Print the table, a part at a time."""
    table = Table(*HEADINGS, box=None, padding=(0, 1, 0, 0))
    part = None
    for row in rows:
        if row.part != part:
            table.add_row(f"[bold]{row.part}[/bold]")
            part = row.part
        style = {"no": "red", "yes": "green", "aim": "bold green"}.get(row.met)
        table.add_row(*_cells(row), style=style)
    Console(width=200).print(table)


def markdown(rows: Sequence[Row]) -> str:
    """The table in Markdown; `compared` is the largest ratio to a rival, or the figure itself."""
    lines = [["part", *HEADINGS], ["---", "---", "---:", "---", "---:", "---:", "---:", "---", "---"]]
    lines += [[row.part, *_cells(row)] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_json(rows: Sequence[Row], path: Path, **context: object) -> None:
    """Every figure in full; what is unknown is null."""

    def known(value: object) -> object:
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return {key: known(item) for key, item in value.items()} if isinstance(value, dict) else value

    content = {**context, "rows": [known({**asdict(row), "met": row.met}) for row in rows]}
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
