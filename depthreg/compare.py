"""`depthreg compare`: what changing one thing did, from the folders of runs alone."""

import argparse
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from depthreg.comparison.page import render_page
from depthreg.comparison.rows import find_row, make_rows, warnings
from depthreg.comparison.runs import find_runs, read_run
from depthreg.comparison.tables import markdown, rich_table, write_csv
from depthreg.data import io
from depthreg.errors import ArgumentParser


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="depthreg compare",
        description="Compare runs of `depthreg train`. Those that differ in the seed alone make one row: mean and "
        "standard deviation.",
        epilog="Writes compare.html (table, curves by stage, pictures; opens without a network), compare.md and "
        "compare.csv.",
    )
    help_folders = "a run, or a folder with runs below it, such as a sweep"
    parser.add_argument("folders", type=Path, nargs="+", metavar="RUN", help=help_folders)
    default = Path("runs") / f"compare_{datetime.now():%Y-%m-%d_%H-%M-%S}"
    help_out = "new or empty folder; by default runs/compare_<date>_<time>"
    help_against = "name of a row, or its end: every score also as a difference from that row's, seed by seed"
    parser.add_argument("--against", metavar="ROW", help=help_against)
    parser.add_argument("--out", type=Path, default=default, metavar="FOLDER", help=help_out)
    return parser.parse_args(argv)


def main(argv: Sequence[str]) -> int:
    """Run `depthreg compare RUN ...`: everything is read before anything is written."""
    options = _parse(argv)
    io.check_new_folder(options.out)
    folders, lost = find_runs(options.folders)
    runs = [read_run(folder) for folder in folders]
    rows = make_rows(runs)
    reference = find_row(rows, options.against) if options.against else None
    notes = [f"{job} failed before it began to train." for job in lost] + warnings(rows)
    title = f"{len(rows)} configuration{'s' * (len(rows) != 1)}, {len(runs)} run{'s' * (len(runs) != 1)}"
    page = render_page(rows, notes, title, reference)
    with io.atomic_folder(options.out) as folder:
        (folder / "compare.html").write_text(page, encoding="utf-8")
        (folder / "compare.md").write_text(f"# {title}\n\n{markdown(rows, notes, reference)}", encoding="utf-8")
        write_csv(folder / "compare.csv", rows, reference)
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, 120)  # a file has room for every column
    console.print(rich_table(rows, title, reference))
    for note in notes:
        console.print(f"[yellow]note[/yellow]  {escape(note)}", soft_wrap=True, highlight=False)
    console.print(f"page  {options.out / 'compare.html'}", soft_wrap=True, highlight=False)
    return 0
