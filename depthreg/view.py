"""`depthreg complete --view` and `--rrd`: what became of each frame, in Rerun, on one timeline."""

import os
import sys
import sysconfig
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from depthreg.data.io import atomic_write
from depthreg.errors import InputError
from depthreg.result import Result
from depthreg.viz import depth_edges

SUFFIX = ".rrd"
_JPEG_QUALITY = 90
_POINT_PX = 1.5
_EDGE_RGBA = (80, 255, 80, 255)


def check(show: bool, path: Path | None) -> None:
    """Refuse what can't be shown or saved, before any work.

    Args:
        show: Whether a viewer is wanted.
        path: Of the recording, or None for none.

    Raises:
        InputError: Rerun isn't installed, there is no screen, or the file can't be made.
    """
    if not (show or path):
        return
    if find_spec("rerun") is None:
        raise InputError("--view and --rrd need Rerun: expected pip install 'depthreg[view]' before it")
    if show and sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("--view needs a screen, and there is none: expected --rrd FILE, to look at elsewhere")
    if path is None:
        return
    if path.suffix != SUFFIX:
        raise InputError(f"--rrd {path} must end in {SUFFIX}, as Rerun's recordings do")
    if path.exists():
        raise InputError(f"--rrd {path} is there already: a new file was expected")
    if not (path.absolute().parent.is_dir() and os.access(path.absolute().parent, os.W_OK | os.X_OK)):
        raise InputError(f"--rrd {path} can't be written: a folder that is there and writable was expected")


@contextmanager
def open_log(show: bool, path: Path | None) -> Iterator["FrameLog | None"]:
    """Log frames into a viewer, a file or both; the file appears when the block ends well.

    Args:
        show: Whether to open a viewer, which stays open.
        path: Of the recording, or None for none.

    Yields:
        The log, or None where neither is wanted.
    """
    if path is not None:
        with atomic_write(path) as partial, FrameLog(show, partial) as log:
            yield log
    elif show:
        with FrameLog(show) as log:
            yield log
    else:
        yield None


class FrameLog:
    """Colour before and after, sparse and completed depth, confidence and the cloud of frame after frame.

    Each frame is one step of the timeline `frame`, and of `time` where its time is known.

    Args:
        show: Whether to open a viewer.
        path: Where to save, or None.
    """

    def __init__(self, show: bool = False, path: Path | None = None) -> None:
        import rerun

        self._rerun, self._count = rerun, 0
        self._stream: Any = rerun.RecordingStream("depthreg", recording_id=uuid.uuid4())
        sinks: list[Any] = [] if path is None else [rerun.FileSink(path)]
        if show:
            rerun.spawn(connect=False, executable_path=_viewer(), recording=self._stream)
            sinks.append(rerun.GrpcSink())
        self._stream.set_sinks(*sinks)

    def __enter__(self) -> "FrameLog":
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.flush()
        self._stream.disconnect()

    def log(self, name: str, result: Result[np.ndarray], time_s: float | None = None) -> None:
        """Add a frame.

        Args:
            name: What it is called.
            result: Of a single frame, NumPy.
            time_s: When it was taken, in seconds since whenever.
        """
        if not self._count:
            self._begin(with_cloud=result.K is not None)
        self._stream.set_time("frame", sequence=self._count)
        if time_s is not None:
            self._stream.set_time("time", duration=time_s)
        self._count += 1
        self._log_images(result)
        self._stream.log("text", self._rerun.TextDocument(f"{name}\n{result!r}"))
        if result.K is not None:
            self._log_cloud(result)

    def _log_images(self, result: Result[np.ndarray]) -> None:
        rr, log = self._rerun, self._stream.log
        sparse_m, completed_m = result.sparse_depth_m, result.depth_m
        log("colour/given", rr.Image(result.rgb).compress(jpeg_quality=_JPEG_QUALITY))
        log("colour/aligned", rr.Image(result.rgb_aligned).compress(jpeg_quality=_JPEG_QUALITY))
        log("edges", rr.SegmentationImage(depth_edges(completed_m).astype(np.uint8)))
        limits_m = np.quantile(completed_m, [0.01, 0.99])
        log("depth/sparse", rr.DepthImage(sparse_m, meter=1, depth_range=limits_m))
        log("depth/completed", rr.DepthImage(completed_m, meter=1, depth_range=limits_m))
        if np.isfinite(result.confidence).all():  # a network that can't tell shows none
            log("confidence", rr.Image(np.rint(255 * result.confidence).astype(np.uint8)))
        for key in ("x_px", "y_px"):
            log(f"misalignment/{key}", rr.Scalars(result.describe()[key]))

    def _log_cloud(self, result: Result[np.ndarray]) -> None:
        rr, cloud = self._rerun, result.point_cloud()
        height, width = result.depth_m.shape
        self._stream.log("world/camera", rr.Pinhole(image_from_camera=result.K, resolution=[width, height]))
        radii = rr.Radius.ui_points(_POINT_PX)
        self._stream.log("world/cloud", rr.Points3D(cloud.points_m, colors=cloud.rgb, radii=radii))

    def _begin(self, with_cloud: bool) -> None:
        """What holds for all frames: axes, the edges' colour, and which picture is where."""
        import rerun.blueprint as rrb

        rr = self._rerun
        self._stream.log("world", rr.ViewCoordinates.RDF, static=True)
        classes = rr.AnnotationContext([(0, "", (0, 0, 0, 0)), (1, "edge of depth", _EDGE_RGBA)])
        self._stream.log("edges", classes, static=True)
        images = [
            rrb.Spatial2DView(contents=["/colour/given", "/edges"], name="colour as given, edges of the depth"),
            rrb.Spatial2DView(contents=["/colour/aligned", "/edges"], name="colour aligned, the same edges"),
            rrb.Spatial2DView(contents="/depth/sparse", name="depth as given"),
            rrb.Spatial2DView(contents="/depth/completed", name="depth completed"),
            rrb.Spatial2DView(contents="/confidence", name="confidence"),
            rrb.TimeSeriesView(origin="/misalignment", name="misalignment (px)"),
        ]
        views = [rrb.Grid(*images, grid_columns=2)]
        if with_cloud:
            views.insert(0, rrb.Spatial3DView(origin="/world", name="cloud"))
        rows = rrb.Vertical(
            rrb.Horizontal(*views), rrb.TextDocumentView(origin="/text", name="frame"), row_shares=[8, 1]
        )
        self._stream.send_blueprint(rrb.Blueprint(rows, collapse_panels=True))


def _viewer() -> str | None:
    """The viewer beside this Python, where there is one, since an environment need not be on the path."""
    path = Path(sysconfig.get_path("scripts")) / ("rerun.exe" if sys.platform == "win32" else "rerun")
    return str(path) if path.exists() else None
