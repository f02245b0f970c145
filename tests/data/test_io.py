"""Oracles: Pillow, tifffile, NumPy and plyfile read or write the other side; OpenEXR writes what we read."""

import json
import os
import threading
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from plyfile import PlyData

from depthreg.data import io
from depthreg.errors import InputError

SIZE = (37, 53)


@pytest.fixture
def depth_m() -> np.ndarray:
    """Metres on KITTI's grid of 1/256, with a third of the returns missing."""
    generator = np.random.default_rng(0)
    stored = generator.integers(1, 40_000, SIZE) * (generator.random(SIZE) > 1 / 3)
    return (stored / 256).astype(np.float32)


@pytest.fixture
def rgb() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (*SIZE, 3), dtype=np.uint8)


def test_png_colour_is_read_in_rgb_order(tmp_path, rgb):
    Image.fromarray(rgb).save(tmp_path / "a.png")
    np.testing.assert_array_equal(io.read_rgb(tmp_path / "a.png"), rgb)


def test_alpha_is_dropped(tmp_path, rgb):
    with_alpha = np.dstack([rgb, np.full(SIZE, 7, np.uint8)])
    Image.fromarray(with_alpha).save(tmp_path / "a.png")
    np.testing.assert_array_equal(io.read_rgb(tmp_path / "a.png"), rgb)


def test_16_bit_grey_is_expanded_to_8_bit_colour(tmp_path, rgb):
    Image.fromarray(rgb[..., 0].astype(np.uint16) * 257).save(tmp_path / "a.png")
    read = io.read_rgb(tmp_path / "a.png")
    assert read.dtype == np.uint8
    assert np.abs(read.astype(int) - rgb[..., :1]).max() <= 1


def test_jpeg_is_read_as_another_decoder_reads_it(tmp_path):
    ramp = np.dstack(np.broadcast_arrays(np.arange(53)[None] * 4, np.arange(37)[:, None] * 6, np.uint8(90)))
    Image.fromarray(ramp.astype(np.uint8)).save(tmp_path / "a.JPG", quality=95)
    expected = np.asarray(Image.open(tmp_path / "a.JPG")).astype(int)
    assert np.abs(io.read_rgb(tmp_path / "a.JPG") - expected).max() <= 2


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def _save_tiff(path: Path, stored: np.ndarray) -> None:
    tifffile.imwrite(path, stored)


def _save_png(path: Path, stored: np.ndarray) -> None:
    Image.fromarray(stored).save(path)


def _save_named_npz(path: Path, stored: np.ndarray) -> None:
    np.savez(path, confidence=np.ones(SIZE), depth=stored)


def _save_only_npz(path: Path, stored: np.ndarray) -> None:
    np.savez_compressed(path, whatever=stored)


def _save_exr(path: Path, stored: np.ndarray) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="EXR is written with OpenEXR, which isn't installed")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {"Z": np.ascontiguousarray(stored)}) as file:
        file.write(str(path))


@pytest.mark.parametrize(
    ("save", "name", "dtype", "scale"),
    [
        (_save_png, "a.png", np.uint16, 256),
        (_save_tiff, "a.tiff", np.uint16, 256),
        (_save_tiff, "a.tif", np.float32, 1),
        (_save_exr, "a.exr", np.float32, 1),
        (np.save, "a.npy", np.float64, 0.5),
        (np.save, "a.npy", np.int32, 256),
        (_save_named_npz, "a.npz", np.float32, 1),
        (_save_only_npz, "a.npz", np.uint16, 256),
    ],
)
def test_depth_of_every_kind_is_read_in_metres(tmp_path, depth_m, save, name, dtype, scale):
    save(tmp_path / name, (depth_m.astype(np.float64) * scale).astype(dtype))
    read = io.read_depth_m(tmp_path / name, scale)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, depth_m)


def test_nan_is_no_return(tmp_path, depth_m):
    np.save(tmp_path / "a.npy", np.where(depth_m > 0, depth_m, np.nan))
    np.testing.assert_array_equal(io.read_depth_m(tmp_path / "a.npy", 1), depth_m)


@pytest.mark.parametrize(
    ("stored", "complaint"),
    [
        (np.full(SIZE, 9, np.uint8), "uint8"),
        (np.full(SIZE, True), "bool"),
        (np.full((*SIZE, 3), 9.0), "shape"),
        (np.zeros(SIZE), "no valid return"),
        (np.full(SIZE, np.nan), "no valid return"),
        (np.where(np.eye(*SIZE), -1e-3, 1), "negative or infinite"),
        (np.where(np.eye(*SIZE), np.inf, 1), "negative or infinite"),
        (np.where(np.eye(*SIZE), 1e300, 1), "negative or infinite"),
        (np.array(["a"]), "shape"),
        (np.array([[{}]], dtype=object), "NPY"),
    ],
)
def test_unusable_depth_is_refused_by_name(tmp_path, stored, complaint):
    np.save(tmp_path / "a.npy", stored, allow_pickle=True)
    with pytest.raises(InputError, match=rf"a\.npy.*{complaint}"):
        io.read_depth_m(tmp_path / "a.npy", 1)


def test_8_bit_png_depth_is_refused(tmp_path):
    _save_png(tmp_path / "a.png", np.full(SIZE, 200, np.uint8))
    with pytest.raises(InputError, match=r"a\.png holds uint8 values: depth of 16 bits"):
        io.read_depth_m(tmp_path / "a.png", 256)


@pytest.mark.parametrize("suffix", [*io.DEPTH_SUFFIXES, ".bmp"])
@pytest.mark.parametrize("content", [None, b"", b"\x89PNG nothing of the kind"])
def test_missing_and_broken_depth_is_refused_by_name(tmp_path, capfd, suffix, content):
    path = tmp_path / f"sparse{suffix}"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"sparse\."):
        io.read_depth_m(path, 256)
    assert capfd.readouterr() == ("", "")  # no library adds a complaint of its own


def test_an_npz_of_several_unnamed_arrays_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.ones(SIZE), y=np.ones(SIZE))
    with pytest.raises(InputError, match=r"a\.npz must hold one array, or one named depth"):
        io.read_depth_m(tmp_path / "a.npz", 1)


def test_an_exr_of_several_channels_without_z_is_refused(tmp_path, depth_m):
    openexr = pytest.importorskip("OpenEXR", reason="EXR is written with OpenEXR, which isn't installed")
    with openexr.File({}, {name: depth_m.copy() for name in "RGB"}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=r"a\.exr must hold one channel, or one named Z"):
        io.read_depth_m(tmp_path / "a.exr", 1)


@pytest.mark.parametrize("scale", [0, -256, np.nan, np.inf])
def test_a_senseless_scale_is_refused(tmp_path, scale):
    np.save(tmp_path / "a.npy", np.ones(SIZE))
    with pytest.raises(InputError, match="depth scale must be a positive number"):
        io.read_depth_m(tmp_path / "a.npy", scale)


@pytest.mark.parametrize(
    "text",
    [
        "721.5 0 609.6\n0 720 172.9\n0 0 1\n",
        "721.5,0,609.6,0,720,172.9,0,0,1",
        "[[7215e-1, 0, 609.6], [0, 720, 172.9], [0, 0, 1]]",
    ],
)
def test_intrinsics_are_read_in_any_common_spelling(tmp_path, text):
    (tmp_path / "K.txt").write_text(text)
    expected = np.float32([[721.5, 0, 609.6], [0, 720, 172.9], [0, 0, 1]])
    np.testing.assert_array_equal(io.read_intrinsics(tmp_path / "K.txt"), expected)


@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "1 2 3",
        "fx 0 3 0 5 6 0 0 1",
        "7 0 3 0 -7 3 0 0 1",
        "7 0 3 0 nan 3 0 0 1",
        "7 0 3 0 7 3 0 0 2",
        "7 1 3 0 7 3 0 0 1",
        "7 0 3 0 7 3 0 0 1 0",
    ],
)
def test_anything_but_a_pinhole_camera_is_refused(tmp_path, text):
    if text is not None:
        (tmp_path / "K.txt").write_text(text)
    with pytest.raises(InputError, match=r"K\.txt"):
        io.read_intrinsics(tmp_path / "K.txt")


def test_binary_intrinsics_are_refused(tmp_path):
    (tmp_path / "K.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"K\.txt"):
        io.read_intrinsics(tmp_path / "K.txt")


@pytest.mark.parametrize("scale", [256.0, 1000.0])
def test_depth_png_rounds_to_half_a_step(tmp_path, scale):
    depth_m = np.random.default_rng(0).uniform(0, 65, SIZE).astype(np.float32)
    io.write_depth_png(tmp_path / "a.png", depth_m, scale)
    stored = np.asarray(Image.open(tmp_path / "a.png"))
    assert stored.dtype == np.uint16
    assert np.abs(stored / scale - depth_m).max() <= 0.5 / scale + 1e-9


def test_depth_png_saturates(tmp_path):
    io.write_depth_png(tmp_path / "a.png", np.full(SIZE, 300, np.float32), 256)
    assert (np.asarray(Image.open(tmp_path / "a.png")) == 65535).all()


def test_png_npy_and_json_are_read_back_by_others(tmp_path, rgb, depth_m):
    io.write_png(tmp_path / "a.png", rgb)
    io.write_npy(tmp_path / "a.npy", depth_m)
    io.write_json(tmp_path / "a.json", {"affine": [[1.5, 0.0]]})
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), rgb)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), depth_m)
    assert json.loads((tmp_path / "a.json").read_text()) == {"affine": [[1.5, 0.0]]}


@pytest.mark.parametrize("count", [0, 101])
def test_ply_is_read_back_by_plyfile(tmp_path, count):
    points_m = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    rgb = np.random.default_rng(1).integers(0, 256, (count, 3), dtype=np.uint8)
    io.write_ply(tmp_path / "a.ply", points_m, rgb)
    ply = PlyData.read(tmp_path / "a.ply")
    assert not ply.text and ply.byte_order == "<"
    vertex = ply["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[name] for name in ("x", "y", "z")], axis=1), points_m)
    np.testing.assert_array_equal(np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1), rgb)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    (tmp_path / "a.json").write_text("old")
    with pytest.raises(ValueError):
        io.write_json(tmp_path / "a.json", {"x": float("nan")})
    assert (tmp_path / "a.json").read_text() == "old"
    assert _names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("exists", [False, True])
def test_a_result_folder_appears_whole(tmp_path, exists):
    out = tmp_path / "deep" / "out" if not exists else tmp_path / "out"
    if exists:
        out.mkdir()
    with io.atomic_folder(out) as folder:
        (folder / "a").write_text("1")
        (folder / "sub").mkdir()
        assert not (out / "a").exists()
    assert _names(out) == ["a", "sub"]
    assert _names(out.parent) == ["out"]


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("reason", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_result_folder_does_not_appear(tmp_path, exists, reason):
    out = tmp_path / "out"
    if exists:
        out.mkdir()
    with pytest.raises(reason), io.atomic_folder(out) as folder:
        (folder / "a").write_text("1")
        raise reason
    assert _names(tmp_path) == (["out"] if exists else [])
    assert not exists or _names(out) == []


def test_a_folder_that_holds_something_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="isn't empty"):
        io.check_new_folder(tmp_path)


def test_a_result_folder_on_or_below_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("precious")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="is a file"):
            io.check_new_folder(out)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is write-protected for root")
def test_a_write_protected_place_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="write-protected"):
        io.check_new_folder(tmp_path / "out")


def test_writers_in_threads_do_not_meet(tmp_path):
    def write(number: int) -> None:
        io.write_json(tmp_path / "a.json", [number] * 999)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(json.loads((tmp_path / "a.json").read_text()))) == 1
    assert _names(tmp_path) == ["a.json"]


def test_real_kitti_depth_has_the_documented_share_of_returns(real_data):
    depth_m = io.read_depth_m(real_data / "kitti_dc_official/triple_5/sparse_depth.png", 256)
    assert depth_m.shape == (352, 1216)
    assert 0.035 < np.mean(depth_m > 0) < 0.045
    assert 2 < depth_m[depth_m > 0].min() < depth_m.max() < 90


def test_a_jpeg_that_was_cut_off_is_refused_and_a_whole_one_is_read(tmp_path):
    path = tmp_path / "photo.jpg"
    noise = np.random.default_rng(0).integers(0, 256, (37, 53, 3), np.uint8)
    Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    assert io.read_rgb(path).shape == (37, 53, 3)
    path.write_bytes(whole + b"what some cameras append")
    assert io.read_rgb(path).shape == (37, 53, 3)
    path.write_bytes(whole[: 2 * len(whole) // 3])
    with pytest.raises(InputError, match=r"photo\.jpg can't be decoded"):
        io.read_rgb(path)
