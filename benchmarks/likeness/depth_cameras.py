"""Statistics of dense depth images with holes: time of flight, structured light, active stereo."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from depthreg.rendering import Camera
from likeness.frames import DepthImage, fill_nearest
from likeness.lidar import plane_roughness_m

_BORDER = 0.08  # of the width and height is left out: registration to a colour camera leaves it empty
_EDGE = 0.05  # a larger step, relative to the depth, between neighbours is an edge
_BESIDE_PX = 6


@dataclass(frozen=True)
class DepthCamera:
    """One kind of instrument: its simulation, and where real frames of it are.

    Attributes:
        sensor: Name of the simulation in `conf/sensor/`.
        camera: What the simulated frames are seen with.
        sources: Pattern of the files, stored value per metre, focal length in pixels at the file's own size.
    """

    sensor: str
    camera: Camera
    sources: tuple[tuple[str, float, float], ...]


DEPTH_CAMERAS = (
    DepthCamera(
        "kinect",
        Camera(640, 480, 585.0, baseline_m=0.075),
        (
            ("kinect_7scenes/*.depth.png", 1000, 585.0),
            ("nyu/basement_*/depth.png", 1000, 519.0),
            ("tum_rgbd/*/depth_x5000.png", 5000, 525.0),
            ("open3d_rgbd/*.depth.png", 1000, 525.0),
        ),
    ),
    DepthCamera(
        "active_stereo",
        Camera(640, 480, 460.0, baseline_m=0.05),  # Intel's D415 and D435
        (
            ("stereo_depth_cam_lingbot/0/raw_depth.png", 1000, 460.0),
            ("stereo_depth_cam_lingbot/1/raw_depth.png", 1000, 461.0),
            ("stereo_depth_cam_lingbot/2/raw_depth.png", 1000, 460.0),
            ("graspnet_realsense/depth.png", 1000, 927.0),
        ),
    ),
    DepthCamera("tof", Camera(192, 144, 176.0), (("rgbdd_tof/*/tof_lowres.png", 1000, 176.0),)),
)


def real_depth_frames(root: Path, kind: DepthCamera) -> list[DepthImage]:
    """Real frames of one kind; the group is the data set, but each of the stereo camera's frames is a place."""
    frames = []
    for pattern, per_metre, focal_px in kind.sources:
        for path in sorted(root.glob(pattern)):
            depth_m = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / per_metre
            height, width = depth_m.shape
            group = "/".join(path.relative_to(root).parts[: 2 if kind.sensor == "active_stereo" else 1])
            frames.append(DepthImage(depth_m, Camera(width, height, focal_px), group))
    return frames


def hole_sizes_px(depth_m: np.ndarray) -> np.ndarray:
    """Square root of the area of each connected hole, once for each of its pixels: what size a pixel's hole has."""
    holes = (depth_m == 0).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes, connectivity=8)
    return np.sqrt(stats[labels[holes > 0], cv2.CC_STAT_AREA])


def share_of_holes_at_edges(depth_m: np.ndarray) -> np.ndarray:
    """Share of the hole pixels at most 6 px away from an edge of the depth round them; empty without holes.

    An edge is a step of 5 % after every hole was given the depth of its nearest neighbour.
    """
    holes = depth_m == 0
    if holes.all() or not holes.any():
        return np.zeros(0)
    filled_m = fill_nearest(depth_m).astype(np.float32)
    square = np.ones((3, 3))
    edges = cv2.dilate(filled_m, square) - cv2.erode(filled_m, square) > _EDGE * filled_m
    beside = cv2.dilate(edges.astype(np.uint8), np.ones((2 * _BESIDE_PX + 1,) * 2)) > 0
    return np.array([beside[holes].mean()])


def depth_steps_mm(depth_m: np.ndarray) -> np.ndarray:
    """Differences between the depths that occur, in order, over the depth squared: millimetres at 1 m.

    A camera that measures disparities in steps of s pixels has depths z^2 s / (f b) apart.
    """
    levels_m = np.unique(depth_m[depth_m > 0])
    return 1000 * np.diff(levels_m) / levels_m[1:] ** 2


def depth_samples(frame: DepthImage) -> dict[str, np.ndarray]:
    """Samples of every statistic; the unit is in the name. Depths are rounded to millimetres, as files store them."""
    height, width = frame.depth_m.shape
    top, left = round(_BORDER * height), round(_BORDER * width)
    inner = np.s_[top : height - top, left : width - left]
    depth_m = np.round(frame.depth_m[inner], 3)
    scale = 640 / width  # blocks and holes of other image sizes in pixels of this one
    size = max(round(16 / scale), 4)
    rms_m, mean_m = plane_roughness_m(
        depth_m, frame.camera.rays()[inner], block_px=(size, size), least=round(0.8 * size**2)
    )
    noise_mm = {
        f"noise {low}-{high} m, mm": 1000 * rms_m[(mean_m >= low) & (mean_m < high)]
        for low, high in ((0.4, 1), (1, 2), (2, 3), (3, 5))
    }
    return {
        "depth, m": depth_m[depth_m > 0][::7],
        "holes, %": np.array([100 * (depth_m == 0).mean()]),
        "size of holes, px": scale * hole_sizes_px(depth_m)[::7],
        "holes at edges, %": 100 * share_of_holes_at_edges(depth_m),
        "steps of depth, mm at 1 m": depth_steps_mm(depth_m).clip(max=20),
        **noise_mm,
    }
