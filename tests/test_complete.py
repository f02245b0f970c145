"""The command is run for real; a stand-in network with a known answer gives every output a closed form."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch import Tensor, nn

from depthreg import cli
from depthreg import complete as command
from depthreg.errors import InputError
from depthreg.geometry import warp_affine
from depthreg.model import Model
from depthreg.networks import JointNetwork, JointOutput
from depthreg.result import Result

HEIGHT, WIDTH = 67, 91
SHIFT_PX = (3, -2)  # where a depth pixel lies in the colour
SPOT = (slice(20, 23), slice(30, 37))  # rows and columns of a depth that no return bears out
INTRINSICS = np.array([[80.0, 0, 44], [0, 85, 31], [0, 0, 1]])
OUTPUTS = ["affine.json", "confidence.png", "depth.npy", "depth.png", "panel.png", "rgb_aligned.png"]


def _scene_m(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """A slanted surface, 4 to 13 m away."""
    y, x = np.mgrid[:height, :width]
    return (4 + 0.05 * x + 0.06 * y).astype(np.float32)


class KnownAnswer(nn.Module):
    """Answers with the scene and the shift, but with a sky at 10 m above row 8, and with a far spot."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, rgb: Tensor, depth_m: Tensor) -> JointOutput:
        scene_m = torch.from_numpy(_scene_m(*rgb.shape[-2:])).repeat(len(rgb), 1, 1, 1)
        scene_m[:, :, :8] = 10
        scene_m[:, :, *SPOT] = 150
        affine = torch.tensor([[[1.0, 0, SHIFT_PX[0]], [0, 1, SHIFT_PX[1]]]]).repeat(len(rgb), 1, 1)
        return JointOutput(scene_m, warp_affine(rgb, affine)[0], affine, [], torch.ones(len(rgb)), 0 * scene_m)


def _write_depth(path: Path, height: int = HEIGHT, width: int = WIDTH, keep: float = 0.2, seed: int = 0) -> None:
    """A fifth of the scene's pixels as KITTI stores them; the four corners below the sky are among them."""
    kept = np.random.default_rng(seed).random((height, width)) < keep
    kept[:8] = False
    kept[8, [0, -1]] = kept[-1, [0, -1]] = True
    cv2.imwrite(str(path), np.where(kept, np.rint(256 * _scene_m(height, width)), 0).astype(np.uint16))


def _write_rgb(path: Path, height: int = HEIGHT, width: int = WIDTH, seed: int = 0) -> np.ndarray:
    rgb = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    cv2.imwrite(str(path), rgb[..., ::-1])
    return rgb


@pytest.fixture
def inputs(tmp_path, monkeypatch) -> Path:
    """A folder with one usable input of each kind, and a checkpoint that loads as the known answer."""
    monkeypatch.setattr(command, "load", lambda path, device: Model(KnownAnswer()))
    monkeypatch.chdir(tmp_path)
    _write_rgb(tmp_path / "photo.png")
    _write_depth(tmp_path / "sparse.png")
    np.savetxt(tmp_path / "K.txt", INTRINSICS)
    return tmp_path


def _run(*argv: str, out: str = "out") -> int:
    return cli.main(["complete", *argv, "--out", out, "--checkpoint", "last.ckpt", "--device", "cpu"])


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_one_pair_gives_exactly_the_promised_files(inputs):
    assert _run("photo.png", "sparse.png", "--depth-scale", "256") == 0
    assert _names(inputs / "out") == OUTPUTS
    assert _names(inputs) == ["K.txt", "out", "photo.png", "sparse.png"]


def test_depth_is_written_in_metres_and_in_the_inputs_scale(inputs):
    _run("photo.png", "sparse.png", "--depth-scale", "256")
    depth_m = np.load(inputs / "out/depth.npy")
    stored = cv2.imread(str(inputs / "out/depth.png"), cv2.IMREAD_UNCHANGED)
    assert depth_m.dtype == np.float32 and stored.dtype == np.uint16
    np.testing.assert_array_equal(depth_m[30:], _scene_m()[30:])
    assert np.abs(stored / 256 - depth_m).max() <= 0.5 / 256


def test_aligned_colour_and_affine_tell_the_same_shift(inputs):
    rgb = cv2.imread(str(inputs / "photo.png"))
    _run("photo.png", "sparse.png", "--depth-scale", "256")
    told = json.loads((inputs / "out/affine.json").read_text())
    assert told == {"affine_rgb_from_depth": [[1, 0, 3], [0, 1, -2]], "width": WIDTH, "height": HEIGHT, "trust": 1}
    matrix = np.array(told["affine_rgb_from_depth"], dtype=np.float64)
    expected = cv2.warpAffine(rgb, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    aligned = cv2.imread(str(inputs / "out/rgb_aligned.png"))
    assert np.abs(aligned.astype(int) - expected).max() <= 1


def test_the_cloud_is_the_believable_coloured_part_unprojected(inputs):
    _run("photo.png", "sparse.png", "--depth-scale", "256", "--intrinsics", "K.txt")
    assert _names(inputs / "out") == sorted([*OUTPUTS, "cloud.ply"])
    vertex = PlyData.read(inputs / "out/cloud.ply")["vertex"]
    points_m = np.stack([vertex[name] for name in ("x", "y", "z")], axis=1)
    rgb = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1)
    # By hand: no return surrounds the sky or is as far as the spot; the last columns look beyond the colour.
    believable = np.ones((HEIGHT, WIDTH), bool)
    believable[:8] = believable[SPOT] = believable[:, -SHIFT_PX[0] :] = False
    y, x = np.nonzero(believable)
    z = _scene_m()[y, x]
    np.testing.assert_allclose(points_m, np.stack([(x - 44) / 80 * z, (y - 31) / 85 * z, z], axis=1), atol=1e-4)
    photo = cv2.imread(str(inputs / "photo.png"))[..., ::-1]
    assert np.abs(rgb.astype(int) - photo[y + SHIFT_PX[1], x + SHIFT_PX[0]]).max() <= 1


def test_the_summary_says_what_happened(inputs, capsys):
    _run("photo.png", "sparse.png", "--depth-scale", "1000")
    printed = capsys.readouterr().out
    assert "out" in printed and "91x67" in printed and "(+3.0, -2.0) px" in printed and "+0.00 deg" in printed
    assert "ends at 65.53 m" in printed or "ends at 65.54 m" in printed  # 150 m don't fit 16 bits of millimetres


@pytest.mark.parametrize("kind", ["tiff", "npy", "npz", "nan"])
def test_float_depth_of_the_same_content_gives_the_same_result(inputs, kind):
    depth_m = np.float32(cv2.imread("sparse.png", cv2.IMREAD_UNCHANGED) / 256)
    name = {"nan": "sparse.npy"}.get(kind, f"sparse.{kind}")
    writers: dict[str, Callable[[], object]] = {
        "tiff": lambda: cv2.imwrite(name, depth_m),
        "npy": lambda: np.save(name, depth_m),
        "npz": lambda: np.savez(name, depth=depth_m),
        "nan": lambda: np.save(name, np.where(depth_m > 0, depth_m, np.nan)),
    }
    writers[kind]()
    assert _run("photo.png", name, "--depth-scale", "1") == 0
    assert _run("photo.png", "sparse.png", "--depth-scale", "256", out="other") == 0
    assert (inputs / "out/panel.png").read_bytes() == (inputs / "other/panel.png").read_bytes()


def test_an_empty_folder_is_filled(inputs):
    (inputs / "out").mkdir()
    assert _run("photo.png", "sparse.png", "--depth-scale", "256") == 0
    assert _names(inputs / "out") == OUTPUTS


def test_an_interrupt_leaves_nothing(inputs, monkeypatch):
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    before = _names(inputs)
    monkeypatch.setattr(Result, "save", interrupted)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        command.main(["photo.png", "sparse.png", "--depth-scale", "256", "--out", "out", "--checkpoint", "last.ckpt"])
    assert _names(inputs) == before


BAD_INPUTS = {
    "missing colour": (["nowhere.png", "sparse.png"], "nowhere.png"),
    "missing depth": (["photo.png", "nowhere.png"], "nowhere.png"),
    "broken colour": (["broken.jpg", "sparse.png"], "broken.jpg"),
    "broken depth": (["photo.png", "broken.tiff"], "broken.tiff"),
    "colour of an unknown kind": (["photo.bmp", "sparse.png"], "photo.bmp"),
    "8-bit depth": (["photo.png", "photo.png"], "photo.png"),
    "file with folder": (["photo.png", "empty"], "two files or two folders"),
    "empty folders": (["empty", "empty"], "empty holds no file"),
    "sizes that differ": (["wide.png", "sparse.png"], "92x67 but sparse.png is 91x67"),
    "too small": (["small.png", "small_depth.png"], "at least 64x64"),
    "no return": (["photo.png", "none.npy"], "no valid return"),
    "only NaN": (["photo.png", "nan.npy"], "no valid return"),
    "negative depth": (["photo.png", "negative.npy"], "negative or infinite"),
    "infinite depth": (["photo.png", "infinite.npy"], "negative or infinite"),
    "negative scale": (["photo.png", "sparse.png", "--depth-scale", "-1"], "depth scale"),
    "scale that is no number": (["photo.png", "sparse.png", "--depth-scale", "mm"], "--depth-scale"),
    "missing intrinsics": (["photo.png", "sparse.png", "--intrinsics", "nowhere.txt"], "nowhere.txt"),
    "too few intrinsics": (["photo.png", "sparse.png", "--intrinsics", "eight.txt"], "9 numbers"),
    "unknown option": (["photo.png", "sparse.png", "--fast"], "--fast"),
    "unknown device": (["photo.png", "sparse.png", "--device", "abacus"], "--device abacus"),
}


@pytest.fixture
def bad_inputs(inputs) -> Path:
    """Whatever `BAD_INPUTS` names."""
    (inputs / "empty").mkdir()
    for name in ("broken.jpg", "broken.tiff", "photo.bmp"):
        (inputs / name).write_bytes(b"no picture")
    _write_rgb(inputs / "wide.png", HEIGHT, WIDTH + 1)
    _write_rgb(inputs / "small.png", HEIGHT, 63)
    _write_depth(inputs / "small_depth.png", HEIGHT, 63)
    for name, value in {"none": 0, "nan": np.nan, "negative": -1, "infinite": np.inf}.items():
        spoilt = np.full((HEIGHT, WIDTH), value, np.float32)
        spoilt[5, 5] = 3 if name in ("negative", "infinite") else value
        np.save(inputs / f"{name}.npy", spoilt)
    (inputs / "eight.txt").write_text("1 0 1 0 1 1 0 0")
    return inputs


@pytest.mark.parametrize("case", BAD_INPUTS)
def test_bad_input_is_one_sentence_with_status_2_and_nothing_written(bad_inputs, capfd, case):
    argv, complaint = BAD_INPUTS[case]
    before = _names(bad_inputs)
    scale = [] if "--depth-scale" in argv else ["--depth-scale", "256"]
    device = [] if "--device" in argv else ["--device", "cpu"]
    status = cli.main(["complete", *argv, *scale, *device, "--out", "out", "--checkpoint", "last.ckpt"])
    printed = capfd.readouterr()
    assert status == 2 and printed.out == ""
    assert complaint in printed.err and printed.err.startswith("depthreg complete: ")
    assert len(printed.err.splitlines()) == 1 and "Traceback" not in printed.err
    assert _names(bad_inputs) == before


@pytest.mark.parametrize(
    ("leave_out", "complaint"),
    [("--depth-scale", "--depth-scale"), ("--out", "--out")],
)
def test_required_options_are_asked_for(inputs, capfd, leave_out, complaint):
    options = {"--depth-scale": "256", "--out": "out", "--checkpoint": "last.ckpt"}
    argv = [word for option in options.items() if option[0] != leave_out for word in option]
    assert cli.main(["complete", "photo.png", "sparse.png", *argv]) == 2
    assert complaint in capfd.readouterr().err
    assert not (inputs / "out").exists()


def test_nothing_that_a_user_made_is_overwritten(inputs, monkeypatch, capfd):
    monkeypatch.setattr(command, "load", lambda path, device: pytest.fail("the network was loaded"))
    (inputs / "out").mkdir()
    (inputs / "out/mine.txt").write_text("precious")
    assert _run("photo.png", "sparse.png", "--depth-scale", "256") == 2
    assert _run("photo.png", "sparse.png", "--depth-scale", "256", out="photo.png") == 2
    assert _names(inputs / "out") == ["mine.txt"]
    assert "out isn't empty" in capfd.readouterr().err


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is write-protected for root")
def test_a_write_protected_place_is_refused(inputs, capfd):
    (inputs / "locked").mkdir(mode=0o500)
    assert _run("photo.png", "sparse.png", "--depth-scale", "256", out="locked/out") == 2
    assert "write-protected" in capfd.readouterr().err


def test_a_checkpoint_that_cannot_be_used_is_refused(inputs, monkeypatch, capfd):
    def refuse(path: Path, device: torch.device) -> Model:
        raise InputError(f"{path} is no checkpoint of depthreg")

    monkeypatch.setattr(command, "load", refuse)
    assert _run("photo.png", "sparse.png", "--depth-scale", "256") == 2
    assert "last.ckpt is no checkpoint" in capfd.readouterr().err
    assert not (inputs / "out").exists()


def test_the_real_network_completes_a_real_frame(real_data, tmp_path, monkeypatch):
    torch.manual_seed(0)
    network = JointNetwork(first_channels=8, completion_widths=(16, 16, 32, 32))
    monkeypatch.setattr(command, "load", lambda path, device: Model(network))
    monkeypatch.chdir(tmp_path)
    frame = real_data / "kitti_dc_official/triple_5"
    assert _run(str(frame / "rgb.png"), str(frame / "sparse_depth.png"), "--depth-scale", "256") == 0
    depth_m = np.load("out/depth.npy")
    assert depth_m.shape == (352, 1216) and np.isfinite(depth_m).all() and depth_m.min() > 0
