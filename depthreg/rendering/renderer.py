"""What every renderer can do, so that one can take the other's place."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from depthreg.data.sample import Frame
from depthreg.rendering.camera import Camera
from depthreg.rendering.raycast import render_frame
from depthreg.rendering.scanners import ScanPattern
from depthreg.worlds.scene import Scene


class Renderer(Protocol):
    """Turns a scene into what perfect instruments see of it. Its `repr` says everything that pictures depend on."""

    def __call__(
        self,
        scene: Scene,
        camera: Camera,
        scan: ScanPattern | None,
        *,
        right: bool = True,
        rgb_from_depth: np.ndarray | None = None,
    ) -> Frame:
        """Render a frame; the arguments are those of `depthreg.rendering.render_frame`."""


@dataclass(frozen=True)
class Embree:
    """Casts rays with Embree: `render_frame` with a `repr` that lasts."""

    def __call__(
        self,
        scene: Scene,
        camera: Camera,
        scan: ScanPattern | None,
        *,
        right: bool = True,
        rgb_from_depth: np.ndarray | None = None,
    ) -> Frame:
        """Render a frame; the arguments are those of `depthreg.rendering.render_frame`."""
        return render_frame(scene, camera, scan, right=right, rgb_from_depth=rgb_from_depth)
