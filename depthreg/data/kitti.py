"""KITTI depth completion, in the two layouts that its archives unpack to."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import Dataset

from depthreg.data.folder import read_pair
from depthreg.data.io import read_intrinsics
from depthreg.errors import InputError

DEPTH_SCALE = 256.0  # stored value per metre
SELECTION = "val_selection_cropped"


@dataclass(frozen=True)
class KittiFrame:
    """Where the files of one frame are."""

    name: str
    image: Path
    depth: Path
    truth: Path | None  # None in the test sets
    intrinsics: Path | None  # a text file of 9 numbers, or the drive's calib_cam_to_cam.txt


class KittiDataset(Dataset[dict[str, Any]]):
    """Frames of KITTI depth completion; which layout it is shows in the folder.

    - The validation selection or an anonymous test set: `root` (or its sub-folder `val_selection_cropped`)
    holds
      `image`, `velodyne_raw`, `intrinsics` and, but for the test sets, `groundtruth_depth`.
    - The annotated drives: `root` holds
    `<split>/<drive>_sync/proj_depth/{velodyne_raw,groundtruth}/image_0{2,3}`,
      and `raw_root` holds KITTI raw, `<date>/<drive>_sync/image_0{2,3}/data` and
      `<date>/calib_cam_to_cam.txt`.

    Args:
        root: Folder of either layout.
        split: `train` or `val`; the first layout has but one split.
        raw_root: Folder of KITTI raw; `root` where not given.

    Raises:
        InputError: Neither layout, or a frame without its colour image.
    """

    def __init__(self, root: str | Path, split: str = "val", raw_root: str | Path | None = None) -> None:
        root = Path(root)
        selection = root / SELECTION if (root / SELECTION).is_dir() else root
        if (selection / "velodyne_raw").is_dir():
            self.frames = selection_frames(selection)
        elif (root / split).is_dir():
            self.frames = drive_frames(root / split, Path(raw_root or root))
        else:
            raise InputError(
                f"{root} isn't a KITTI depth folder: velodyne_raw, {SELECTION} or {split} was expected in it"
            )
        if not self.frames:
            raise InputError(f"{root} holds no frame: pairs of PNGs were expected in it")

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """One `Measurement` without its batch axis."""
        frame = self.frames[index]
        intrinsics = read_any_intrinsics(frame.intrinsics, frame.depth) if frame.intrinsics else None
        return read_pair(frame.name, frame.image, frame.depth, DEPTH_SCALE, frame.truth, intrinsics)


def selection_frames(root: Path) -> list[KittiFrame]:
    """Frames of a folder that holds `image` and `velodyne_raw`."""
    frames = []
    for image in sorted((root / "image").glob("*.png")):
        # In the validation selection a file's name says its kind; in the test sets all kinds share one.
        depth_name, truth_name = (
            image.name.replace("_image_", f"_{kind}_", 1) for kind in ("velodyne_raw", "groundtruth_depth")
        )
        frames.append(
            KittiFrame(
                image.stem,
                image,
                root / "velodyne_raw" / depth_name,
                _if_there(root / "groundtruth_depth" / truth_name),
                _if_there(root / "intrinsics" / f"{image.stem}.txt"),
            )
        )
    return frames


def drive_frames(root: Path, raw_root: Path, drives: str = "*_sync") -> list[KittiFrame]:
    """Frames of a folder of annotated drives, or of one of these, and colour from KITTI raw.

    Raises:
        InputError: A frame has no colour image.
    """
    frames = []
    for depth in sorted(root.glob(f"{drives}/proj_depth/velodyne_raw/image_0[23]/*.png")):
        drive, camera = depth.relative_to(root).parts[0], depth.parent.name
        date = raw_root / drive[:10]  # 2011_09_26_drive_0001_sync was recorded on 2011_09_26
        image = date / drive / camera / "data" / depth.name
        if not image.is_file():
            raise InputError(f"{image} is missing: KITTI raw's colour was expected there (see raw_root)")
        truth = depth.parents[2] / "groundtruth" / camera / depth.name
        frames.append(
            KittiFrame(
                f"{drive}_{camera}_{depth.stem}",
                image,
                depth,
                _if_there(truth),
                _if_there(date / "calib_cam_to_cam.txt"),
            )
        )
    return frames


def _if_there(path: Path) -> Path | None:
    return path if path.is_file() else None


def read_any_intrinsics(path: Path, depth: Path) -> np.ndarray:
    """K (3, 3) from a file of 9 numbers, or from a drive's calibration for the camera that `depth` is of."""
    if path.name != "calib_cam_to_cam.txt":
        return read_intrinsics(path)
    key = f"P_rect_{depth.parent.name[-2:]}:"
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith(key):
            projection = np.array(line.removeprefix(key).split(), np.float32)
            return np.ascontiguousarray(projection.reshape(3, 4)[:, :3])
    raise InputError(f"{path} holds no {key[:-1]}: the camera's projection matrix was expected")
