"""`depthreg complete` over many frames: what is written, left out, resumed and refused. A stand-in network counts."""

import json
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from depthreg import cli
from depthreg import complete as command
from depthreg.geometry import warp_affine
from depthreg.model import Model
from depthreg.networks import JointOutput
from depthreg.result import Result

HEIGHT, WIDTH = 66, 71


class Counting(nn.Module):
    """Answers with twice the mean depth and a shift by the mean of the colour; notes how many frames it gets."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self.batches: list[int] = []

    def forward(self, rgb: Tensor, depth_m: Tensor) -> JointOutput:
        self.batches.append(len(rgb))
        dense_m = (2 * depth_m.mean(dim=(1, 2, 3), keepdim=True)).expand_as(depth_m).clone()
        affine = torch.eye(2, 3).repeat(len(rgb), 1, 1)
        affine[:, 0, 2] = rgb.mean(dim=(1, 2, 3))
        trust = torch.ones(len(rgb))
        return JointOutput(dense_m, warp_affine(rgb, affine)[0], affine, [], trust, torch.full_like(depth_m, torch.nan))


@pytest.fixture
def network(monkeypatch, tmp_path) -> Counting:
    """What any checkpoint loads as."""
    network = Counting()
    monkeypatch.setattr(command, "load", lambda path, device: Model(network))
    monkeypatch.chdir(tmp_path)
    return network


def _write_pair(rgb: str, depth: str, seed: int = 0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    rng = np.random.default_rng(seed)
    for path in (rgb, depth):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(rgb, rng.integers(0, 256, (*size, 3), dtype=np.uint8))
    cv2.imwrite(depth, np.where(rng.random(size) < 0.3, rng.integers(500, 9000, size), 0).astype(np.uint16))


@pytest.fixture
def folders(network) -> list[str]:
    """Five pairs in two folders, the last of another size and kind."""
    for seed, name in enumerate("abcd"):
        _write_pair(f"rgb/{name}.png", f"depth/{name}.png", seed)
    _write_pair("rgb/e.jpg", "depth/e.png", 4, (70, 80))
    Path("rgb/notes.txt").write_text("no picture")
    Path("rgb/.hidden.png").write_text("no picture")
    return ["rgb", "depth", "--depth-scale", "1000"]


def _run(*argv: str, out: str = "out") -> int:
    return cli.main(["complete", *argv, "--out", out, "--checkpoint", "last.ckpt", "--device", "cpu"])


def _names(folder: str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


def _contents(folder: str) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def test_two_folders_work_as_two_files_do(folders):
    np.savetxt("K.txt", [[60, 0, 35], [0, 60, 33], [0, 0, 1]])
    assert _run(*folders, "--intrinsics", "K.txt") == 0
    assert _names("out") == ["a", "b", "c", "d", "e", "made_with.json"]  # no rig of frames whose sizes differ
    assert _run("rgb/e.jpg", "depth/e.png", *folders[2:], "--intrinsics", "K.txt", out="alone") == 0
    assert _contents("out/e") == _contents("alone") and "cloud.ply" in _names("alone")


def test_frames_of_one_size_go_through_the_network_together(folders, network):
    assert _run(*folders, "--batch-size", "3") == 0
    assert network.batches == [3, 1, 1]
    assert _run(*folders, out="single") == 0
    assert network.batches[3:] == [1] * 5
    assert _contents("out") == _contents("single")


def test_every_second_frame_can_be_asked_for_and_the_others_later(folders, network):
    assert _run(*folders, "--every", "2") == 0
    assert _names("out") == ["a", "c", "e", "made_with.json"] and len(network.batches) == 3
    assert _run(*folders) == 0
    assert len(network.batches) == 5 and "d" in _names("out")


def test_what_cannot_be_read_is_named_left_out_and_made_once_it_can(folders, network, capfd):
    good = Path("depth/b.png").read_bytes()
    Path("depth/b.png").write_bytes(good[:200])
    cv2.imwrite("depth/d.png", np.zeros((HEIGHT, WIDTH), np.uint16))
    assert _run(*folders) == 3
    printed = capfd.readouterr()
    complaints = printed.err.splitlines()
    assert len(complaints) == 2 and all(line.startswith("depthreg complete: depth/") for line in complaints)
    assert "b.png can't be decoded" in complaints[0] and "d.png holds no valid return" in complaints[1]
    assert "3 completed, 2 could not be used and were left out" in printed.out
    assert _names("out") == ["a", "c", "e", "made_with.json"]
    Path("depth/b.png").write_bytes(good)
    assert _run(*folders) == 3
    assert "1 completed, 3 were there already, 1 could not be used" in capfd.readouterr().out
    assert len(network.batches) == 4 and "b" in _names("out")


def test_a_stopped_run_goes_on_where_it_was_stopped(folders, network, monkeypatch):
    save = Result.save

    def interrupted(self: Result, folder: Path, depth_scale: float) -> None:
        save(self, folder, depth_scale)
        if ".c." in str(folder):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Result, "save", interrupted)
        assert _run(*folders) == 130
    done = [name for name in _names("out") if len(name) == 1]
    assert done == ["a", "b"]
    Path("out/.c.0123abcd").mkdir()  # what a killed process leaves behind
    before, computed = _contents("out/a"), len(network.batches)
    assert _run(*folders) == 0
    assert len(network.batches) - computed == 3 and _contents("out/a") == before
    assert _run(*folders, out="undisturbed") == 0
    assert _contents("out") == _contents("undisturbed")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("weights", "weights"),
        ("scale", "--depth-scale 1000.0, not 500.0"),
        ("files", "depth"),
        ("camera", "--intrinsics None"),
    ],
)
def test_results_of_other_weights_or_options_are_not_mixed(folders, network, capfd, change, complaint):
    assert _run(*folders) == 0
    before = _contents("out")
    if change == "weights":
        network.weight.data += 1
    np.savetxt("K.txt", [[60, 0, 35], [0, 60, 33], [0, 0, 1]])
    Path("rgb2").symlink_to("rgb")
    argv = {
        "weights": folders,
        "scale": [*folders[:2], "--depth-scale", "500"],
        "files": ["rgb2", *folders[1:]],
        "camera": [*folders, "--intrinsics", "K.txt"],
    }[change]
    capfd.readouterr()
    assert _run(*argv) == 2
    printed = capfd.readouterr().err
    assert (
        complaint in printed and "the same or a new folder was expected" in printed and len(printed.splitlines()) == 1
    )
    assert _contents("out") == before


def test_a_folder_of_the_users_own_is_left_alone(folders, monkeypatch, capfd):
    monkeypatch.setattr(command, "load", lambda path, device: pytest.fail("the network was loaded"))
    Path("out").mkdir()
    Path("out/mine.txt").write_text("precious")
    assert _run(*folders) == 2
    assert "out isn't empty" in capfd.readouterr().err and _names("out") == ["mine.txt"]


@pytest.mark.parametrize("lonely", ["rgb/f.png", "depth/f.png", "rgb/e.png"])
def test_files_without_exactly_one_partner_are_refused(folders, capfd, lonely):
    cv2.imwrite(lonely, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert _run(*folders) == 2
    assert lonely in capfd.readouterr().err and not Path("out").exists()


@pytest.fixture
def tum(network) -> None:
    """A recording of twelve frames, a tenth of a second apart, of Freiburg's third camera."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for number in range(12):
        time = f"{50 + number / 10:.4f}"
        _write_pair(f"freiburg3/rgb/{time}.png", f"freiburg3/depth/{time}.png", number)
        for name, lines in lists.items():
            lines.append(f"{time} {name}/{time}.png\n")
    for name, lines in lists.items():
        Path(f"freiburg3/{name}.txt").write_text("".join(lines))


def test_a_recording_needs_no_scale_and_says_how_its_rig_is_aligned(tum, capfd):
    assert _run("freiburg3") == 0
    assert _names("out/50.1000") == [
        "affine.json",
        "cloud.ply",
        "depth.npy",
        "depth.png",
        "panel.png",
        "rgb_aligned.png",
    ]
    stored = cv2.imread("out/50.1000/depth.png", cv2.IMREAD_UNCHANGED)
    assert np.abs(stored / 5000 - np.load("out/50.1000/depth.npy")).max() <= 0.5 / 5000 + 1e-6
    rig = json.loads(Path("out/rig.json").read_text())
    affines = [json.loads(path.read_text())["affine_rgb_from_depth"] for path in Path("out").glob("*/affine.json")]
    assert (rig["verdict"], rig["frames_used"], rig["unit_of_duration"]) == ("constant", 12, "s")
    assert rig["duration"] == pytest.approx(1.1)
    assert rig["parameters"]["x_px"]["median"] == pytest.approx(np.median([affine[0][2] for affine in affines]))
    printed = " ".join(capfd.readouterr().out.split())
    assert "colour is off by (+0.5, +0.0) px, +0.00 deg" in printed and "constant over 1.1 s" in printed
    assert Path("out/rig.html").stat().st_size > 1e6  # needs no network


def test_a_viewer_gets_each_frame_that_is_made_with_its_time(tum, monkeypatch):
    logged: list[tuple[str, tuple[int, ...], float]] = []

    class Log:
        def log(self, name: str, result: Result, time_s: float) -> None:
            logged.append((name, result.depth_m.shape, time_s))

    monkeypatch.setattr(command.view, "open_log", lambda show, path: nullcontext(Log()))
    assert _run("freiburg3", "--every", "4", "--batch-size", "2") == 0
    assert logged == [(f"{time:.4f}", (HEIGHT, WIDTH), time) for time in (50.0, 50.4, 50.8)]


def test_what_is_no_recording_and_has_no_partner_is_refused(network, capfd):
    _write_pair("photo.png", "sparse.png")
    assert _run("photo.png") == 2
    printed = capfd.readouterr().err
    assert "photo.png is no recording of a known kind" in printed and "name both" in printed


@pytest.mark.parametrize("option", [["--batch-size", "0"], ["--every", "two"], ["--depth-scale", "nan"]])
def test_senseless_numbers_are_refused(tum, capfd, option):
    assert _run("freiburg3", *option) == 2
    assert option[0] in capfd.readouterr().err and not Path("out").exists()
