"""Loss curves of each stage, with difficulty and freezing under them on the same epoch axis (the paper's Figure 7)."""

import html
import math
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.colors import hex_to_rgb, qualitative
from plotly.subplots import make_subplots

from depthreg.comparison.rows import Row
from depthreg.comparison.runs import Curve, StageLog

LOSSES = {"val/loss": "validation loss", "train/loss": "training loss"}
DIFFICULTY = "train/difficulty"
DETAIL = "detail"  # name of what the page can leave out: bands and single seeds
FROZEN = "frozen/"  # with a module's name: 1 in epochs in which it doesn't learn

_COLORS = qualitative.T10
_DASHES = ("solid", "dash", "dot", "dashdot")
_LANE_PX = 26  # height of a module in the freezing plot


def row_color(index: int) -> str:
    """Of a row in curves, table and pictures; after ten rows colours return with another dash."""
    return _COLORS[index % len(_COLORS)]


def row_dash(index: int) -> str:
    """The line style that goes with `row_color`."""
    return _DASHES[index // len(_COLORS) % len(_DASHES)]


def stages_of(rows: Sequence[Row]) -> list[str]:
    """Every stage that any run has begun, in the order in which the first run that has it walked it."""
    return list(dict.fromkeys(name for row in rows for run in row.runs for name in run.stages))


def mean_curve(curves: Sequence[Curve]) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Mean and sample standard deviation of curves over the epochs that all of them have.

    Returns:
        Epochs, means (E,), deviations (E,); the latter are NaN for a single curve.
    """
    epochs = sorted(set.intersection(*(set(curve) for curve in curves))) if curves else []
    values = np.array([[curve[epoch] for epoch in epochs] for curve in curves])
    if len(curves) < 2:
        return epochs, values.reshape(-1), np.full(len(epochs), math.nan)
    with np.errstate(invalid="ignore"):  # a diverged seed
        return epochs, values.mean(axis=0), values.std(axis=0, ddof=1)


def stage_figure(rows: Sequence[Row], stage: str) -> go.Figure:
    """One stage's curves: losses, difficulty, and a lane for each module that is frozen in some row's epochs."""
    logs = {i: [run.stages[stage] for run in row.runs if stage in run.stages] for i, row in enumerate(rows)}
    modules = _frozen_modules(logs)
    freezing_px = _LANE_PX * len(modules)
    heights = [200, 150, 70, *([freezing_px] if modules else [])]
    titles = [*LOSSES.values(), "difficulty", *(["frozen modules"] if modules else [])]
    figure = make_subplots(
        len(heights), 1, shared_xaxes=True, row_heights=heights, vertical_spacing=0.06, subplot_titles=titles
    )
    for i, row in enumerate(rows):
        for place, column in enumerate(LOSSES, start=1):
            figure.add_traces(_loss_traces(row, i, logs[i], column), place, 1)
        figure.add_traces(_difficulty_trace(row, i, logs[i]), 3, 1)
        if modules:
            figure.add_traces(_freezing_traces(row, i, len(rows), logs[i], modules), 4, 1)
    epochs = max(log.epochs for some in logs.values() for log in some)
    _style(figure, modules, max(epochs, 1), sum(heights) + 40 * len(heights) + 40)
    return figure


def _loss_traces(row: Row, index: int, logs: Sequence[StageLog], column: str) -> list[go.Scatter]:
    """Single seeds thin, their mean thick, and a band of one standard deviation."""
    curves = [_finite(log.curves.get(column, {})) for log in logs]
    epochs, mean, std = mean_curve([curve for curve in curves if curve])
    traces = []
    if len(curves) > 1:
        traces = [_band(index, epochs, mean, std), _singles(index, curves)]
        for trace in traces:
            trace.name = DETAIL
    deviations = ["" if math.isnan(value) else f" ± {value:.3g}" for value in std]
    label = f"<b>%{{y:.4g}}</b>%{{text}} {_hover_name(row)}<extra></extra>"
    return [*traces, _scatter(index, epochs, mean.tolist(), width=2.2, text=deviations, hovertemplate=label)]


def _hover_name(row: Row) -> str:
    """In Plotly's HTML, short lines."""
    return "<br>".join(html.escape(line) for line in textwrap.wrap(row.name, 40))


def _scatter(
    index: int, x: Sequence[int | None], y: Sequence[float | None], width: float, **options: object
) -> go.Scatter:
    """A line in the row's colour; the page finds what belongs to a row by `meta`."""
    line = {"color": row_color(index), "width": width, "dash": row_dash(index)}
    mode = "lines+markers" if len(x) == 1 else "lines"
    return go.Scatter(x=list(x), y=list(y), mode=mode, line=line, meta=index, showlegend=False, **options)


def _band(index: int, epochs: Sequence[int], mean: np.ndarray, std: np.ndarray) -> go.Scatter:
    low, high = (mean - std).tolist(), (mean + std).tolist()
    fill = f"rgba{(*hex_to_rgb(row_color(index)), 0.16)}"
    around = _scatter(index, [*epochs, *reversed(epochs)], [*high, *reversed(low)], width=0, hoverinfo="skip")
    return around.update(fill="toself", fillcolor=fill, mode="lines")


def _singles(index: int, curves: Sequence[Curve]) -> go.Scatter:
    """All seeds in one trace, parted by gaps."""
    x: list[int | None] = []
    y: list[float | None] = []
    for curve in curves:
        x += [*sorted(curve), None]
        y += [*(curve[epoch] for epoch in sorted(curve)), None]
    return _scatter(index, x, y, width=0.8, opacity=0.5, hoverinfo="skip")


def _finite(curve: Curve) -> Curve:
    return {epoch: value for epoch, value in curve.items() if math.isfinite(value)}


def _difficulty_trace(row: Row, index: int, logs: Sequence[StageLog]) -> list[go.Scatter]:
    epochs, mean, _ = mean_curve([log.curves[DIFFICULTY] for log in logs if DIFFICULTY in log.curves])
    label = f"<b>%{{y:.2f}}</b> {_hover_name(row)}<extra></extra>"
    return [_scatter(index, epochs, mean.tolist(), width=1.8, hovertemplate=label)] if epochs else []


def _frozen_modules(logs: Mapping[int, Sequence[StageLog]]) -> list[str]:
    """Modules that don't learn in some epoch of any row, in the log's order."""
    curves = [item for some in logs.values() for log in some for item in log.curves.items()]
    frozen = (column for column, curve in curves if column.startswith(FROZEN) and frozen_spans(curve))
    return list(dict.fromkeys(column.removeprefix(FROZEN) for column in frozen))


def _freezing_traces(
    row: Row, index: int, count: int, logs: Sequence[StageLog], modules: Sequence[str]
) -> list[go.Bar]:
    """Bars over the epochs in which a module is frozen: each row has a narrow lane in the module's one."""
    if not logs:
        return []
    curves = max(logs, key=lambda log: log.epochs).curves  # the same in every seed, as far as it has come
    spans = [(m, *span) for m, name in enumerate(modules) for span in frozen_spans(curves.get(FROZEN + name, {}))]
    lane = 0.8 / count
    bar = go.Bar(
        base=[first - 0.5 for _, first, _ in spans],
        x=[last - first + 1 for _, first, last in spans],
        y=[m - 0.4 + lane * (index + 0.5) for m, *_ in spans],
        width=lane,
        orientation="h",
        marker={"color": row_color(index), "line": {"width": 0}},
        customdata=[f"{modules[m]}, epochs {first} to {last}" for m, first, last in spans],
        hovertemplate=f"frozen: %{{customdata}}<br>{_hover_name(row)}<extra></extra>",
        meta=index,
        showlegend=False,
    )
    return [bar]


def frozen_spans(curve: Curve) -> list[tuple[int, int]]:
    """First and last epoch of each stretch in which a module is frozen."""
    spans: list[tuple[int, int]] = []
    for epoch in sorted(epoch for epoch, value in curve.items() if value > 0.5):
        if spans and spans[-1][1] == epoch - 1:
            spans[-1] = (spans[-1][0], epoch)
        else:
            spans.append((epoch, epoch))
    return spans


def _style(figure: go.Figure, modules: Sequence[str], epochs: int, height: int) -> None:
    """Colours of text and grid are the page's, which knows whether it is dark."""
    figure.update_layout(
        template=None,
        height=height,
        margin={"l": 84, "r": 12, "t": 30, "b": 44},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        hovermode="closest",
        barmode="overlay",
        font={"family": "inherit", "size": 12},
    )
    figure.update_annotations(font={"size": 12}, x=0, xanchor="left")
    # Whole epochs alone have ticks.
    figure.update_xaxes(zeroline=False, range=[-0.5, epochs - 0.5], dtick=1 if epochs < 8 else None, tickformat="d")
    figure.update_yaxes(zeroline=False)
    figure.update_yaxes(range=[-0.03, 1.06], tickvals=[0, 0.5, 1], row=3)
    if modules:
        ticks = {"tickvals": list(range(len(modules))), "ticktext": list(modules)}
        figure.update_yaxes(range=[len(modules) - 0.5, -0.5], showgrid=False, row=4, **ticks)
    figure.update_xaxes(title="epoch", row=len(figure.layout.annotations))
