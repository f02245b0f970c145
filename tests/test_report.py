import csv
import io
import math

import pytest
from rich.console import Console

from depthreg.report import METRICS, best_of, markdown, rich_table, write_report

RESULTS = {
    "depth": {"ours": {"rmse_m": 1.25, "delta1": 0.9}, "theirs": {"rmse_m": 2.5, "delta1": 0.95}},
    "registration": {"ours": {"corner_error_px": math.nan}, "identity": {"corner_error_px": 1 / 3}},
}


@pytest.mark.parametrize(
    ("metric", "values", "best"),
    [
        ("rmse_m", [2.0, 1.0, math.nan], [False, True, False]),
        ("delta1", [0.9, 0.8, 0.9], [True, False, True]),
        ("irmse_per_km", [math.inf, 3.0], [False, True]),
        ("rmse_m", [1.0, math.nan], [False, False]),  # alone, it is no better than anything
        ("seconds", [1.0, 2.0], [False, False]),  # an answer that is fast and wrong isn't best
    ],
)
def test_the_best_is_the_lowest_error_or_the_highest_share(metric, values, best):
    assert best_of(metric, values) == best


def test_markdown_marks_the_best_even_where_it_is_not_ours():
    lines = markdown(RESULTS).splitlines()
    assert lines[0] == "| task | metric | ours | theirs | identity |"
    assert "| depth | RMSE (m) | **1.250** | 2.500 | - |" in lines
    assert "| depth | delta 1.25 (share) | 0.900 | **0.950** | - |" in lines
    assert "| registration | corner mean (px) | - | - | 0.333 |" in lines


def test_the_terminal_table_fits_into_80_columns():
    methods = ["ours", "nearest", "linear", "IP-Basic", "identity", "ECC", "Mattes MI"]
    full = {"registration": {method: dict.fromkeys(METRICS, 123.456) for method in methods}}
    console = Console(width=80, file=io.StringIO())
    console.print(rich_table(full, "title"))
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 3 + len(METRICS)  # title, header, task: no line was broken
    assert all(line.count("123.456") == len(methods) for line in lines[3:])


def test_csv_keeps_full_precision_and_leaves_the_unknown_empty(tmp_path):
    write_report(RESULTS, tmp_path)
    with (tmp_path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["identity"]) == 1 / 3
    assert rows[-1]["ours"] == ""
    assert rows[0] == {"task": "depth", "metric": "rmse_m", "ours": "1.25", "theirs": "2.5", "identity": ""}
    assert (tmp_path / "metrics.md").read_text() == markdown(RESULTS)
