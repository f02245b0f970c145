"""Arrays in, arrays out: the same answer whatever the layout, checked against closed forms and the network itself."""

import doctest
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

import depthreg
from depthreg.checkpoint import write_published
from depthreg.geometry import warp_affine
from depthreg.networks import HalfResolutionNetwork, JointOutput

HEIGHT, WIDTH = 66, 90
K = np.array([[80.0, 0, 44], [0, 85, 31], [0, 0, 1]])
LOG_ERROR = 0.1  # expected, of log-depth


class Doubling(nn.Module):
    """Answers with a wall at twice the farthest return, and with a shift of (2, 1) pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))

    def forward(self, rgb: Tensor, depth_m: Tensor) -> JointOutput:
        batch = len(rgb)
        wall_m = torch.ones_like(depth_m) * 2 * depth_m.amax(dim=(1, 2, 3), keepdim=True)
        affine = torch.tensor([[[1.0, 0, 2], [0, 1, 1]]]).expand(batch, 2, 3)
        aligned = warp_affine(rgb, affine)[0]
        return JointOutput(wall_m, aligned, affine, [], torch.full((batch,), 0.75), torch.full_like(depth_m, LOG_ERROR))


@pytest.fixture
def model() -> depthreg.Model:
    return depthreg.Model(Doubling())


def _arrays(batch: int | None = None, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Colour (uint8) and sparse depth, of one frame or of several that differ."""
    rng = np.random.default_rng(seed)
    shape = (() if batch is None else (batch,)) + (HEIGHT, WIDTH)
    rgb = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    return rgb, np.where(rng.random(shape) < 0.1, rng.uniform(1, 9, shape), 0).astype(np.float32)


def test_numpy_gives_numpy_of_the_same_layout(model):
    rgb, depth_m = _arrays()
    result = model(rgb, depth_m)
    assert result.depth_m.shape == (HEIGHT, WIDTH) and result.depth_m.dtype == np.float32
    np.testing.assert_allclose(result.depth_m, 2 * depth_m.max(), rtol=1e-6)
    moved = cv2.warpAffine(rgb, np.float64([[1, 0, 2], [0, 1, 1]]), (WIDTH, HEIGHT), flags=cv2.WARP_INVERSE_MAP)
    assert result.rgb_aligned.dtype == np.uint8 and result.rgb_aligned.shape == rgb.shape
    assert np.abs(result.rgb_aligned.astype(int) - moved).max() <= 1
    np.testing.assert_array_equal(result.affine_rgb_from_depth, [[1, 0, 2], [0, 1, 1]])
    assert result.trust == 0.75


def test_confidence_is_the_laplacian_share_within_five_percent(model):
    errors = np.random.default_rng(0).laplace(0, LOG_ERROR, 100_000)  # its mean absolute value is its scale
    share = np.mean(np.exp(errors) < 1.05) - np.mean(np.exp(errors) < 1 / 1.05)
    np.testing.assert_allclose(model(*_arrays()).confidence, share, atol=0.01)


@pytest.mark.parametrize("channel", [False, True])
@pytest.mark.parametrize("batch", [None, 2])
def test_torch_says_what_numpy_says_in_its_own_layout(model, batch, channel):
    rgb, depth_m = _arrays(batch)
    colour = torch.from_numpy(rgb).movedim(-1, -3)
    sparse_m = torch.from_numpy(depth_m).unsqueeze(-3) if channel else torch.from_numpy(depth_m)
    ours, theirs = model(colour, sparse_m), model(rgb, depth_m)
    assert ours.rgb_aligned.shape == colour.shape and ours.rgb_aligned.dtype == torch.uint8
    assert ours.depth_m.shape == ours.confidence.shape == sparse_m.shape
    np.testing.assert_array_equal(ours.depth_m.numpy().reshape(theirs.depth_m.shape), theirs.depth_m)
    np.testing.assert_array_equal(ours.rgb_aligned.movedim(-3, -1).numpy(), theirs.rgb_aligned)


def test_float_colour_stays_float(model):
    rgb, depth_m = _arrays()
    result = model(rgb / np.float32(255), depth_m)
    assert result.rgb_aligned.dtype == np.float32
    assert np.abs(255 * result.rgb_aligned - model(rgb, depth_m).rgb_aligned).max() <= 0.51


def test_frames_of_a_batch_are_as_they_are_alone(model, tmp_path):
    rgb, depth_m = _arrays(3)
    batch = model(rgb, depth_m, K)
    assert len(batch) == len(list(batch)) == 3
    for frame, one_rgb, one_m in zip(batch, rgb, depth_m, strict=True):
        alone = model(one_rgb, one_m, K)
        np.testing.assert_array_equal(frame.depth_m, alone.depth_m)
        np.testing.assert_array_equal(frame.point_cloud().points_m, alone.point_cloud().points_m)
    assert np.ptp([frame.depth_m.max() for frame in batch]) > 0
    np.testing.assert_array_equal(batch[-1].depth_m, batch[2].depth_m)
    with pytest.raises(IndexError):
        batch[3]
    with pytest.raises(ValueError, match="expected one of them"):
        batch.save(tmp_path)


def test_missing_depth_may_be_nan(model):
    rgb, depth_m = _arrays()
    holes = np.where(depth_m > 0, depth_m, np.nan)
    np.testing.assert_array_equal(model(rgb, holes).depth_m, model(rgb, depth_m).depth_m)


def test_what_is_given_stays_as_it_is(model):
    rgb, depth_m = _arrays()
    before = rgb.copy(), depth_m.copy()
    model(rgb, depth_m)
    np.testing.assert_array_equal(rgb, before[0])
    np.testing.assert_array_equal(depth_m, before[1])


def test_saving_writes_what_the_result_says(model, tmp_path):
    rgb, depth_m = _arrays()
    depth_m[0, 0] = depth_m[0, -1] = depth_m[-1, 0] = depth_m[-1, -1] = 20.0
    result = model(rgb, depth_m, K)
    result.save(tmp_path / "new/result")
    folder = tmp_path / "new/result"
    assert sorted(path.name for path in folder.iterdir()) == [
        "affine.json",
        "cloud.ply",
        "confidence.png",
        "depth.npy",
        "depth.png",
        "panel.png",
        "rgb_aligned.png",
    ]
    np.testing.assert_array_equal(np.load(folder / "depth.npy"), result.depth_m)
    assert cv2.imread(str(folder / "depth.png"), cv2.IMREAD_UNCHANGED)[5, 5] == 40_000
    told = json.loads((folder / "affine.json").read_text())
    assert told["affine_rgb_from_depth"] == [[1, 0, 2], [0, 1, 1]] and told["trust"] == 0.75
    np.testing.assert_array_equal(cv2.imread(str(folder / "panel.png"))[..., ::-1], np.asarray(result.figure()))


def test_little_confidence_leaves_points_out(model):
    rgb, depth_m = _arrays()
    depth_m[0, 0] = depth_m[-1, -1] = 2 * depth_m.max()  # so that the wall is within the returns' range
    result = model(rgb, depth_m / 2, K)
    everything = model(rgb, np.where(depth_m > 0, depth_m.max() / 2, 0).astype(np.float32), K)
    assert len(everything.point_cloud().points_m) == len(everything.point_cloud(0.3).points_m)
    assert len(result.point_cloud(0.5).points_m) == 0


def test_a_result_says_in_words_what_happened(model):
    assert "(+2.0, +1.0) px, +0.00 deg, +0.00 % (trust 0.75)" in repr(model(*_arrays()))
    assert "2 frames" in repr(model(*_arrays(2)))


rgb, depth_m = _arrays()
BAD = {
    "a list": (([[0]], depth_m), "NumPy array or a torch tensor"),
    "grey": ((rgb[..., 0], depth_m), r"\(H, W, 3\)"),
    "torch axes in NumPy": ((rgb.transpose(2, 0, 1), depth_m), r"\(H, W, 3\)"),
    "colour to 255": ((rgb.astype(np.float32), depth_m), r"float in \[0, 1\]"),
    "millimetres": ((rgb, (1000 * depth_m).astype(np.uint16)), "floating-point metres"),
    "other size": ((rgb[:-1], depth_m), "rgb is 90x65 but depth_m is 90x66"),
    "too small": ((rgb[:63], depth_m[:63]), "at least 64x64"),
    "no return": ((rgb, 0 * depth_m), "holds no return"),
    "negative": ((rgb, depth_m - 1), "negative or infinite"),
    "K of another kind": ((rgb, depth_m, np.eye(4)), r"K has the shape \(4, 4\)"),
    "K of a point": ((rgb, depth_m, np.zeros((3, 3))), "positive focal"),
}


@pytest.mark.parametrize("case", BAD)
def test_arrays_that_cannot_be_meant_are_refused(model, case):
    arguments, complaint = BAD[case]
    with pytest.raises(ValueError, match=complaint):
        model(*arguments)


def test_a_cloud_without_a_camera_is_refused(model):
    with pytest.raises(ValueError, match="camera matrix"):
        model(*_arrays()).point_cloud()


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a narrow network with random weights, as a file."""
    torch.manual_seed(0)
    network = HalfResolutionNetwork((16, 16, 16), (1,), (16, 16, 16), 16, [(8, 1, 3)])
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    write_published(path, network, {})
    return path


def test_loaded_weights_say_what_the_network_says(published):
    model = depthreg.load(published, device="cpu")
    rgb, depth_m = _arrays()
    with torch.inference_mode():
        output = model.network(
            torch.from_numpy(rgb).permute(2, 0, 1)[None] / 255, torch.from_numpy(depth_m)[None, None]
        )
    np.testing.assert_allclose(model(rgb, depth_m).depth_m, output.depth_m[0, 0].numpy(), rtol=1e-6)


def test_the_hub_gives_back_what_it_was_given(published, tmp_path):
    pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
    from depthreg.hub import HubModel

    model = HubModel(depthreg.load(published, device="cpu").network)
    model.save_pretrained(tmp_path / "repository")
    again = HubModel.from_pretrained(str(tmp_path / "repository"))
    np.testing.assert_array_equal(again(*_arrays()).depth_m, model(*_arrays()).depth_m)


def test_the_example_of_the_documentation_runs(published, monkeypatch):
    from depthreg import model as module

    monkeypatch.setattr(module, "RELEASED", published)
    failed, tried = doctest.testmod(module)
    assert tried > 5 and failed == 0


def test_importing_the_package_does_not_import_pytorch():
    code = "import depthreg, sys; print('torch' in sys.modules, sorted(set(depthreg.__all__) - set(dir(depthreg))))"
    printed = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert printed.split()[0] == "False"


def test_real_frames_run_and_their_pictures_are_made(real_data, published):
    frame = real_data / "kitti_dc_official/triple_5"
    rgb = cv2.cvtColor(cv2.imread(str(frame / "rgb.png")), cv2.COLOR_BGR2RGB)
    sparse_m = cv2.imread(str(frame / "sparse_depth.png"), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
    result = depthreg.load(published, device="cpu")(rgb, sparse_m)
    assert result.depth_m.shape == sparse_m.shape and result.depth_m.min() > 0
    assert result.figure().width > 1000


def test_a_result_knows_what_it_was_given_and_what_error_to_expect(model: depthreg.Model) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth_m = np.zeros((HEIGHT, WIDTH), np.float32)
    depth_m[5, 7] = 3
    result = model(rgb, depth_m, K)
    assert np.array_equal(result.rgb, rgb) and np.array_equal(result.sparse_depth_m, depth_m)
    assert result.K is not None and np.array_equal(result.K, K) and model(rgb, depth_m).K is None
    assert np.allclose(result.expected_error_m, LOG_ERROR * 6, rtol=1e-6)  # a wall at twice the depth
