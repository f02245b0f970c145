"""Recordings in the layouts of their makers, read back and compared with OpenCV and with what was put in."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from depthreg.data import io
from depthreg.data.recordings import RecordedFrame, Settings, open_recording
from depthreg.data.recordings.projection import project_points, reproject_depth
from depthreg.data.recordings.realsense_folder import read_cameras
from depthreg.data.recordings.recording import associate
from depthreg.errors import InputError

HEIGHT, WIDTH = 67, 91
SIZE = (HEIGHT, WIDTH)
DEFAULT = Settings()


def write_rgb(path: Path, seed: int = 0) -> np.ndarray:
    """A random picture, (H, W, 3) RGB."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rgb = np.random.default_rng(seed).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    io.write_png(path, rgb)
    return rgb


def write_depth(path: Path, scale: float, seed: int = 0) -> np.ndarray:
    """A fifth of the pixels between 1 and 9 m, in the file's own steps."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    stored = np.where(rng.random(SIZE) < 0.2, rng.integers(int(scale), int(9 * scale), SIZE), 0).astype(np.uint16)
    io.write_png(path, stored)
    return stored / np.float32(scale)


def names_of(frames: list[RecordedFrame]) -> list[str]:
    return [frame.name for frame in frames]


def opencv_reprojection(
    depth_m: np.ndarray, ours: np.ndarray, pose: np.ndarray, theirs: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """OpenCV's undistortPoints and projectPoints, and the minimum at each pixel; inf where there is none."""
    row, column = np.nonzero(depth_m)
    pixels = np.stack([column, row], axis=1).astype(np.float64)
    rays = cv2.undistortPoints(pixels[:, None], ours.astype(np.float64), None)[:, 0]
    points_m = np.column_stack([rays, np.ones(len(rays))]) * depth_m[row, column, None]
    pixels, _ = cv2.projectPoints(
        points_m, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], theirs.astype(np.float64), None
    )
    u, v = np.rint(pixels[:, 0]).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < size[1]) & (v < size[0])
    image = np.full(size, np.inf)
    np.minimum.at(image, (v[inside], u[inside]), (points_m @ pose[2, :3] + pose[2, 3])[inside])
    return image


def test_the_nearer_of_two_points_on_one_pixel_wins_and_what_is_behind_or_beside_the_camera_is_left_out():
    projection = np.array([[10.0, 0, 40, 0], [0, 10, 30, 0], [0, 0, 1, 0]])
    points_m = np.array(
        [[0, 0, 8.0], [0, 0, 5], [0, 0, 6], [1, 0, 2], [0, 0, -3], [100, 0, 1], [0, 0, 0], [0.04, 0, 1]]
    )
    expected = np.zeros(SIZE, np.float32)
    expected[30, 40], expected[30, 45] = 1, 2
    np.testing.assert_array_equal(project_points(points_m, projection, SIZE), expected)


def test_reprojected_depth_is_what_opencv_makes_of_it():
    rng = np.random.default_rng(0)
    depth_m = np.where(rng.random(SIZE) < 0.7, 2 + 0.01 * np.mgrid[:HEIGHT, :WIDTH][1], 0).astype(np.float32)
    ours, theirs = np.array([[80.0, 0, 44], [0, 82, 31], [0, 0, 1]]), np.array([[70.0, 0, 41], [0, 71, 36], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0], (0.05, -0.01, 0.02)
    found = reproject_depth(depth_m, ours, pose, theirs, (60, 80))
    expected = opencv_reprojection(depth_m, ours, pose, theirs, (60, 80))
    assert (found > 0).mean() > 0.4
    np.testing.assert_allclose(np.where(found > 0, found, np.inf), expected, atol=1e-5)


def test_what_a_near_wall_hides_doesnt_shine_through_its_gaps():
    intrinsics = np.array([[50.0, 0, 45], [0, 50, 33], [0, 0, 1]])
    finer = np.array([[120.0, 0, 45], [0, 120, 33], [0, 0, 1]])
    pose = np.eye(4)
    pose[0, 3] = -0.1  # the colour camera stands to the right: the wall covers more of what is behind it
    depth_m = np.full(SIZE, 10, np.float32)
    depth_m[:, 30:60] = 1
    found = reproject_depth(depth_m, intrinsics, pose, finer, SIZE)
    columns = np.flatnonzero((found == 1).any(axis=0))
    assert columns.size > 20
    assert not (found[:, columns.min() : columns.max() + 1] == 10).any()


def test_a_realsense_folders_own_depth_camera_is_brought_onto_colours_grid(real_data):
    folder = real_data / "realsense_f200_apc"
    cameras = read_cameras(folder / "cam.info.txt")
    raw_m = io.read_depth_m(folder / "frame-000000.depth_raw.png", 10000)
    found = reproject_depth(raw_m, cameras.depth_intrinsics, cameras.rgb_from_depth, cameras.rgb_intrinsics, (480, 640))
    pose = cameras.rgb_from_depth
    expected = opencv_reprojection(raw_m, cameras.depth_intrinsics, pose, cameras.rgb_intrinsics, (480, 640))
    kept = found > 0
    assert kept.sum() > 0.98 * np.isfinite(expected).sum()  # but for what shines through gaps
    assert (np.abs(found - expected)[kept] < 1e-4).mean() > 0.999  # a few fall on the border of two pixels
    aligned_m = io.read_depth_m(folder / "frame-000000.depth_aligned.png", 10000)  # by the device's own software
    both = kept & (aligned_m > 0)
    assert np.median(np.abs(found - aligned_m)[both]) < 0.006  # it leaves out the 4 mm between the cameras along z


def test_a_realsense_folder_gives_aligned_depth_where_it_has_it_and_else_reprojects(real_data, tmp_path):
    source = real_data / "realsense_f200_apc"
    frames = open_recording(source, DEFAULT).frames
    assert names_of(frames) == [f"frame-{number:06d}" for number in range(7)]
    given = frames[0].read()
    np.testing.assert_array_equal(given.depth_m, io.read_depth_m(source / "frame-000000.depth_aligned.png", 10000))
    np.testing.assert_allclose(given.intrinsics[0], [615.19519, 0, 298.442688])
    for name in ("cam.info.txt", "frame-000000.color.png", "frame-000001.color.png"):
        shutil.copy(source / name, tmp_path)
    (tmp_path / "raw").mkdir()
    shutil.copy(source / "frame-000000.depth_raw.png", tmp_path / "raw/frame-000000.depth.png")
    recording = open_recording(tmp_path, DEFAULT)
    assert names_of(recording.frames) == ["frame-000000"] and recording.unpaired == 1
    both = (recording.frames[0].read().depth_m > 0) & (given.depth_m > 0)
    assert both.sum() > 30000


def test_a_tum_recording_pairs_by_time_and_knows_its_scale_and_camera(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg1_mine"
    rgb, depth_m = write_rgb(folder / "rgb/10.01.png"), write_depth(folder / "depth/10.02.png", 5000)
    write_rgb(folder / "rgb/10.30.png")
    (folder / "rgb.txt").write_text("# timestamp filename\n10.01 rgb/10.01.png\n10.30 rgb/10.30.png\n")
    (folder / "depth.txt").write_text("# depth maps\n10.02 depth/10.02.png\n10.06 depth/missing.png\n")
    recording = open_recording(folder, DEFAULT)
    assert (names_of(recording.frames), recording.depth_scale, recording.unpaired) == (["10.01"], 5000, 2)
    frame = recording.frames[0].read()
    np.testing.assert_array_equal(frame.rgb, rgb)
    np.testing.assert_allclose(frame.depth_m, depth_m, rtol=1e-6)
    assert recording.frames[0].time_s == 10.01 and frame.intrinsics[0, 0] == np.float32(517.3)


def test_times_pair_with_their_nearest_and_only_once():
    where = Path("here")
    assert associate([0.0, 1.0, 2.0], [2.01, 0.005, 0.0, 1.5], where) == [(0, 2), (2, 0)]
    assert associate([3.0, 1.0], [1.0, 3.0], where) == [(1, 0), (0, 1)]
    assert associate([0.0, 0.01], [0.004], where) == [(0, 0)]
    with pytest.raises(InputError, match=r"nearest are 0\.400 s apart"):
        associate([0.0, 1.0], [0.4], where)
    with pytest.raises(InputError, match="0 colour and 1 depth"):
        associate([], [0.4], where)


@pytest.fixture
def raw_drive(real_data, tmp_path) -> Path:
    """KITTI raw's layout of three real frames, one of them without its scan."""
    source = real_data / "kitti_raw_0048"
    drive = tmp_path / "2011_09_26/2011_09_26_drive_0048_sync"
    for name in ("image_02/data", "velodyne_points/data"):
        (drive / name).mkdir(parents=True)
    for path in (source / "calib").iterdir():
        shutil.copy(path, drive.parent)
    for path in (source / "image_02").iterdir():
        shutil.copy(path, drive / "image_02/data")
    for path in sorted((source / "velodyne_fov").iterdir())[:2]:
        shutil.copy(path, drive / "velodyne_points/data")
    times = [f"2011-09-26 14:37:1{second}.{123456789}" for second in (0, 1, 3)]
    (drive / "image_02/timestamps.txt").write_text("\n".join(times) + "\n")
    return drive


def test_a_raw_kitti_drive_projects_its_scans_as_kitti_itself_does(raw_drive, real_data):
    recording = open_recording(raw_drive, DEFAULT)
    assert names_of(recording.frames) == ["0000000000", "0000000001"] and recording.unpaired == 1
    assert [frame.time_s for frame in recording.frames] == [0, 1]
    frame = recording.frames[0].read()
    expected = io.read_depth_m(real_data / "kitti_raw_0048/velodyne_raw/0000000000.png", 256)
    assert frame.rgb.shape == (375, 1242, 3)
    assert np.abs(frame.depth_m - expected).max() <= 0.5 / 256 + 1e-5
    np.testing.assert_allclose(frame.intrinsics, [[721.5377, 0, 609.5593], [0, 721.5377, 172.854], [0, 0, 1]])


def test_what_a_raw_kitti_drive_lacks_is_named(raw_drive):
    scan = raw_drive / "velodyne_points/data/0000000001.bin"
    scan.write_bytes(b"cut off")
    recording = open_recording(raw_drive, DEFAULT)
    with pytest.raises(InputError, match=r"0000000001\.bin isn't a scan"):
        recording.frames[1].read()
    (raw_drive.parent / "calib_velo_to_cam.txt").write_text("R: 1 2 3\nT: 0 0 0\n")
    with pytest.raises(InputError, match="3 numbers for R: 9 were expected"):
        open_recording(raw_drive, DEFAULT)
    (raw_drive.parent / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(InputError, match=r"calib_velo_to_cam\.txt is missing"):
        open_recording(raw_drive, DEFAULT)


def test_kittis_depth_layouts_are_recognised(tmp_path):
    name = "2011_09_26_drive_0001_sync"
    rgb = write_rgb(tmp_path / f"raw/2011_09_26/{name}/image_02/data/0000000005.png")
    depth_m = write_depth(tmp_path / f"raw/val/{name}/proj_depth/velodyne_raw/image_02/0000000005.png", 256)
    for path, prefix in ((tmp_path / f"raw/val/{name}", f"{name}_image_02_"), (tmp_path / "selection", "")):
        if not prefix:
            write_rgb(path / "image/0000000005.png")
            write_depth(path / "velodyne_raw/0000000005.png", 256)
        (frame,) = open_recording(path, DEFAULT).frames
        assert frame.name == f"{prefix}0000000005"
        np.testing.assert_array_equal(frame.read().rgb, rgb)
        np.testing.assert_allclose(frame.read().depth_m, depth_m, rtol=1e-6)


def test_the_real_validation_selection_is_a_recording(real_data):
    recording = open_recording(real_data / "kitti_val_selection_cropped", DEFAULT)
    frame = recording.frames[0].read()
    assert len(recording.frames) == 3 and frame.rgb.shape == (352, 1216, 3) and frame.intrinsics is not None


def test_what_is_no_recording_is_refused_with_the_kinds_that_are(tmp_path):
    with pytest.raises(InputError, match=r"no recording of a known kind .*rgb\.txt and depth\.txt"):
        open_recording(tmp_path, DEFAULT)
    with pytest.raises(InputError, match="does not exist"):
        open_recording(tmp_path / "nowhere", DEFAULT)
    (tmp_path / "rgb.txt").write_text("10.01 rgb/10.01.png\n")
    (tmp_path / "depth.txt").write_text("soon depth.png\n")
    with pytest.raises(InputError, match=r"depth\.txt holds 'soon depth\.png' in line 1"):
        open_recording(tmp_path, DEFAULT)
    with pytest.raises(InputError, match="--rgb-topic and --depth-topic are for ROS bags"):
        open_recording(tmp_path, Settings(depth_topic="/depth"))
