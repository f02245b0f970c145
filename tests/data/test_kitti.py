import cv2
import numpy as np
import pytest

from depthreg.data.kitti import KittiDataset
from depthreg.errors import InputError

SIZE = (37, 53)
DRIVE = "2011_09_26_drive_0002_sync"
PROJECTION = "7.2e+01 0.0 2.6e+01 4.5e+01 0.0 7.2e+01 1.7e+01 2.1e-01 0.0 0.0 1.0 2.7e-03"
K = [[72, 0, 26], [0, 72, 17], [0, 0, 1]]


def write_png(path, value, channels=()):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((*SIZE, *channels), value, np.uint8 if channels else np.uint16))


def write_selection(root, truth=True):
    name = f"{DRIVE}_{{}}_0000000008_image_02"
    write_png(root / "image" / f"{name.format('image')}.png", 100, (3,))
    write_png(root / "velodyne_raw" / f"{name.format('velodyne_raw')}.png", 512)
    if truth:
        write_png(root / "groundtruth_depth" / f"{name.format('groundtruth_depth')}.png", 768)
    (root / "intrinsics").mkdir()
    (root / "intrinsics" / f"{name.format('image')}.txt").write_text("72 0 26 0 72 17 0 0 1")


def write_drives(root, raw_root, split="val"):
    for camera in ("image_02", "image_03"):
        proj_depth = root / split / DRIVE / "proj_depth"
        for number in (5, 6):
            name = f"{number:010d}.png"
            write_png(proj_depth / "velodyne_raw" / camera / name, 256 * number)
            write_png(proj_depth / "groundtruth" / camera / name, 256 * (number + 1))
        for number in range(8):  # KITTI raw has frames without depth, too
            write_png(raw_root / DRIVE[:10] / DRIVE / camera / "data" / f"{number:010d}.png", number, (3,))
    calibration = [f"P_rect_02: {PROJECTION}", f"P_rect_03: {PROJECTION.replace('7.2', '7.3')}"]
    (raw_root / DRIVE[:10] / "calib_cam_to_cam.txt").write_text("\n".join(calibration))


@pytest.mark.parametrize("folder", ["", "val_selection_cropped"])
def test_the_validation_selection_is_read_from_its_folder_or_the_one_above(tmp_path, folder):
    write_selection(tmp_path / folder)
    (item,) = KittiDataset(tmp_path)
    assert item["rgb"].shape == (3, *SIZE)
    assert (item["depth_m"].unique().item(), item["truth_depth_m"].unique().item()) == (2, 3)
    assert item["intrinsics"].tolist() == K


def test_a_selection_without_truth_is_read_too(tmp_path):
    write_selection(tmp_path, truth=False)
    (item,) = KittiDataset(tmp_path)
    assert "truth_depth_m" not in item


def test_a_test_set_names_all_kinds_of_files_alike(tmp_path):
    write_png(tmp_path / "image" / "0000000003.png", 100, (3,))
    write_png(tmp_path / "velodyne_raw" / "0000000003.png", 512)
    (item,) = KittiDataset(tmp_path)
    assert item["name"] == "0000000003" and "intrinsics" not in item


@pytest.mark.parametrize("beside", [True, False])
def test_annotated_drives_take_colour_and_intrinsics_from_kitti_raw(tmp_path, beside):
    raw_root = tmp_path / "depth" if beside else tmp_path / "raw"
    write_drives(tmp_path / "depth", raw_root, split="train")
    items = list(KittiDataset(tmp_path / "depth", "train", None if beside else raw_root))
    assert [item["depth_m"].unique().item() for item in items] == [5, 6, 5, 6]
    assert [item["truth_depth_m"].unique().item() for item in items] == [6, 7, 6, 7]
    assert [round(255 * item["rgb"].unique().item()) for item in items] == [5, 6, 5, 6]
    assert [item["intrinsics"][0, 0].item() for item in items] == [72, 72, 73, 73]
    assert len({item["name"] for item in items}) == 4


def test_missing_kitti_raw_is_explained(tmp_path):
    write_drives(tmp_path / "depth", tmp_path / "raw")
    with pytest.raises(InputError, match=r"0000000005\.png is missing: KITTI raw.*raw_root"):
        KittiDataset(tmp_path / "depth")


def test_a_calibration_without_the_camera_is_explained(tmp_path):
    write_drives(tmp_path, tmp_path)
    (tmp_path / DRIVE[:10] / "calib_cam_to_cam.txt").write_text("calib_time: 09-Jan-2012")
    with pytest.raises(InputError, match="holds no P_rect_02"):
        KittiDataset(tmp_path)[0]


def test_another_folder_is_refused_by_naming_what_was_looked_for(tmp_path):
    with pytest.raises(InputError, match="val_selection_cropped or train was expected"):
        KittiDataset(tmp_path, split="train")


@pytest.mark.parametrize("folder", ["velodyne_raw", "val"])
def test_a_layout_without_frames_is_refused(tmp_path, folder):
    (tmp_path / folder).mkdir()
    with pytest.raises(InputError, match="holds no frame"):
        KittiDataset(tmp_path)


def test_real_frames_of_the_validation_selection_are_read(real_data):
    dataset = KittiDataset(real_data / "kitti_val_selection_cropped")
    item = dataset[0]
    assert len(dataset) == 3
    assert item["rgb"].shape == (3, 352, 1216)
    # KITTI's cropped selection: about one pixel in 20 has a return; the camera's focal length is 707.0912 px.
    assert 0.03 < (item["depth_m"] > 0).float().mean() < 0.06
    assert item["intrinsics"][0, 0].item() == pytest.approx(707.0912)
