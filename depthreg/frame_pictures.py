"""Pictures of rendered frames, for people: one frame in all its parts, and many beside each other."""

import cv2
import numpy as np
import torch

from depthreg.data.sample import Frame
from depthreg.sensors.lidar import rasterize
from depthreg.viz import depth_limits_m, depth_with_bar, overlay_points, panel

_OVERVIEW_WIDTH_PX = 480  # of one frame


def inner_rgb(frame: Frame) -> np.ndarray:
    """The colour image without its margin, on the depth's grid, (H, W, 3) uint8."""
    margin = frame.margin_px
    height, width = frame.depth_m.shape
    return frame.rgb[margin : margin + height, margin : margin + width]


def lidar_image(frame: Frame) -> np.ndarray:
    """The LiDAR's returns as sparse depth, (H, W) metres, 0 = none; the nearest return of a pixel wins."""
    uv_px, depth_m = torch.from_numpy(frame.lidar.uv_px), torch.from_numpy(frame.lidar.depth_m)
    return rasterize(uv_px[None], depth_m[None], frame.depth_m.shape)[0, 0].numpy()


def overview(frames: dict[str, Frame]) -> np.ndarray:
    """The colour of frames, by their captions, in rows of four."""
    tiles = []
    for caption, frame in frames.items():
        rgb = inner_rgb(frame)
        size = (_OVERVIEW_WIDTH_PX, round(_OVERVIEW_WIDTH_PX * rgb.shape[0] / rgb.shape[1]))
        tiles.append((caption, cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)))
    return panel(tiles, columns=min(len(tiles), 4))


def frame_panel(frame: Frame) -> np.ndarray:
    """Everything that a frame holds, in one picture."""
    limits = depth_limits_m(frame.depth_m)
    height, width = frame.depth_m.shape
    tiles = [
        ("colour, LiDAR returns", overlay_points(inner_rgb(frame), lidar_image(frame))),
        ("depth", depth_with_bar(frame.depth_m, *limits)),
        ("normals", _picture_of_normals(frame)),
        ("objects", _picture_of_objects(frame)),
    ]
    if frame.rgb_right.size:
        tiles.insert(1, ("right camera", frame.rgb_right))
    return panel(tiles, columns=1 if width > 2 * height else 2)


def _picture_of_normals(frame: Frame) -> np.ndarray:
    """Red = right, green = up, blue = towards the camera; grey sky."""
    return np.rint(127.5 + 127.5 * frame.normal * [1, -1, -1]).astype(np.uint8)


def _picture_of_objects(frame: Frame) -> np.ndarray:
    """A colour for each object, black sky."""
    colors = np.random.default_rng(0).integers(60, 256, (frame.object_id.max() + 2, 3), dtype=np.uint8)
    colors[-1] = 0  # object -1
    return colors[frame.object_id]
