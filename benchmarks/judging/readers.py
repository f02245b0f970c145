"""Real frames as measurements, whatever their folders look like; see the README beside them."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from likeness.frames import projection

from depthreg.data.io import read_depth_m, read_intrinsics, read_rgb
from depthreg.data.kitti import KittiDataset
from depthreg.data.sample import Measurement

Frames = dict[str, list[Measurement]]  # batches of one, by data set

KITTI = 256.0  # stored value per metre
MILLIMETRES = 1000.0
OFFICIAL, DERIVED, SELECTION = "triple_5 (official truth)", "kitti_odom_04 (derived)", "val_selection (derived)"
KITTI_SETS = (OFFICIAL, DERIVED, SELECTION)
FOLDERS = (
    "kitti_dc_official",
    "kitti_odom_04",
    "kitti_raw_0048",
    "kitti_object_a",
    "kitti_val_selection_cropped",
    "nuscenes_demo",
    "ddad_mini",
    "vod_delft",
    "pjlab_calib",
    "realsense_f200_apc",
    "kinect_7scenes",
    "ibims1",
    "rgbdd_tof",
    "nyu",
    "tum_rgbd",
    "open3d_rgbd",
    "posecnn_rgbd",
    "graspnet_realsense",
    "stereo_depth_cam_lingbot",
)
CROPPED_K = np.array([[721.5377, 0, 596.5593], [0, 721.5377, 149.854], [0, 0, 1]])  # of KITTI's benchmark crop


def measurement(
    name: str,
    rgb: np.ndarray,
    depth_m: np.ndarray,
    truth_m: np.ndarray | None = None,
    intrinsics: np.ndarray | None = None,
) -> Measurement:
    """A batch of one from arrays (H, W, 3) uint8 and (H, W) in metres."""
    sample = Measurement(
        name=[name],
        rgb=torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255,
        depth_m=torch.from_numpy(depth_m.astype(np.float32))[None, None],
    )
    if truth_m is not None:
        sample["truth_depth_m"] = torch.from_numpy(truth_m.astype(np.float32))[None, None]
    if intrinsics is not None:
        sample["intrinsics"] = torch.from_numpy(intrinsics.astype(np.float32))[None]
    return sample


def _read(
    image: Path, depth: Path, scale: float, truth: Path | None = None, intrinsics: np.ndarray | None = None
) -> Measurement:
    name = "_".join(image.parts[-3:]).rsplit(".", 1)[0]
    truth_m = read_depth_m(truth, scale) if truth else None
    return measurement(name, read_rgb(image), read_depth_m(depth, scale), truth_m, intrinsics)


def kitti_depth(root: Path) -> Frames:
    """KITTI's frames with truth; the official truth apart from the derived one."""
    official, drive = root / "kitti_dc_official/triple_5", root / "kitti_odom_04"
    k = projection(drive / "calib.txt", "P2")[:, :3]
    selection = KittiDataset(root / "kitti_val_selection_cropped")
    names = [path.name for path in sorted((drive / "cam2/image").glob("*.png"))]
    kinds = [drive / "cam2" / kind for kind in ("image", "velodyne_raw", "groundtruth_depth")]
    return {
        OFFICIAL: [
            _read(official / "rgb.png", official / "sparse_depth.png", KITTI, official / "gt_depth.png", CROPPED_K)
        ],
        DERIVED: [_read(kinds[0] / name, kinds[1] / name, KITTI, kinds[2] / name, k) for name in names],
        SELECTION: [as_batch(selection[index]) for index in range(len(selection))],
    }


def as_batch(item: Mapping[str, Any]) -> Measurement:
    """A data set's item with the batch axis that it lacks."""
    return Measurement(**{key: [value] if isinstance(value, str) else value[None] for key, value in item.items()})


def indoor_depth(root: Path) -> Frames:
    """Rooms with truth; Kinect's colour is not registered to its depth."""
    room, corridor, phone = root / "nyu/kitchenette", root / "ibims1/corridor", root / "rgbdd_tof/4"
    scenes = sorted((root / "kinect_7scenes").glob("*.depth.png"))
    return {
        "rgbdd_tof/4 (phone ToF)": [_phone(phone)],
        "ibims1/corridor (86 points)": [
            _read(corridor / "rgb.png", corridor / "sparse_100.png", MILLIMETRES, corridor / "gt.png")
        ],
        "nyu/kitchenette (500 points)": [
            _read(room / "rgb.png", room / "sparse_depth.png", MILLIMETRES, room / "gt.png")
        ],
        "kinect_7scenes (fused truth)": [
            _read(_beside(path, "color.jpg"), path, MILLIMETRES, _beside(path, "fused.png")) for path in scenes
        ],
    }


def _beside(depth: Path, suffix: str) -> Path:
    return depth.with_name(depth.name.replace("depth.png", suffix))


def _phone(folder: Path) -> Measurement:
    rgb, truth_m = read_rgb(folder / "rgb.jpg"), read_depth_m(folder / "gt.png", MILLIMETRES)
    depth_m = on_grid(read_depth_m(folder / "tof_lowres.png", MILLIMETRES), truth_m.shape)
    return measurement("rgbdd_tof_4", rgb, depth_m, truth_m)


def on_grid(depth_m: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """A small depth map's pixels at their places in a larger image (height, width), 0 between them."""
    rows, columns = (
        np.rint((np.arange(small) + 0.5) * large / small - 0.5).astype(int)
        for small, large in zip(depth_m.shape, size, strict=True)
    )
    sparse_m = np.zeros(size, np.float32)
    sparse_m[np.ix_(rows, columns)] = depth_m
    return sparse_m


def lidar_pairs(root: Path) -> list[Measurement]:
    """Colour and LiDAR of several drives, which line up: to put a known misalignment on."""
    drive, raw, objects = root / "kitti_odom_04/cam2", root / "kitti_raw_0048", root / "kitti_object_a"
    official = root / "kitti_dc_official"
    pairs = [(official / name / "rgb.png", official / name / "sparse_depth.png") for name in ("triple_5", "triple_3")]
    pairs += [(drive / "image" / f"{n:010d}.png", drive / "velodyne_raw" / f"{n:010d}.png") for n in (5, 21, 37)]
    pairs += [(raw / "image_02/0000000001.png", raw / "velodyne_raw/0000000001.png")]
    pairs += [(objects / f"image/{n:06d}.png", objects / f"velodyne_raw/{n:06d}.png") for n in (0, 2, 4, 7, 9, 12)]
    return [_read(image, depth, KITTI) for image, depth in pairs]


def room_pairs(root: Path) -> list[Measurement]:
    """Colour and depth of rooms, which line up: to put a known misalignment on."""
    pairs = [
        ("nyu/kitchenette/rgb.png", "nyu/kitchenette/sparse_depth.png", MILLIMETRES),
        ("ibims1/corridor/rgb.png", "ibims1/corridor/sparse_100.png", MILLIMETRES),
        ("tum_rgbd/desk_1/rgb.png", "tum_rgbd/desk_1/depth_x5000.png", 5000.0),
        ("tum_rgbd/desk_2/rgb.png", "tum_rgbd/desk_2/depth_x5000.png", 5000.0),
        ("open3d_rgbd/00000.color.jpg", "open3d_rgbd/00000.depth.png", MILLIMETRES),
        ("open3d_rgbd/00003.color.jpg", "open3d_rgbd/00003.depth.png", MILLIMETRES),
        ("posecnn_rgbd/000001-color.png", "posecnn_rgbd/000001-depth.png", 10000.0),
        ("graspnet_realsense/color.png", "graspnet_realsense/depth.png", MILLIMETRES),
        ("stereo_depth_cam_lingbot/0/rgb.png", "stereo_depth_cam_lingbot/0/raw_depth.png", MILLIMETRES),
        ("stereo_depth_cam_lingbot/1/rgb.jpg", "stereo_depth_cam_lingbot/1/raw_depth.png", MILLIMETRES),
    ]
    return [_phone(root / "rgbdd_tof/4")] + [_read(root / rgb, root / depth, scale) for rgb, depth, scale in pairs]


def other_lidars(root: Path) -> Frames:
    """LiDARs of other cars, without truth, and how far each stands behind its camera."""
    delft = projection(root / "vod_delft/00549.calib.txt", "P2")[:, :3]
    shanghai = np.array([[2152.8, 0, 971.3], [0, 2155.5, 605.9], [0, 0, 1]])  # pjlab_calib/1.calib.txt
    objects = root / "kitti_object_a"
    with_k = {
        name: [
            _read(path, path.with_suffix(".lidar.png"), KITTI, None, read_intrinsics(path.with_suffix(".K.txt")))
            for path in sorted((root / name).glob("*.jpg"))
        ]
        for name in ("nuscenes_demo", "ddad_mini")
    }
    return with_k | {
        "vod_delft": [_lidar(root / "vod_delft/00549.jpg", delft)],
        "pjlab_calib": [_lidar(root / "pjlab_calib/1.jpg", shanghai)],
        "kitti_object_a": [
            _read(
                objects / f"image/{number:06d}.png",
                objects / f"velodyne_raw/{number:06d}.png",
                KITTI,
                None,
                projection(objects / f"calib/{number:06d}.txt", "P2")[:, :3],
            )
            for number in (1, 3, 6, 8, 11)
        ],
    }


def _lidar(image: Path, intrinsics: np.ndarray) -> Measurement:
    return _read(image, image.with_suffix(".lidar.png"), KITTI, None, intrinsics)


def grey(path: Path) -> np.ndarray:
    """A grey image, (H, W) float32 in [0, 1]."""
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32) / 255


def spread(frames: Sequence[Measurement], count: int) -> list[Measurement]:
    """At most so many frames, spread evenly over all of them."""
    chosen = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[index] for index in dict.fromkeys(chosen.tolist())]


def cut(sets: Frames, count: int) -> Frames:
    """At most so many frames of each set."""
    return {name: spread(frames, count) for name, frames in sets.items()}


def each(sets: Frames) -> Iterator[tuple[str, Measurement]]:
    """All frames with the name of their set."""
    for name, frames in sets.items():
        for frame in frames:
            yield name, frame
