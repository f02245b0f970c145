"""Real frames and simulated ones of the same cameras.

Both are depth images with the camera that they belong to, so every statistic is taken in the same way from either.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from depthreg.config import build, compose_config
from depthreg.data.synthetic import SyntheticFrames, SyntheticMeasurements
from depthreg.rendering import Camera
from depthreg.sensors import SensorSimulator
from depthreg.worlds.scene import Scene

MAX_RANGE_M = 80.0  # no return of KITTI's recordings is farther
SEED = 90210  # of the simulated scenes; training draws other ones

FOLDERS = (  # of real frames, all of them needed
    "kitti_odom_04",
    "kitti_raw_0048",
    "kitti_object_a",
    "kitti_dc_official",
    "kinect_7scenes",
    "nyu",
    "tum_rgbd",
    "open3d_rgbd",
    "stereo_depth_cam_lingbot",
    "graspnet_realsense",
    "rgbdd_tof",
)

# The benchmark of depth completion: KITTI's first camera, cropped to the lower 352 rows and the central 1216 columns.
_CROPPED = Camera(1216, 352, 721.5377, (609.5593 - 13, 172.854 - 23))


@dataclass(frozen=True)
class DepthImage:
    """One measurement.

    Attributes:
        depth_m: z-depth, (H, W) float32, 0 = no return.
        camera: Whose pixel grid it is on.
        group: Which place it shows: frames of one drive share it, and are never split between training and test.
    """

    depth_m: np.ndarray
    camera: Camera
    group: str


def projection(path: Path, key: str) -> np.ndarray:
    """The 3x4 matrix of a line of one of KITTI's calibration files."""
    lines = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    return np.array(lines[key].split(), float).reshape(3, 4)


def _read(path: Path, camera: np.ndarray | Camera, group: str) -> DepthImage:
    depth_m = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
    if isinstance(camera, Camera):
        return DepthImage(depth_m, camera, group)
    height, width = depth_m.shape
    center = (float(camera[0, 2]), float(camera[1, 2]))
    return DepthImage(depth_m, Camera(width, height, float(camera[0, 0]), center), group)


def real_lidar_frames(root: Path) -> list[DepthImage]:
    """KITTI's sparse input frames; the group starts with the recording's name."""
    odometry = projection(root / "kitti_odom_04/calib.txt", "P2")
    raw = projection(root / "kitti_raw_0048/calib/calib_cam_to_cam.txt", "P_rect_02")
    objects = root / "kitti_object_a"
    frames = [_read(p, odometry, "odom_04") for p in sorted((root / "kitti_odom_04/cam2/velodyne_raw").glob("*.png"))]
    frames += [_read(p, raw, "raw_0048") for p in sorted((root / "kitti_raw_0048/velodyne_raw").glob("*.png"))]
    for path in sorted((objects / "velodyne_raw").glob("*.png")):
        matrix = projection(objects / "calib" / f"{path.stem}.txt", "P2")
        frames.append(_read(path, matrix, f"object_{path.stem}"))
    for path in sorted((root / "kitti_dc_official").glob("triple_*/sparse_depth.png")):
        frames.append(_read(path, _CROPPED, f"official_{path.parent.name}"))
    return frames


def fill_nearest(depth_m: np.ndarray) -> np.ndarray:
    """Every pixel gets the depth of the return nearest to it: depth without the pattern of the returns."""
    nearest = distance_transform_edt(depth_m == 0, return_distances=False, return_indices=True)
    return depth_m[tuple(nearest)]


@dataclass(frozen=True)
class OneOf:
    """Draws one of some cameras, as `RandomCamera` draws any."""

    cameras: tuple[Camera, ...]

    def __call__(self, rng: np.random.Generator) -> Camera:
        """One camera."""
        return self.cameras[rng.integers(len(self.cameras))]


def simulated_frames(
    sensor: str,
    world: Callable[[int, int], Scene],
    cameras: Sequence[Camera],
    count: int,
    cache_dir: Path,
    *,
    difficulty: float = 1.0,
    overrides: Sequence[str] = (),
) -> list[DepthImage]:
    """Scenes of a world, each seen by one of the real cameras and measured by a sensor.

    Args:
        sensor: Name of its configuration in `conf/sensor/`.
        world: Draws a scene from a seed and an index.
        cameras: The real frames' cameras.
        count: How many frames.
        cache_dir: Keeps what was rendered; another version of the code renders anew.
        difficulty: Of the sensor, in [0, 1].
        overrides: Other settings of the sensor, `key=value`.
    """
    config = compose_config(f"sensor/{sensor}", [f"sensor.{setting}" for setting in overrides])
    instrument = build(config.sensor)
    pick = OneOf(tuple(dict.fromkeys(cameras)))
    rendered = SyntheticFrames(world, pick, instrument.rig, SEED, count, MAX_RANGE_M, cache_dir)  # type: ignore[arg-type]
    measured = SyntheticMeasurements(rendered, SensorSimulator(instrument, max_corner_shift_px=0), difficulty, SEED)
    frames = []
    for index in range(count):
        depth_m = measured[index]["depth_m"][0].numpy()
        camera = pick(np.random.default_rng([SEED, index, 1]))  # as SyntheticFrames draws it
        frames.append(DepthImage(np.where(depth_m > MAX_RANGE_M, 0, depth_m), camera, f"simulated_{index:03d}"))
    return frames
