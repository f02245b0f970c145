"""What a perfect instrument sees of a scene."""

from depthreg.rendering.camera import Camera
from depthreg.rendering.cycles import Cycles
from depthreg.rendering.raycast import render_frame
from depthreg.rendering.renderer import Embree, Renderer
from depthreg.rendering.rig import PairMatcher, RandomOffset, Rig
from depthreg.rendering.scanners import SCANNERS, ScanPattern, hdl64

__all__ = [
    "SCANNERS",
    "Camera",
    "Cycles",
    "Embree",
    "PairMatcher",
    "RandomOffset",
    "Renderer",
    "Rig",
    "ScanPattern",
    "hdl64",
    "render_frame",
]
