"""The table of `depthreg evaluate`, metrics down and methods across, for the terminal, CSV and Markdown."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path

from rich.table import Table

from depthreg.data import io
from depthreg.errors import InputError

Results = Mapping[str, Mapping[str, Mapping[str, float]]]  # task -> method -> metric -> value

OURS = "ours"
ALIGNED = "depth, aligned"  # completion, given colour that lines up with it
MISALIGNED = "depth, misaligned"
REGISTRATION = "registration"

SCORES = "metrics.csv"  # in a run's folder; written last, so where it is, the run has ended
LOWER, HIGHER, NEITHER = -1, 1, 0  # which way is better
METRICS = {
    "rmse_m": ("RMSE (m)", LOWER),
    "mae_m": ("MAE (m)", LOWER),
    "irmse_per_km": ("iRMSE (1/km)", LOWER),
    "imae_per_km": ("iMAE (1/km)", LOWER),
    "abs_rel": ("abs rel (1)", LOWER),
    "delta1": ("delta 1.25 (share)", HIGHER),
    "corner_error_px": ("corner mean (px)", LOWER),
    "corner_error_median_px": ("corner median (px)", LOWER),
    "share_under_1px": ("under 1 px (share)", HIGHER),
    "share_under_3px": ("under 3 px (share)", HIGHER),
    "share_under_5px": ("under 5 px (share)", HIGHER),
    "translation_px": ("translation (px)", LOWER),
    "rotation_deg": ("rotation (deg)", LOWER),
    "scale_pct": ("scale (%)", LOWER),
    "ssim": ("SSIM of colour (1)", HIGHER),
    "no_answer": ("no answer (share)", NEITHER),
    "seconds": ("time a frame (s)", NEITHER),
}


def method_names(results: Results) -> list[str]:
    """All methods, in the order in which the tasks name them."""
    return list(dict.fromkeys(method for methods in results.values() for method in methods))


def table_rows(results: Results) -> list[tuple[str, str, list[float]]]:
    """Task, metric, and a value for each of `method_names`, NaN where it has none; in `METRICS`' order."""
    rows = []
    for task, methods in results.items():
        for metric in METRICS:
            if any(metric in scores for scores in methods.values()):
                values = [methods.get(name, {}).get(metric, math.nan) for name in method_names(results)]
                rows.append((task, metric, values))
    return rows


def best_of(metric: str, values: list[float]) -> list[bool]:
    """Which of the values are the best ones; none where there is nothing to compare."""
    sign = METRICS[metric][1]
    known = [sign * value for value in values if not math.isnan(value)]
    return [len(set(known)) > 1 and sign * value == max(known) for value in values]


def _text(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def rich_table(results: Results, title: str) -> Table:
    """The table for a terminal; the best of each row is bold."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    table.add_column(no_wrap=True)
    for name in method_names(results):
        table.add_column(name, justify="right")
    section = None
    for task, metric, values in table_rows(results):
        if task != section:
            table.add_row(f"[bold]{task}[/bold]")
            section = task
        cells = [
            f"[bold]{_text(value)}[/bold]" if best else _text(value)
            for value, best in zip(values, best_of(metric, values), strict=True)
        ]
        table.add_row(f" {METRICS[metric][0]}", *cells)
    return table


def markdown(results: Results) -> str:
    """The table in Markdown; the best of each row is bold."""
    header = ["task", "metric", *method_names(results)]
    lines = [header, ["---", "---", *["---:"] * (len(header) - 2)]]
    for task, metric, values in table_rows(results):
        cells = [
            f"**{_text(value)}**" if best else _text(value)
            for value, best in zip(values, best_of(metric, values), strict=True)
        ]
        lines.append([task, METRICS[metric][0], *cells])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def read_report(folder: Path) -> Results:
    """Read the `metrics.csv` of `write_report`; what is unknown is left out.

    Raises:
        InputError: Unreadable, or another table.
    """
    path = folder / SCORES
    results: dict[str, dict[str, dict[str, float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                task, metric = row.pop("task"), row.pop("metric")
                for method, value in row.items():
                    scores = results.setdefault(task, {}).setdefault(method, {})
                    if value:
                        scores[metric] = float(value)
    except OSError as error:
        raise InputError(f"{path} can't be read: {error.strerror}") from error
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"{path} isn't a table of `depthreg evaluate`: task, metric and methods were expected"
        ) from error
    return results


def write_report(results: Results, folder: Path) -> None:
    """Write `metrics.csv` (full precision, empty where unknown) and `metrics.md` into an existing folder."""
    with io.atomic_write(folder / "metrics.md") as path:
        path.write_text(markdown(results), encoding="utf-8")
    with io.atomic_write(folder / SCORES) as path, path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "metric", *method_names(results)])
        for task, metric, values in table_rows(results):
            writer.writerow([task, metric, *("" if math.isnan(value) else repr(value) for value in values)])
