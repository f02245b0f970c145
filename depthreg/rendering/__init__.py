"""What a perfect instrument sees of a scene."""

from depthreg.rendering.camera import Camera, ScanPattern, hdl64
from depthreg.rendering.raycast import render_frame

__all__ = ["Camera", "ScanPattern", "hdl64", "render_frame"]
