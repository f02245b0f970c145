"""The curves of `depthreg evaluate` as one HTML file that needs no network."""

import math
from collections.abc import Sequence
from pathlib import Path

import plotly.graph_objects as go
from plotly.colors import qualitative
from plotly.subplots import make_subplots

from depthreg.data import io
from depthreg.evaluation.curves import AXES, IDENTITY, UNREGISTERED, CurveError
from depthreg.report import METRICS, OURS

_COLORS = dict(zip((OURS, UNREGISTERED, "nearest", "linear", "IP-Basic", IDENTITY), qualitative.T10, strict=False))
_COLUMNS = 2
_ROW_PX = 340


def write_page(errors: Sequence[CurveError], path: Path, title: str) -> None:
    """Draw pooled errors, a plot for each curve and metric."""
    with io.atomic_write(path) as temporary:
        curve_figure(errors, title).write_html(temporary, include_plotlyjs=True, config={"displaylogo": False})


def curve_figure(errors: Sequence[CurveError], title: str) -> go.Figure:
    """A plot for each curve and metric, two a row, a line for each method."""
    plots = list(dict.fromkeys((error.curve, error.metric) for error in _in_order(errors)))
    rows = math.ceil(len(plots) / _COLUMNS)
    figure = make_subplots(
        rows,
        _COLUMNS,
        horizontal_spacing=0.1,
        vertical_spacing=0.28 / rows,
        subplot_titles=[f"{METRICS[metric][0]} over {AXES[curve].title}" for curve, metric in plots],
    )
    named: set[str] = set()
    for number, (curve, metric) in enumerate(plots):
        row, column = number // _COLUMNS + 1, number % _COLUMNS + 1
        some = [error for error in errors if (error.curve, error.metric) == (curve, metric)]
        for method in dict.fromkeys(error.method for error in some):
            figure.add_trace(_line(curve, method, some, shown=method not in named), row, column)
            named.add(method)
        figure.update_xaxes(type="linear" if curve == "misalignment" else "category", row=row, col=column)
        figure.update_yaxes(rangemode="tozero", row=row, col=column)
    figure.update_layout(
        title=title, template="plotly_white", height=_ROW_PX * rows + 120, legend={"orientation": "h", "y": -0.05}
    )
    return figure


def _in_order(errors: Sequence[CurveError]) -> list[CurveError]:
    """Curve by curve, the more usual metric first."""
    curves, metrics = list(AXES), list(METRICS)
    return sorted(errors, key=lambda error: (curves.index(error.curve), metrics.index(error.metric)))


def _line(curve: str, method: str, errors: Sequence[CurveError], shown: bool) -> go.Scatter:
    points = [error for error in errors if error.method == method]
    return go.Scatter(
        x=[label(curve, error.condition) for error in points],
        y=[error.value for error in points],
        name=method,
        legendgroup=method,
        showlegend=shown,
        mode="lines+markers",
        line={"color": _COLORS.get(method), "width": 3 if method == OURS else 1.5},
        customdata=[[error.weight] for error in points],
        hovertemplate="%{y:.3f} (%{customdata[0]:.0f} " + ("pixels)" if AXES[curve].edges else "frames)"),
    )


def label(curve: str, condition: float) -> str:
    """A condition as an axis names it: a number, or a bin's two edges."""
    edges = AXES[curve].edges
    if not edges:
        return f"{condition:g}"
    upper = edges[edges.index(condition) + 1]
    return f"{condition:g} or more" if math.isinf(upper) else f"{condition:g} to {upper:g}"
