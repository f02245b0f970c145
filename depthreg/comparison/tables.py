"""The comparison as tables: for the terminal, Markdown and CSV."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from depthreg.comparison.rows import Column, Row, Spread, best_rows, columns
from depthreg.report import METRICS, MISALIGNED, REGISTRATION

# Enough to rank by, and few enough for a terminal.
MAIN: list[Column] = [(MISALIGNED, "rmse_m"), (MISALIGNED, "mae_m"), (REGISTRATION, "corner_error_px")]


def rich_table(rows: Sequence[Row], title: str, reference: Row | None = None) -> Table:
    """The main scores for a terminal, and how they differ from a reference's; the best of each column is bold."""
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
            (f"[bold]{row.score(column)}[/bold]" if marks[i] else str(row.score(column)))
            + (f"\n[dim]{row.difference(reference, column).signed}[/dim]" if reference and row is not reference else "")
            for column, marks in zip(shown, best, strict=True)
        ]
        state = "" if row.state == "finished" else f"\n[yellow]{escape(row.state)}[/yellow]"
        table.add_row(escape(row.name) + state, str(len(row.finished)), row.count("steps"), *cells)
    return table


def markdown(rows: Sequence[Row], notes: Sequence[str], reference: Row | None = None) -> str:
    """A table for each task, and the notes; the best of each column is bold.

    Beside each score stands how it differs from a reference's, where there is one.
    """
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
            if reference and row is not reference:
                found = (row.difference(reference, column).signed for column in of_task)
                cells = [f"{cell} ({difference})" for cell, difference in zip(cells, found, strict=True)]
            lines.append([_plain(row.name), str(len(row.finished)), row.count("steps"), *cells, _plain(row.state)])
        parts.append((f"## {task}\n\n" if task else "") + "".join(f"| {' | '.join(line)} |\n" for line in lines))
    told = "Mean ± standard deviation (of the sample) over the n seeds that finished; bold is the best mean."
    if reference:
        told += f" In parentheses, the difference from {_plain(reference.name)}, seed by seed."
    parts.append(told + "\n")
    return "\n".join(parts)


def _plain(text: str) -> str:
    """Names come from configurations: nothing in them is Markdown."""
    return "".join(f"\\{letter}" if letter in "\\`*_{}[]<>()#|" else letter for letter in text)


def write_csv(path: Path, rows: Sequence[Row], reference: Row | None = None) -> None:
    """One line for each row and score, in full precision: mean, std, n, the value of each seed, the differences."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        head = ["configuration", "state", "steps", "task", "metric", "mean", "std", "n", "seeds", "values", "best"]
        head += [f"difference_{part}" for part in ("mean", "std")] if reference else []
        writer.writerow(head)
        for column in columns(rows):
            for row, best in zip(rows, best_rows(rows, column), strict=True):
                score = row.score(column)
                seeds, values = (" ".join(map(str, items)) for items in ([r.seed for r in row.finished], score.values))
                numbers = _in_full(score)
                differences = _in_full(row.difference(reference, column)) if reference else []
                count = len(row.finished)
                writer.writerow(
                    [
                        row.name,
                        row.state,
                        row.count("steps"),
                        *column,
                        *numbers,
                        count,
                        seeds,
                        values,
                        best,
                        *differences,
                    ]
                )


def _in_full(score: Spread) -> list[str]:
    return ["" if math.isnan(number) else repr(number) for number in (score.mean, score.std)]
