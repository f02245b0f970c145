"""One HTML page that needs nothing but itself: table, curves, pictures, configurations."""

import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, FileSystemLoader
from plotly.offline import get_plotlyjs

from depthreg import __version__
from depthreg.comparison.curves import row_color, stage_figure, stages_of
from depthreg.comparison.pictures import Album, make_album
from depthreg.comparison.rows import Column, Row, best_rows, columns
from depthreg.comparison.tables import MAIN
from depthreg.report import HIGHER, LOWER, METRICS

_HERE = Path(__file__).parent
_ARROWS = {LOWER: " ↓", HIGHER: " ↑"}


def render_page(rows: Sequence[Row], notes: Sequence[str], title: str, reference: Row | None = None) -> str:
    """The page as HTML, with differences from a reference; whatever comes from a configuration is escaped."""
    environment = Environment(loader=FileSystemLoader(_HERE), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    album, stages = make_album(rows), stages_of(rows)
    sets = _column_sets(columns(rows))
    return environment.get_template("page.html").render(
        title=title,
        date=f"{datetime.now():%Y-%m-%d %H:%M}",
        version=__version__,
        revisions=list(dict.fromkeys(run.revision for row in rows for run in row.runs)),
        notes=notes,
        sets=list(sets),
        columns=[_heading(column, sets) for column in columns(rows)],
        rows=_described(rows, sets, reference),
        reference=reference.name if reference else "",
        stages=stages,
        album={**vars(album.choice), "shown": len(album.images), "found": album.found},
        data=_data(rows, stages, album),
        css=(_HERE / "page.css").read_text(encoding="utf-8"),
        js=(_HERE / "page.js").read_text(encoding="utf-8"),
        plotly=get_plotlyjs(),
    )


def _column_sets(shown: Sequence[Column]) -> dict[str, list[Column]]:
    """What the table shows at a time: the main scores, or all of a task."""
    tasks = dict.fromkeys(task for task, _ in shown)
    main = [column for column in MAIN if column in shown]
    return {"main": main} | {task: [column for column in shown if column[0] == task] for task in tasks}


def _sets_of(column: Column, sets: Mapping[str, Sequence[Column]]) -> list[int]:
    return [i for i, members in enumerate(sets.values()) if column in members]


def _heading(column: Column, sets: Mapping[str, Sequence[Column]]) -> dict[str, Any]:
    task, metric = column
    name, direction = METRICS[metric]
    return {"task": task, "name": name, "arrow": _ARROWS.get(direction, ""), "sets": _sets_of(column, sets)}


def _described(
    rows: Sequence[Row], sets: Mapping[str, Sequence[Column]], reference: Row | None
) -> list[dict[str, Any]]:
    """What the page says of each row."""
    best = {column: best_rows(rows, column) for column in columns(rows)}
    return [
        {
            "name": row.name,
            "color": row_color(i),
            "tooltip": "\n".join(f"{key}: {'not there' if v is None else v}" for key, v in row.differences.items()),
            "state": row.state,
            "n": len(row.finished),
            "steps": row.count("steps"),
            "steps_value": max(run.steps for run in row.runs),
            "frames": row.count("frames"),
            "frames_value": max(run.frames for run in row.runs),
            "scores": [_score(row, column, best[column][i], sets, reference) for column in best],
            "differences": row.differences,
            "runs": row.runs,
            "config": yaml.safe_dump(dict(row.runs[0].config), sort_keys=False, allow_unicode=True),
        }
        for i, row in enumerate(rows)
    ]


def _score(
    row: Row, column: Column, best: bool, sets: Mapping[str, Sequence[Column]], reference: Row | None
) -> dict[str, Any]:
    score = row.score(column)
    known, spread = not math.isnan(score.mean), not math.isnan(score.std)
    each = (f"seed {run.seed}: {value:.4f}" for run, value in zip(row.finished, score.values, strict=True))
    return {
        "value": score.mean if known else "",
        "mean": f"{score.mean:.3f}" if known else "-",
        "std": f"{score.std:.3f}" if known and spread else "",
        "difference": row.difference(reference, column).signed if reference and row is not reference else "",
        "title": "\n".join(each),
        "best": best,
        "sets": _sets_of(column, sets),
    }


def _data(rows: Sequence[Row], stages: Sequence[str], album: Album) -> dict[str, Any]:
    """What the page's script draws."""
    numbers = {path: i for i, path in enumerate(album.images)}
    shown: dict[str, dict[int, int]] = {}
    for (seed, moment, frame, row), path in album.paths.items():
        shown.setdefault(f"{seed},{moment},{frame}", {})[row] = numbers[path]
    return {
        "rows": [{"name": row.name, "color": row_color(i)} for i, row in enumerate(rows)],
        "figures": [json.loads(stage_figure(rows, stage).to_json()) for stage in stages],
        "moments": [str(moment) for moment in album.choice.moments],
        "images": [{"file": str(path), "source": source} for path, source in album.images.items()],
        "shown": shown,
    }
