"""What a page shows, from a network with a known answer: pictures, words and files have closed forms."""

import json
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch import Tensor, nn

from depthreg.demonstration.answer import MAX_PIXELS, Upload, answer, orbit
from depthreg.demonstration.examples import Example
from depthreg.errors import InputError
from depthreg.geometry import warp_affine
from depthreg.model import Model
from depthreg.networks import JointOutput

HEIGHT, WIDTH = 67, 91
K = np.array([[80.0, 0, 44], [0, 85, 31], [0, 0, 1]])
ANGLE = np.deg2rad(2)


class TurnedWall(nn.Module):
    """Answers with a wall at 4 m, and with colour that is turned by 2 degrees about the corner and moved."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, rgb: Tensor, depth_m: Tensor) -> JointOutput:
        wall_m, (cos, sin) = torch.full_like(depth_m, 4), (np.cos(ANGLE), np.sin(ANGLE))
        # x right, y down: a positive angle turns x towards y, which is clockwise to who looks at it.
        x, y = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
        moved = [[cos, -sin, x - cos * x + sin * y - 3], [sin, cos, y - sin * x - cos * y + 2]]
        affine = torch.tensor([moved], dtype=torch.float32)
        expected = torch.full_like(wall_m, 0.025)
        return JointOutput(wall_m, warp_affine(rgb, affine)[0], affine, [], torch.tensor([0.9]), expected)


@pytest.fixture
def upload(tmp_path: Path) -> Upload:
    rgb = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth_m = np.zeros((HEIGHT, WIDTH), np.float32)
    depth_m[::4, ::3] = 4
    depth_m[[0, 0, -1, -1], [0, -1, 0, -1]] = 4
    (tmp_path / "in").mkdir()
    cv2.imwrite(str(tmp_path / "in" / "photo.png"), rgb)
    np.save(tmp_path / "in" / "sparse.npy", depth_m)
    np.savetxt(tmp_path / "in" / "K.txt", K)
    (tmp_path / "out").mkdir()
    return Upload(*(tmp_path / "in" / name for name in ("photo.png", "sparse.npy")), 1, tmp_path / "in" / "K.txt")


@pytest.fixture
def model() -> Model:
    return Model(TurnedWall())


def test_words_say_where_colour_is_as_one_sees_it(model: Model, upload: Upload, tmp_path: Path) -> None:
    words = answer(model, upload, tmp_path / "out").words
    assert "3.0 px further to the left and 2.0 px lower than in the depth" in words
    assert "turned by 2.00° clockwise" in words and "trusts that at 0.90 of 1" in words
    assert f"of {WIDTH}x{HEIGHT} pixels had a depth, and now all have, from 4.00 to 4.00 m" in words


def test_the_files_are_those_of_the_command(model: Model, upload: Upload, tmp_path: Path) -> None:
    files = {path.name: path for path in answer(model, upload, tmp_path / "out").files}
    assert {"depth.npy", "depth.png", "rgb_aligned.png", "affine.json", "cloud.ply"} <= files.keys()
    assert np.array_equal(np.load(files["depth.npy"]), np.full((HEIGHT, WIDTH), 4, np.float32))
    affine = np.array(json.loads(files["affine.json"].read_text())["affine_rgb_from_depth"])
    assert np.allclose(affine[:, :2], cv2.getRotationMatrix2D((0, 0), -2, 1)[:, :2], atol=1e-6)


def test_the_cloud_is_turned_for_viewers_whose_y_is_up(model: Model, upload: Upload, tmp_path: Path) -> None:
    made = answer(model, upload, tmp_path / "out")
    assert made.cloud is not None
    camera, viewer = (
        np.array(PlyData.read(path)["vertex"][["x", "y", "z"]].tolist())
        for path in (next(path for path in made.files if path.name == "cloud.ply"), made.cloud.path)
    )
    assert np.array_equal(viewer, camera * [1, -1, -1]) and (viewer[:, 2] == -4).all()


def test_the_cloud_is_looked_at_from_where_the_camera_was() -> None:
    box = np.array([[1, -2, -3], [4, 6, -9]])
    azimuth, inclination, distance = np.deg2rad(orbit(box))  # spherical coordinates about the middle (2.5, 2, -6)
    distance = np.rad2deg(distance)
    around = [np.cos(azimuth) * np.sin(inclination), np.cos(inclination), np.sin(azimuth) * np.sin(inclination)]
    assert np.allclose([2.5, 2, -6] + distance * np.array(around), 0, atol=1e-9)


def test_both_errors_have_one_scale_of_metres(model: Model, upload: Upload, tmp_path: Path) -> None:
    truth_m = np.full((HEIGHT, WIDTH), 4.1, np.float32)  # as far off as the network expects: 2.5 % of 4 m
    truth_m[:, 50:] = 0
    assert upload.intrinsics is not None
    example = Example("a wall", upload.rgb, upload.depth, upload.intrinsics, truth_m, np.eye(2, 3))
    made = answer(model, upload, tmp_path / "out", example)
    assert made.expected_error is not None and made.true_error is not None
    assert made.expected_error.shape == made.true_error.shape and made.expected_error.shape[1] > WIDTH
    difference = made.expected_error.astype(int) - made.true_error
    assert np.abs(difference[:, :50]).max() <= 2 and not difference[:, WIDTH:].any()
    assert len(np.unique(made.true_error[:, 50:WIDTH])) == 1  # unknown: grey
    corners = np.array([[0, 0, 1], [WIDTH - 1, 0, 1], [0, HEIGHT - 1, 1], [WIDTH - 1, HEIGHT - 1, 1]])
    affine = np.array(json.loads(made.files[0].read_text())["affine_rgb_from_depth"])
    off_px = np.linalg.norm(corners @ affine.T - corners[:, :2], axis=1).mean()
    assert f"off by {off_px:.1f} px at the corners and depth by 0.10 m" in made.words


def test_without_a_camera_matrix_there_is_no_cloud_and_it_says_why(
    model: Model, upload: Upload, tmp_path: Path
) -> None:
    made = answer(model, upload._replace(intrinsics=None), tmp_path / "out")
    assert made.cloud is None and "A cloud needs K" in made.words


def test_old_answers_make_room(model: Model, upload: Upload, tmp_path: Path) -> None:
    for _ in range(12):
        last = answer(model, upload, tmp_path / "out")
    assert len(list((tmp_path / "out").iterdir())) <= 20
    assert all(path.exists() for path in last.files)


def _png_bomb(path: Path) -> None:
    """A few kilobytes that unpack to 400 megapixels."""
    cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
    content = bytearray(path.read_bytes())
    content[16:24] = (20_000).to_bytes(4, "big") * 2  # IHDR's width and height
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    path.write_bytes(bytes(content))


def _npz_bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("depth.npy", "w") as file:
        np.lib.format.write_array(file, np.zeros(9 * MAX_PIXELS, np.uint8))


SMALL = np.ones((40, 91), np.float32)


@pytest.mark.parametrize(
    ("field", "name", "write", "sentence"),
    [
        ("rgb", "x.png", lambda path: path.write_text("no picture"), "x.png can't be decoded: an intact"),
        ("rgb", "x.png", _png_bomb, "x.png is too large for this page: at most 4 megapixels"),
        ("depth", "x.npz", _npz_bomb, "x.npz is too large for this page: at most 4 megapixels"),
        ("depth", "x.npz", lambda path: path.write_text("no zip"), "x.npz can't be decoded: an intact NPZ"),
        ("depth", "x.npy", lambda path: np.save(path, SMALL), "photo.png is 91x67 but x.npy is 91x40: one size"),
        ("depth", "x.npy", lambda path: np.save(path, 0 * SMALL), "x.npy holds no valid return"),
        ("intrinsics", "x.txt", lambda path: path.write_text("1 2 3"), "x.txt must hold the 9 numbers of K"),
    ],
)
def test_what_cant_be_used_is_one_sentence_without_folders(
    field: str, name: str, write, sentence: str, model: Model, upload: Upload, tmp_path: Path
) -> None:
    write(tmp_path / "in" / name)
    with pytest.raises(InputError, match="^" + sentence) as caught:
        answer(model, upload._replace(**{field: tmp_path / "in" / name}), tmp_path / "out")
    assert str(tmp_path) not in str(caught.value)
    assert not list((tmp_path / "out").iterdir())


def test_an_unusable_scale_or_size_is_one_sentence(model: Model, upload: Upload, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the depth scale must be a positive number"):
        answer(model, upload._replace(depth_scale=0), tmp_path / "out")
    cv2.imwrite(str(upload.rgb), np.zeros((40, 91, 3), np.uint8))
    np.save(upload.depth, SMALL)
    with pytest.raises(InputError, match="at least 64x64 was expected"):
        answer(model, upload, tmp_path / "out")
