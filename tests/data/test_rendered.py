"""A rendered data set on disk, read back by other libraries and by ours, beside frames that are rendered anew."""

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import plyfile
import pytest
from PIL import Image

from depthreg.cli import main
from depthreg.config import compose_config
from depthreg.data import io, rendered
from depthreg.data.frame_files import FILES, read_frame, write_frame
from depthreg.data.rendered import FolderStore, RenderedFrames, folders_in, of_world
from depthreg.data.sample import Frame, LidarReturns
from depthreg.data.synthetic import RandomCamera, SyntheticFrames
from depthreg.errors import InputError
from depthreg.render import build_frames
from depthreg.rendering import RandomOffset, Rig, ScanPattern, hdl64
from depthreg.worlds import BlocksWorld
from depthreg.worlds.scene import Scene

SMALL = ["camera=random", "camera.width=53", "camera.height=37", "camera.focal_px=[30,50]"]
RECIPE = ["world=blocks", *SMALL, "sensor=hdl64", "offset=car", "count=5", "seed=3", "workers=1"]
HALF_STEP_M = 0.5 / 256


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete data set of five frames; not to be changed."""
    folder = tmp_path_factory.mktemp("frames") / "blocks"
    assert main(["render", *RECIPE, f"out={folder}"]) == 0
    return folder


@pytest.fixture
def copied(dataset: Path, tmp_path: Path) -> Path:
    """The same data set, to be changed."""
    return shutil.copytree(dataset, tmp_path / "copied")


@pytest.fixture(scope="module")
def anew() -> SyntheticFrames:
    """What renders the same frames in memory."""
    return build_frames(compose_config("render", RECIPE))


@pytest.fixture(scope="module")
def frame(anew: SyntheticFrames) -> Frame:
    """Frame 1, rendered in memory."""
    return anew.frame(1)


def test_everything_that_a_frame_holds_survives(dataset: Path, frame: Frame) -> None:
    stored = read_frame(dataset / "000001")
    exact = {"rgb", "margin_px", "object_id", "intrinsics", "rgb_right", "baseline_m"}
    within = {"depth_m": HALF_STEP_M, "depth_right_m": HALF_STEP_M, "normal": 2e-5, "albedo": 1e-5, "gloss": 1e-5}
    assert {field.name for field in fields(Frame)} == {*exact, *within, "lidar", "offset"}
    for name in exact:
        np.testing.assert_array_equal(getattr(stored, name), getattr(frame, name), err_msg=name)
    for name, error in within.items():
        np.testing.assert_allclose(getattr(stored, name), getattr(frame, name), rtol=0, atol=error, err_msg=name)
        assert getattr(stored, name).dtype == np.float32
    for field in fields(LidarReturns):
        np.testing.assert_array_equal(getattr(stored.lidar, field.name), getattr(frame.lidar, field.name))
        assert getattr(stored.lidar, field.name).dtype == getattr(frame.lidar, field.name).dtype
    assert stored.offset and frame.offset and len(frame.lidar.ring) > 20
    np.testing.assert_array_equal(stored.offset.rgb, frame.offset.rgb)
    np.testing.assert_array_equal(stored.offset.rgb_from_depth, frame.offset.rgb_from_depth)
    assert (stored.depth_m == 0).tolist() == (frame.depth_m == 0).tolist()
    np.testing.assert_array_equal(stored.normal[frame.object_id < 0], 0)


def test_other_programs_read_the_pictures(dataset: Path, frame: Frame) -> None:
    folder, margin = dataset / "000001", frame.margin_px
    assert margin > 0
    inner = np.asarray(Image.open(folder / "rgb.png"))[margin : margin + 37, margin : margin + 53]
    np.testing.assert_array_equal(inner, frame.rgb[margin : margin + 37, margin : margin + 53])
    for name, depth_m in (("depth.png", frame.depth_m), ("depth_right.png", frame.depth_right_m)):
        np.testing.assert_allclose(np.asarray(Image.open(folder / name)) / 256, depth_m, rtol=0, atol=HALF_STEP_M)
    pictures = [path for path in folder.iterdir() if path.suffix == ".png"]
    assert all(cv2.imread(str(path)) is not None for path in pictures)
    assert {path.name for path in folder.iterdir()} == FILES.keys() | {"files.sha256"}


def test_returns_lie_in_camera_coordinates_with_all_their_columns(dataset: Path, frame: Frame) -> None:
    vertices = plyfile.PlyData.read(str(dataset / "000001" / "lidar.ply"))["vertex"]
    points_m = np.stack([vertices["x"], vertices["y"], vertices["z"]])
    projected, _ = cv2.projectPoints(points_m.T, np.zeros(3), np.zeros(3), frame.intrinsics, None)
    np.testing.assert_allclose(projected[:, 0], frame.lidar.uv_px, atol=1e-3)
    scalars = {field.name for field in fields(LidarReturns)} - {"uv_px", "ray"}
    vectors = {"x", "y", "z", "u_px", "v_px", "ray_x", "ray_y", "ray_z"}
    assert {each.name for each in vertices.properties} == scalars | vectors
    np.testing.assert_array_equal(vertices["ring"], frame.lidar.ring)


def test_the_calibration_says_where_the_instruments_stand(dataset: Path, anew: SyntheticFrames, frame: Frame) -> None:
    calibration, scene = io.read_json(dataset / "000001" / "calibration.json"), BlocksWorld()(3, 1)
    np.testing.assert_array_equal(calibration["camera_from_world"], scene.camera_from_world)
    np.testing.assert_array_equal(calibration["lidar_from_camera"], scene.lidar_from_camera)
    assert (calibration["width"], calibration["height"], calibration["margin_px"]) == (53, 37, frame.margin_px)
    assert calibration["baseline_m"] == frame.baseline_m and calibration["depth_scale"] == 256


@pytest.mark.skipif(not shutil.which("sha256sum"), reason="sha256sum isn't installed")
def test_the_manifest_is_one_that_sha256sum_checks(dataset: Path, copied: Path) -> None:
    command = ["sha256sum", "--check", "--strict", "--quiet", "manifest.sha256"]
    assert subprocess.run(command, cwd=dataset, capture_output=True).returncode == 0
    listed = {line.split("  ")[1] for line in (dataset / "manifest.sha256").read_text().splitlines()}
    there = {path.relative_to(dataset).as_posix() for path in dataset.rglob("*") if path.is_file()}
    assert there - listed == {"manifest.sha256"} | {f"{index:06d}/files.sha256" for index in range(5)}
    change_a_byte(copied / "000002" / "albedo.png")
    assert subprocess.run(command, cwd=copied, capture_output=True).returncode != 0


def change_a_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_a_changed_byte_is_found_and_its_file_is_named(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", f"out={copied}", "verify=true"]) == 0
    change_a_byte(copied / "000002" / "albedo.png")
    assert main(["render", f"out={copied}", "verify=true"]) == 2
    message = capsys.readouterr().err
    assert "000002/albedo.png" in message and len(message.splitlines()) == 1
    (copied / "000001" / "rgb.png").unlink()
    assert main(["render", f"out={copied}", "verify=true"]) == 2
    assert "000001/rgb.png is missing: remove" in capsys.readouterr().err


def test_a_damaged_frame_that_was_removed_is_rendered_as_it_was(copied: Path) -> None:
    before = (copied / "manifest.sha256").read_bytes()
    shutil.rmtree(copied / "000002")
    assert main(["render", *RECIPE, f"out={copied}"]) == 0
    assert main(["render", f"out={copied}", "verify=true"]) == 0
    assert (copied / "manifest.sha256").read_bytes() == before


@dataclass(frozen=True)
class PairDifference:
    """Stands for a stereo matcher: looks at both views and draws a number."""

    gain: float = 1.0

    def __call__(self, frame: Frame, rng: np.random.Generator) -> np.ndarray:
        left = frame.rgb[frame.margin_px : -frame.margin_px, frame.margin_px : -frame.margin_px]
        return np.float32(left[..., 0]) - frame.rgb_right[..., 0] + np.float32(self.gain * rng.uniform())


RIGS = {
    "clean": Rig(),
    "scans": Rig(scans=(hdl64(),)),
    "pair": Rig(scans=(hdl64(),), matchers=(PairDifference(), PairDifference(2.0))),
    "all": Rig(scans=(hdl64(),), matchers=(PairDifference(),), surfaces=True, offset=RandomOffset(0.06, 0.3)),
}


@pytest.mark.parametrize("kind", RIGS)
def test_an_item_is_the_one_that_is_rendered_anew(kind: str, dataset: Path, anew: SyntheticFrames) -> None:
    rig = RIGS[kind]
    direct = SyntheticFrames(anew.world, anew.camera, rig | Rig(scans=(hdl64(),)), anew.seed, 5, max_depth_m=60)
    stored = RenderedFrames(FolderStore(dataset), range(2, 5), rig, 24.0, max_depth_m=60)
    expected, item = direct[3], stored[1]
    assert item.keys() == expected.keys()
    if kind == "clean":  # the data set's returns do no harm
        expected, item = ({**each, "lidar": 0} for each in (expected, item))
    rounded = {"depth_m": HALF_STEP_M, "normal": 2e-5, "albedo": 1e-5, "gloss": 1e-5}
    rounded |= {"offset_affine_rgb_from_depth": 1e-2, "offset_parallax_px": 1e-3}  # fitted to rounded depth
    for key, value in expected.items():
        np.testing.assert_allclose(item[key], value, rtol=0, atol=rounded.get(key, 0), err_msg=key)
        assert np.asarray(item[key]).dtype == np.asarray(value).dtype
    assert (expected["depth_m"] == 0).any() and item["index"] == 3


@pytest.mark.parametrize(
    ("rig", "max_corner_shift_px", "said"),
    [
        (Rig(scans=(replace(hdl64(), max_range_m=50.0),)), 24.0, "scans"),
        (Rig(scans=(hdl64(), ScanPattern((0.0,), 1.0))), 24.0, "scans"),
        (Rig(offset=RandomOffset(0.03, 0.3)), 24.0, "colour camera"),
        (Rig(), 60.0, "margin"),
    ],
)
def test_what_the_frames_lack_for_a_sensor_is_one_sentence(
    rig: Rig, max_corner_shift_px: float, said: str, dataset: Path
) -> None:
    with pytest.raises(InputError, match=said) as refusal:
        RenderedFrames(FolderStore(dataset), range(5), rig, max_corner_shift_px, 120.0)
    assert str(dataset) in str(refusal.value) and "\n" not in str(refusal.value)


def test_an_incomplete_data_set_is_refused(copied: Path) -> None:
    (copied / "manifest.sha256").unlink()
    with pytest.raises(InputError, match="complete"):
        FolderStore(copied)


def test_the_last_frames_are_for_validation() -> None:
    assert rendered.split(5, 0.2) == (range(4), range(4, 5))
    for share in (0, 1):
        with pytest.raises(InputError, match="val_share"):
            rendered.split(5, share)


def test_the_data_set_of_a_world_is_found(dataset: Path, copied: Path) -> None:

    def find(root: Path, name: str) -> Path:
        return of_world(folders_in(root), str(root), {"_target_": f"depthreg.worlds.{name}"})

    assert find(dataset, "BlocksWorld") == find(dataset.parent, "BlocksWorld") == dataset
    with pytest.raises(InputError, match="no data sets of the world DrivingWorld"):
        find(dataset, "DrivingWorld")
    shutil.copytree(dataset, copied.parent / "another")
    with pytest.raises(InputError, match="2 data sets"):
        find(copied.parent, "BlocksWorld")
    with pytest.raises(InputError, match="holds no"):
        find(dataset / "000000", "BlocksWorld")


@pytest.mark.parametrize("name", ["rgb.png", "depth.png", "lidar.ply", "calibration.json"])
@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:40])])
def test_a_missing_or_cut_file_is_named(name: str, damage: Callable[[Path], Any], copied: Path) -> None:
    damage(copied / "000001" / name)
    frames = RenderedFrames(FolderStore(copied), range(5), Rig(), 24.0, 120.0)
    with pytest.raises(InputError, match=f"000001/{name}"):
        frames[1]


def test_a_depth_beyond_16_bits_is_refused_with_the_scale_that_fits(tmp_path: Path, frame: Frame) -> None:
    scene: Scene = BlocksWorld()(3, 1)
    far_m = float(frame.depth_m.max())
    with pytest.raises(InputError, match=r"depth_scale=4000.*expected at most") as refusal:
        write_frame(tmp_path, frame, scene, 4000)
    fitting = float(str(refusal.value).split()[-1])
    assert fitting * far_m <= 65536
    write_frame(tmp_path, frame, scene, int(fitting))


def test_rooms_are_stored_finer_than_streets() -> None:
    assert compose_config("render", ["world=household"]).depth_scale == 4000
    assert compose_config("render").depth_scale == 256
    assert compose_config("render", ["world=household", "depth_scale=1000"]).depth_scale == 1000


def test_a_random_camera_is_that_of_training() -> None:
    ours, training = (
        build_frames(compose_config("render", ["camera=random"])),
        compose_config("train", ["preset=paper"]),
    )
    assert isinstance(ours.camera, RandomCamera)
    assert list(ours.camera.focal_px) == list(training.data.camera.focal_px)
    assert ours.camera.center_jitter == training.data.camera.center_jitter
