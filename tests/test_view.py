"""What is logged is read back by Rerun's own reader, and compared with the result it came from."""

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

import depthreg
from depthreg import complete, view
from depthreg.cli import main
from depthreg.errors import InputError
from depthreg.geometry import warp_affine
from depthreg.networks import JointOutput

HEIGHT, WIDTH = 67, 91
K = np.array([[80.0, 0, 44], [0, 85, 31], [0, 0, 1]], np.float32)
IMAGES = ["/colour/aligned", "/colour/given", "/confidence", "/depth/completed", "/depth/sparse", "/edges"]


class Wall(nn.Module):
    """Answers with a wall at the mean of the returns, and with a shift of (2, 1) pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, rgb: Tensor, depth_m: Tensor) -> JointOutput:
        wall_m = torch.full_like(depth_m, depth_m[depth_m > 0].mean())
        affine = torch.tensor([[[1.0, 0, 2], [0, 1, 1]]])
        return JointOutput(
            wall_m, warp_affine(rgb, affine)[0], affine, [], torch.ones(1), 0.1 * torch.ones_like(wall_m)
        )


def measure(distance_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture, and a return on every third pixel."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rgb = np.stack([2 * x, 3 * y, x + y + 20 * distance_m], axis=-1).clip(0, 255).astype(np.uint8)
    depth_m = np.where((x + y) % 3, 0, distance_m).astype(np.float32)
    depth_m[0, 0] = depth_m[0, -1] = depth_m[-1, 0] = depth_m[-1, -1] = distance_m
    return rgb, depth_m


@pytest.fixture
def results() -> list[depthreg.Result]:
    model = depthreg.Model(Wall())
    return [model(*measure(distance_m), K) for distance_m in (2.0, 3.0)]


def read(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Entity -> its rows in the order of time, each column by its name."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(path)
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in reader.stream().to_chunks():
        if not chunk.is_static:
            rows.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return {entity: sorted(found, key=lambda row: row["frame"]) for entity, found in rows.items()}


def value(row: dict[str, Any], component: str) -> Any:
    """The one column whose name ends so."""
    (found,) = [cell for name, cell in row.items() if name.endswith(f":{component}")]
    return found


@pytest.fixture
def rows(results: list[depthreg.Result], tmp_path: Path) -> dict[str, list[dict[str, Any]]]:
    pytest.importorskip("rerun", reason="Rerun isn't installed: pip install 'depthreg[view]'")
    with view.open_log(False, tmp_path / "frames.rrd") as log:
        for index, result in enumerate(results):
            log.log(f"frame {index}", result, time_s=0.5 + index)
    return read(tmp_path / "frames.rrd")


def test_every_frame_is_a_step_of_one_timeline(rows: dict[str, list[dict[str, Any]]]) -> None:
    assert {*IMAGES, "/world/cloud", "/world/camera", "/text"} <= rows.keys()
    for entity, found in rows.items():
        if not entity.startswith("/__"):
            assert [row["frame"] for row in found] == [0, 1], entity
            assert [row["time"].total_seconds() for row in found] == [0.5, 1.5], entity


def test_depth_is_stored_in_metres_to_the_bit(results: Any, rows: dict[str, list[dict[str, Any]]]) -> None:
    for index, result in enumerate(results):
        for entity, depth_m in (("/depth/sparse", result.sparse_depth_m), ("/depth/completed", result.depth_m)):
            (buffer,) = value(rows[entity][index], "buffer")
            assert bytes(buffer) == depth_m.tobytes()
            assert value(rows[entity][index], "meter") == [1.0]


def test_colour_before_and_after_is_what_a_jpeg_decoder_sees(
    results: Any, rows: dict[str, list[dict[str, Any]]]
) -> None:
    for index, result in enumerate(results):
        for entity, rgb in (("/colour/given", result.rgb), ("/colour/aligned", result.rgb_aligned)):
            (blob,) = value(rows[entity][index], "blob")
            decoded = cv2.imdecode(np.array(blob, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
            assert np.abs(decoded[8:-8, 8:-8].astype(int) - rgb[8:-8, 8:-8]).mean() < 3


def test_confidence_is_one_of_256_levels(rows: dict[str, list[dict[str, Any]]]) -> None:
    (buffer,) = value(rows["/confidence"][0], "buffer")
    level = round(255 * (1 - 1.05 ** (-1 / 0.1)))  # a Laplacian's share within 5 %, where 10 % are expected
    assert set(bytes(buffer)) == {level} and len(bytes(buffer)) == HEIGHT * WIDTH


def test_the_cloud_is_the_wall_before_the_camera(rows: dict[str, list[dict[str, Any]]]) -> None:
    for row, distance_m in zip(rows["/world/cloud"], (2, 3), strict=True):
        points_m = np.array(value(row, "positions"))
        assert np.allclose(points_m[:, 2], distance_m, atol=1e-5)
        u, v, _ = K @ points_m.T / points_m[:, 2]  # whole pixels, all that the colour reaches
        assert np.allclose([u, v], np.rint([u, v]), atol=1e-3)
        assert len(points_m) == len(value(row, "colors")) == (WIDTH - 2) * (HEIGHT - 1)


def test_without_a_camera_matrix_there_is_no_cloud_and_without_a_time_no_time(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed: pip install 'depthreg[view]'")
    with view.open_log(False, tmp_path / "a.rrd") as log:
        log.log("only", depthreg.Model(Wall())(*measure(2.0)))
    rows = read(tmp_path / "a.rrd")
    assert not any(entity.startswith("/world") for entity in rows)
    assert "time" not in rows["/depth/sparse"][0]


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed: pip install 'depthreg[view]'")
    with pytest.raises(RuntimeError, match="later"), view.open_log(False, tmp_path / "a.rrd") as log:
        log.log("first", depthreg.Model(Wall())(*measure(2.0)))
        raise RuntimeError("later")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("frames.png", "must end in .rrd"),
        ("there.rrd", "is there already: a new file was expected"),
        ("no/such/folder.rrd", "can't be written: a folder"),
    ],
)
def test_a_file_that_cant_be_made_is_refused_before_any_work(name: str, sentence: str, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed: pip install 'depthreg[view]'")
    (tmp_path / "there.rrd").write_text("mine")
    with pytest.raises(InputError, match=sentence):
        view.check(False, tmp_path / name)
    assert (tmp_path / "there.rrd").read_text() == "mine"


def test_without_rerun_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(view, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'depthreg\[view\]'"):
        view.check(True, None)
    view.check(False, None)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a screen")
def test_a_viewer_without_a_screen_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed: pip install 'depthreg[view]'")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="needs a screen"):
        view.check(True, None)


def test_the_command_saves_what_it_completes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun isn't installed: pip install 'depthreg[view]'")
    monkeypatch.setattr(complete, "load", lambda path, device: depthreg.Model(Wall()))
    rgb, depth_m = measure(2.0)
    cv2.imwrite(str(tmp_path / "rgb.png"), rgb[..., ::-1])
    np.save(tmp_path / "depth.npy", depth_m)
    np.savetxt(tmp_path / "K.txt", K)
    paths = [str(tmp_path / name) for name in ("rgb.png", "depth.npy")]
    options = {"depth-scale": 1, "intrinsics": tmp_path / "K.txt", "out": tmp_path / "out", "rrd": tmp_path / "a.rrd"}
    words = [str(word) for name, given in options.items() for word in (f"--{name}", given)]
    assert main(["complete", *paths, *words, "--checkpoint", "last.ckpt", "--device", "cpu"]) == 0
    rows = read(tmp_path / "a.rrd")
    assert [bytes(value(row, "buffer")[0]) for row in rows["/depth/sparse"]] == [depth_m.tobytes()]
    assert len(rows["/world/cloud"]) == 1
