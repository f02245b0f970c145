"""A rig's misalignment over time: as one HTML file that needs no network, and in words."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import torch
from plotly.subplots import make_subplots

from depthreg.data import io
from depthreg.rig import MIN_TRUST, PARAMETERS, FrameAffine, Rig, parameters_of

WELL_ALIGNED_PX = 1.0  # mean distance of the corners from where they belong
_TITLES = {"x_px": "x (px)", "y_px": "y (px)", "rotation_deg": "rotation (deg)", "scale_percent": "scale (%)"}
_NAMES = {"x_px": "x", "y_px": "y", "rotation_deg": "rotation", "scale_percent": "scale"}
_DIGITS = {"px": 1, "deg": 2, "%": 2}
_ROW_PX = 210
_TRUSTED, _LEFT_OUT, _TREND = "#4c78a8", "#bbbbbb", "#e45756"


def write_page(path: Path, rig: Rig, frames: Sequence[FrameAffine], unit: str) -> None:
    """Draw each parameter over time, `unit` being that of the frames' times."""
    with io.atomic_write(path) as temporary:
        figure = rig_figure(rig, frames, unit)
        figure.write_html(temporary, include_plotlyjs=True, config={"displaylogo": False})


def rig_figure(rig: Rig, frames: Sequence[FrameAffine], unit: str) -> go.Figure:
    """A plot for each parameter: a point for each frame, and the trend with the scatter about it as a band."""
    frames = sorted(frames, key=lambda frame: frame.time)
    times = np.array([frame.time for frame in frames]) - frames[0].time
    trusted = np.array([frame.trust >= MIN_TRUST for frame in frames])
    affines = torch.tensor(np.array([frame.affine_rgb_from_depth for frame in frames]), dtype=torch.float64)
    figure = make_subplots(len(PARAMETERS), 1, shared_xaxes=True, vertical_spacing=0.03)
    for row, (name, values) in enumerate(parameters_of(affines, (rig.height, rig.width)).items(), start=1):
        figure.add_traces(_band(rig, name, times, times[trusted] if trusted.any() else times), row, 1)
        for used, color in ((True, _TRUSTED), (False, _LEFT_OUT)):
            figure.add_trace(_points(frames, times, values, trusted == used, used, color, shown=row == 1), row, 1)
        figure.update_yaxes(title=_TITLES[name], row=row, col=1)
    figure.update_xaxes(title=f"time ({unit})" if unit == "s" else "frame", row=len(PARAMETERS), col=1)
    legend = {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 1, "xanchor": "right"}
    title = {"text": "<br>".join(describe(rig, unit)), "font": {"size": 14}, "y": 0.98, "yanchor": "top"}
    height = _ROW_PX * len(PARAMETERS) + 150
    figure.update_layout(title=title, template="plotly_white", height=height, legend=legend, margin={"t": 130})
    return figure


def _points(
    frames: Sequence[FrameAffine],
    times: np.ndarray,
    values: np.ndarray,
    mask: np.ndarray,
    used: bool,
    color: str,
    shown: bool,
) -> go.Scatter:
    kept = np.flatnonzero(mask).tolist()
    return go.Scatter(
        x=times[kept],
        y=values[kept],
        name="frames" if used else f"frames left out: trust below {MIN_TRUST:g}",
        legendgroup=str(used),
        showlegend=shown and bool(kept),
        mode="markers",
        marker={"color": color, "size": 5, "symbol": "circle" if used else "circle-open"},
        customdata=[[frames[i].name, frames[i].trust] for i in kept],
        hovertemplate="%{y:.3f}<br>%{customdata[0]}, trust %{customdata[1]:.2f}<extra></extra>",
    )


def _band(rig: Rig, name: str, times: np.ndarray, used: np.ndarray) -> list[go.Scatter]:
    """The trend through the median, and one scatter above and below it."""
    trend = rig.parameters[name]
    ends = np.array([times[0], times[-1]])
    span = float(np.ptp(used)) or 1.0
    middle = trend.median + trend.change / span * (ends - np.median(used)) * trend.drifts
    bounds = [*(middle + trend.scatter), *(middle - trend.scatter)[::-1]]
    shared = {"showlegend": False, "hoverinfo": "skip"}
    area = {"fill": "toself", "fillcolor": "rgba(228, 87, 86, 0.15)", "line": {"width": 0}, "mode": "lines"}
    return [
        go.Scatter(x=[*ends, *ends[::-1]], y=bounds, **area, **shared),
        go.Scatter(x=ends, y=middle, mode="lines", line={"color": _TREND}, **shared),
    ]


def describe(rig: Rig, unit: str) -> list[str]:
    """The summary in words, a sentence each: how far off, how much frames differ, and whether that changes."""
    median = {name: trend.median for name, trend in rig.parameters.items()}
    scatter = {name: trend.scatter for name, trend in rig.parameters.items()}
    off = (
        "({x_px:+.1f}, {y_px:+.1f}) px, {rotation_deg:+.2f} deg, {scale_percent:+.2f} %".format(**median)
        + f"; the corners by {rig.corner_px:.1f} px"
    )
    spread = "({x_px:.1f}, {y_px:.1f}) px, {rotation_deg:.2f} deg, {scale_percent:.2f} %".format(**scatter)
    doubt = "" if rig.frames_used else ", says the network, which trusts none of these frames"
    return [
        f"colour is off by {off}{doubt}",
        f"single frames scatter by {spread} about that",
        _verdict(rig, unit),
    ]


def _verdict(rig: Rig, unit: str) -> str:
    counted = f"{rig.frames_used} of {rig.frames} frames that the network trusts"
    if rig.verdict == "too few frames":
        return f"{counted} are too few to tell whether it is constant"
    over = f"over {rig.duration:.1f} s" if unit == "s" else f"over {rig.frames} frames"
    if rig.verdict == "constant":
        kind = "well aligned" if rig.corner_px < WELL_ALIGNED_PX else "as a mounting error is"
        return f"constant {over}, {kind}, by {counted}"
    changes = [
        f"{_NAMES[name]} by {trend.change:+.{_DIGITS[PARAMETERS[name]]}f} {PARAMETERS[name]}"
        for name, trend in rig.parameters.items()
        if trend.drifts
    ]
    return f"drifts {over}: {', '.join(changes)}, by {counted}"
