"""The comparison as tables: for the terminal, Markdown and CSV."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from depthreg.comparison.rows import Column, Row, best_rows, columns
from depthreg.report import METRICS, MISALIGNED, REGISTRATION

# Enough to rank by, and few enough for a terminal.
MAIN: list[Column] = [(MISALIGNED, "rmse_m"), (MISALIGNED, "mae_m"), (REGISTRATION, "corner_error_px")]


def rich_table(rows: Sequence[Row], title: str) -> Table:
    """The main scores for a terminal; the best of each column is bold."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    shown = [column for column in MAIN if column in columns(rows)]
    table.add_column("configuration", overflow="fold", min_width=24)
    table.add_column("n", justify="right")
    table.add_column("steps", justify="right", no_wrap=True)
    for task, metric in shown:
        table.add_column("\n".join([*task.split(" "), METRICS[metric][0]]), justify="right", no_wrap=True)
    best = [best_rows(rows, column) for column in shown]
    for i, row in enumerate(rows):
        cells = [
            f"[bold]{row.score(column)}[/bold]" if marks[i] else str(row.score(column))
            for column, marks in zip(shown, best, strict=True)
        ]
        state = "" if row.state == "finished" else f"\n[yellow]{escape(row.state)}[/yellow]"
        table.add_row(escape(row.name) + state, str(len(row.finished)), row.count("steps"), *cells)
    return table


def markdown(rows: Sequence[Row], notes: Sequence[str]) -> str:
    """A table for each task, and the notes; the best of each column is bold."""
    parts = ["".join(f"- {_plain(note)}\n" for note in notes)] if notes else []
    shown = columns(rows)
    for task in dict.fromkeys(task for task, _ in shown) or [""]:
        of_task = [column for column in shown if column[0] == task]
        head = ["configuration", "n", "steps", *(METRICS[metric][0] for _, metric in of_task), "state"]
        lines = [head, ["---", *["---:"] * (len(head) - 2), "---"]]
        best = [best_rows(rows, column) for column in of_task]
        for i, row in enumerate(rows):
            scores = [(str(row.score(column)), marks[i]) for column, marks in zip(of_task, best, strict=True)]
            cells = [f"**{text}**" if marked else text for text, marked in scores]
            lines.append([_plain(row.name), str(len(row.finished)), row.count("steps"), *cells, _plain(row.state)])
        parts.append((f"## {task}\n\n" if task else "") + "".join(f"| {' | '.join(line)} |\n" for line in lines))
    parts.append("Mean ± standard deviation (of the sample) over the n seeds that finished; bold is the best mean.\n")
    return "\n".join(parts)


def _plain(text: str) -> str:
    """Names come from configurations: nothing in them is Markdown."""
    return "".join(f"\\{letter}" if letter in "\\`*_{}[]<>()#|" else letter for letter in text)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line for each row and score, in full precision: mean, std, n, and the value of each seed."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        head = ["configuration", "state", "steps", "task", "metric", "mean", "std", "n", "seeds", "values", "best"]
        writer.writerow(head)
        for column in columns(rows):
            for row, best in zip(rows, best_rows(rows, column), strict=True):
                score = row.score(column)
                seeds, values = (" ".join(map(str, items)) for items in ([r.seed for r in row.finished], score.values))
                numbers = ["" if math.isnan(number) else repr(number) for number in (score.mean, score.std)]
                count = len(row.finished)
                writer.writerow(
                    [row.name, row.state, row.count("steps"), *column, *numbers, count, seeds, values, best]
                )
