"""The gallery's files, read back by OpenCV and NumPy."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from depthreg.cli import main
from depthreg.data.sample import Frame, LidarReturns
from depthreg.errors import InputError
from depthreg.render import frame_panel, lidar_image, render_gallery
from depthreg.rendering import Camera, hdl64, render_frame
from depthreg.worlds import BlocksWorld
from depthreg.worlds.scene import Scene

CAMERA = Camera(width=97, height=41, focal_px=60.0, margin_px=5)


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return render_gallery(BlocksWorld(), CAMERA, hdl64(), 3, 2, tmp_path_factory.mktemp("runs") / "gallery")


@pytest.fixture(scope="module")
def frame() -> Frame:
    return render_frame(BlocksWorld()(3, 1), CAMERA, hdl64())


def _read(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_each_frame_gets_a_folder_of_its_own(gallery: list[Path]) -> None:
    assert [folder.name for folder in gallery] == ["000000", "000001"]
    names = {"rgb.png", "rgb_right.png", "depth.png", "lidar.png", "intrinsics.txt", "panel.png"}
    for folder in gallery:
        assert {path.name for path in folder.iterdir()} == names
    assert {path.name for path in gallery[0].parent.iterdir()} == {"000000", "000001", "overview.png"}


def test_the_files_hold_the_frame_on_one_grid(gallery: list[Path], frame: Frame) -> None:
    folder = gallery[1]
    np.testing.assert_array_equal(_read(folder / "rgb.png")[..., ::-1], frame.rgb[5:-5, 5:-5])
    np.testing.assert_array_equal(_read(folder / "rgb_right.png")[..., ::-1], frame.rgb_right)
    np.testing.assert_allclose(_read(folder / "depth.png") / 256, frame.depth_m, atol=0.5 / 256)
    np.testing.assert_allclose(np.loadtxt(folder / "intrinsics.txt"), frame.intrinsics, rtol=1e-5)


def test_stored_returns_are_the_frames_returns(gallery: list[Path], frame: Frame) -> None:
    stored = _read(gallery[1] / "lidar.png")
    assert stored.dtype == np.uint16
    column, row = np.rint(frame.lidar.uv_px).astype(int).T
    assert (stored > 0).sum() == len(np.unique(row * 97 + column))
    assert (stored[row, column] / 256 <= frame.lidar.depth_m + 0.5 / 256).all()


def test_the_nearest_return_of_a_pixel_wins() -> None:
    one = np.ones(3, np.float32)
    uv = np.array([[2.2, 1.0], [1.8, 1.4], [0.0, 0.0]], np.float32)
    returns = LidarReturns(
        uv, np.array([9, 4, 7], np.float32), *[one] * 6, np.zeros(3, np.int16), *[one] * 3, np.zeros((3, 3))
    )
    image = np.zeros((3, 5), np.float32)
    planes = dict.fromkeys(("rgb", "object_id", "normal", "albedo", "gloss", "rgb_right", "depth_right_m"), image)
    frame = Frame(**planes, depth_m=image, margin_px=0, intrinsics=np.eye(3), baseline_m=0.5, lidar=returns)
    expected = np.zeros((3, 5))
    expected[1, 2], expected[0, 0] = 4, 7
    np.testing.assert_array_equal(lidar_image(frame), expected)


def test_the_panel_shows_five_pictures_of_the_frame(frame: Frame) -> None:
    panel = frame_panel(frame)
    assert panel.dtype == np.uint8
    assert panel.shape[0] > 5 * 41
    # The right camera's image appears in it, pixel for pixel.
    found = cv2.matchTemplate(panel, frame.rgb_right, cv2.TM_SQDIFF)
    _, _, (x, y), _ = cv2.minMaxLoc(found)
    np.testing.assert_array_equal(panel[y : y + 41, x : x + 97], frame.rgb_right)


def test_without_a_lidar_its_image_is_empty(tmp_path: Path) -> None:
    (folder,) = render_gallery(BlocksWorld(), CAMERA, None, 0, 1, tmp_path / "gallery")
    assert not _read(folder / "lidar.png").any()


@pytest.mark.parametrize("count", [0, -3])
def test_no_frames_is_bad_input_and_nothing_is_written(tmp_path: Path, count: int) -> None:
    with pytest.raises(InputError, match=f"count={count}"):
        render_gallery(BlocksWorld(), CAMERA, None, 0, count, tmp_path / "gallery")
    assert not list(tmp_path.iterdir())


def test_a_folder_with_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="isn't empty"):
        render_gallery(BlocksWorld(), CAMERA, None, 0, 1, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_failure_half_way_leaves_nothing(tmp_path: Path) -> None:
    def world(seed: int, index: int) -> Scene:
        if index == 1:
            raise RuntimeError("the world ended")
        return BlocksWorld()(seed, index)

    with pytest.raises(RuntimeError, match="ended"):
        render_gallery(world, CAMERA, None, 0, 2, tmp_path / "gallery")
    assert not list(tmp_path.iterdir())


SMALL = ["camera.width=70", "camera.height=40", "camera.focal_px=50.5"]


def test_the_command_makes_a_gallery_of_the_world_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", "world=blocks", "count=1", "seed=3", *SMALL]) == 0
    (folder,) = (tmp_path / "runs" / "render").iterdir()
    assert str(folder) in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {"000000", "overview.png"}
    stored = _read(folder / "000000" / "depth.png")
    expected = render_frame(BlocksWorld()(3, 0), Camera(70, 40, 50.5), None, right=False)
    np.testing.assert_allclose(stored / 256, expected.depth_m, atol=0.5 / 256)


@pytest.mark.parametrize(
    "override",
    ["count=0", "count=-1", "count=2.5", "seed=-1", "camera.focal_px=far", "camera.width=0", "wrld=blocks"],
)
def test_bad_overrides_are_one_sentence_and_write_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], override: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", override]) == 2
    captured = capsys.readouterr()
    assert override.split("=")[0] in captured.err
    assert captured.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_command_leaves_a_folder_with_files_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thesis.txt").write_text("mine")
    assert main(["render", "out=.", *SMALL]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
