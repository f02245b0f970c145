"""A drive of KITTI: raw, with the scanner's points, or of the depth completion benchmark, with depth images."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from depthreg.data import io
from depthreg.data.kitti import DEPTH_SCALE, SELECTION, KittiFrame, drive_frames, read_any_intrinsics, selection_frames
from depthreg.data.recordings.projection import project_points
from depthreg.data.recordings.recording import Kind, RecordedFrame, Recording, Rgbd, Settings, check_frame
from depthreg.errors import InputError

_COLOUR_CAMERAS = ("image_02", "image_03")  # left, right
_SCANS = Path("velodyne_points", "data")


def _is_raw(path: Path) -> bool:
    return (path / _SCANS).is_dir() and any((path / camera / "data").is_dir() for camera in _COLOUR_CAMERAS)


def _open_raw(path: Path, settings: Settings) -> Recording:
    """Colour of the left camera where there is one, and the scans as that camera would see them."""
    camera = next(camera for camera in _COLOUR_CAMERAS if (path / camera / "data").is_dir())
    images = {image.stem: image for image in sorted((path / camera / "data").glob("*.png"))}
    scans = {scan.stem: scan for scan in sorted((path / _SCANS).glob("*.bin"))}
    stems = sorted(images.keys() & scans.keys())
    if not stems:
        raise InputError(f"{path} holds no scan of the name of an image: {_SCANS}/NUMBER.bin was expected")
    intrinsics, projection = _read_calibration(path, camera[-2:])
    times_s = _read_times_s(path / camera / "timestamps.txt", sorted(images))
    frames = [
        RecordedFrame(stem, _raw_reader(images[stem], scans[stem], intrinsics, projection), times_s.get(stem))
        for stem in stems
    ]
    return Recording(frames, settings.depth_scale or DEPTH_SCALE, len(images.keys() ^ scans.keys()))


def _raw_reader(image: Path, scan: Path, intrinsics: np.ndarray, projection: np.ndarray) -> Callable[[], Rgbd]:
    def read() -> Rgbd:
        rgb = io.read_rgb(image)
        depth_m = project_points(_read_scan(scan), projection, (rgb.shape[0], rgb.shape[1]))
        return check_frame(Rgbd(rgb, depth_m, intrinsics), image, scan)

    return read


def _read_scan(path: Path) -> np.ndarray:
    """The points (N, 3) of a scan, in metres: x forward, y left, z up."""
    try:
        values = np.fromfile(path, "<f4")
    except OSError as error:
        raise InputError(f"{path} can't be read: {error.strerror}") from error
    if values.size % 4 or not np.isfinite(values).all():
        raise InputError(f"{path} isn't a scan: four finite 32-bit numbers a point were expected")
    return values.reshape(-1, 4)[:, :3].astype(np.float64)


def _read_calibration(path: Path, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) of a rectified camera, and its projection (3, 4) from the scanner's coordinates."""
    of_cameras = _read_matrices(path, "calib_cam_to_cam.txt", {f"P_rect_{camera}": 12, "R_rect_00": 9})
    of_scanner = _read_matrices(path, "calib_velo_to_cam.txt", {"R": 9, "T": 3})
    projection = of_cameras[f"P_rect_{camera}"].reshape(3, 4)
    rectified, camera_from_scanner = np.eye(4), np.eye(4)
    rectified[:3, :3] = of_cameras["R_rect_00"].reshape(3, 3)
    camera_from_scanner[:3, :3], camera_from_scanner[:3, 3] = of_scanner["R"].reshape(3, 3), of_scanner["T"]
    return projection[:, :3].astype(np.float32), projection @ rectified @ camera_from_scanner


def _read_matrices(drive: Path, name: str, sizes: dict[str, int]) -> dict[str, np.ndarray]:
    """Lines `KEY: numbers` of a calibration file, which belongs beside the drives of a day."""
    path = next((folder / name for folder in (drive.absolute().parent, drive) if (folder / name).is_file()), None)
    if path is None:
        raise InputError(
            f"{drive.absolute().parent / name} is missing: the calibration of the drive was expected there"
        )
    lines = dict(line.split(":", 1) for line in path.read_text(encoding="utf-8").splitlines() if ":" in line)
    try:
        matrices = {key: np.array(lines[key].split(), np.float64) for key in sizes}
    except (KeyError, ValueError) as error:
        raise InputError(f"{path} must hold lines of numbers for {', '.join(sizes)}") from error
    for key, size in sizes.items():
        if matrices[key].size != size:
            raise InputError(f"{path} holds {matrices[key].size} numbers for {key}: {size} were expected")
    return matrices


def _read_times_s(path: Path, stems: list[str]) -> dict[str, float]:
    """Each image's time since the first's, from lines such as `2011-09-26 13:02:25.964389445`."""
    if not path.is_file():
        return {}
    try:
        times = np.array([line.replace(" ", "T") for line in path.read_text().split("\n") if line], "datetime64[ns]")
    except ValueError as error:
        raise InputError(f"{path} must hold a date and time in each line") from error
    since_s = (times - times[0]) / np.timedelta64(1, "s") if len(times) else times
    # Lines are the images' numbers, also where an image is missing.
    return {stem: float(since_s[int(stem)]) for stem in stems if stem.isdigit() and int(stem) < len(since_s)}


def _selection(path: Path) -> Path:
    return path / SELECTION if (path / SELECTION).is_dir() else path


def _is_selection(path: Path) -> bool:
    return all((_selection(path) / name).is_dir() for name in ("image", "velodyne_raw"))


def _open_selection(path: Path, settings: Settings) -> Recording:
    return _of_files(path, selection_frames(_selection(path)), settings)


def _is_annotated(path: Path) -> bool:
    return (path / "proj_depth" / "velodyne_raw").is_dir()


def _open_annotated(path: Path, settings: Settings) -> Recording:
    """KITTI raw's colour lies in the drive's own folder, or a folder or two above it, by date and drive."""
    path = path.absolute()
    date = path.name[:10]
    raw_root = next(
        (root for root in (path.parent, path.parents[1]) if (root / date / path.name).is_dir()), path.parent
    )
    frames = drive_frames(path.parent, raw_root, path.name)
    cameras = {frame.depth.parent.name for frame in frames}
    return _of_files(path, [frame for frame in frames if frame.depth.parent.name == min(cameras)], settings)


def _of_files(path: Path, frames: list[KittiFrame], settings: Settings) -> Recording:
    if not frames:
        raise InputError(f"{path} holds no frame: pairs of PNGs were expected in it")
    scale = settings.depth_scale or DEPTH_SCALE
    return Recording([RecordedFrame(frame.name, _file_reader(frame, scale)) for frame in frames], scale)


def _file_reader(frame: KittiFrame, scale: float) -> Callable[[], Rgbd]:
    def read() -> Rgbd:
        intrinsics = read_any_intrinsics(frame.intrinsics, frame.depth) if frame.intrinsics else None
        found = Rgbd(io.read_rgb(frame.image), io.read_depth_m(frame.depth, scale), intrinsics)
        return check_frame(found, frame.image, frame.depth)

    return read


RAW_DRIVE = Kind("KITTI raw drive", "image_02/data/ and velodyne_points/data/", _is_raw, _open_raw)
DEPTH_SELECTION = Kind("KITTI depth selection", "image/ and velodyne_raw/", _is_selection, _open_selection)
ANNOTATED_DRIVE = Kind("KITTI depth drive", "proj_depth/velodyne_raw/", _is_annotated, _open_annotated)
