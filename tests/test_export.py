"""Exported files run in other runtimes, whose depths are compared with those of PyTorch in eager mode."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from depthreg import Model, cli
from depthreg import export as command
from depthreg.checkpoint import write_published
from depthreg.data.io import read_depth_m, read_rgb
from depthreg.export import Size, export, made_frame, open_exported
from depthreg.frame_network import INPUTS, OUTPUTS, FrameNetwork, RowwiseGroupNorm
from depthreg.networks import HalfResolutionNetwork, JointNetwork

MILLIMETRE = 1e-3


def half_resolution() -> HalfResolutionNetwork:
    """The smallest network of the released architecture that has every part, with weights that do something."""
    torch.manual_seed(0)
    network = HalfResolutionNetwork((16, 16), (1,), (8, 8), 8, ((4, 1, 5),))
    for parameter in network.parameters():  # untrained, completion is the mean of the fillings
        nn.init.normal_(parameter, std=0.2)
    return network.eval()


def joint() -> JointNetwork:
    """Likewise of the paper's architecture."""
    torch.manual_seed(0)
    return JointNetwork(8, (16,), (8, 8), 8, ((4, 1, 5),)).eval()


def _differ_m(network: nn.Module, exported: command.Exported, *sizes: Size) -> float:
    """By how much depths differ at most, on frames of these sizes."""
    return max(command.difference_m(FrameNetwork(network), exported, size) for size in sizes)


@pytest.mark.parametrize("make", [half_resolution, joint])
@pytest.mark.parametrize("kind", ["onnx", "torchscript"])
def test_a_file_for_any_size_gives_the_depths_of_eager_mode_at_every_size(kind: str, make, tmp_path: Path) -> None:
    if kind == "onnx":
        pytest.importorskip("onnxruntime", reason="pip install 'depthreg[export]'")
    network, path = make(), tmp_path / f"network{command.SUFFIXES[kind]}"
    export(network, path, kind, "fp32", None, {})
    assert _differ_m(network, open_exported(path, kind), Size(64, 64), Size(75, 101), Size(130, 67)) < MILLIMETRE


@pytest.mark.parametrize("kind", command.SUFFIXES)
def test_a_file_for_one_size_gives_the_depths_of_eager_mode(kind: str, tmp_path: Path) -> None:
    if kind == "onnx":
        pytest.importorskip("onnxruntime", reason="pip install 'depthreg[export]'")
    network, path, size = joint(), tmp_path / f"network{command.SUFFIXES[kind]}", Size(65, 83)
    export(network, path, kind, "fp32", size, {})
    assert _differ_m(network, open_exported(path, kind), size) < MILLIMETRE


def test_rows_that_are_added_first_normalise_as_groups_do() -> None:
    generator = torch.Generator().manual_seed(0)
    norm, x = nn.GroupNorm(3, 6), 5 + torch.randn(2, 6, 7, 9, generator=generator)
    for parameter in norm.parameters():
        nn.init.normal_(parameter, generator=generator)
    torch.testing.assert_close(RowwiseGroupNorm(norm)(x), norm(x))


def test_inside_is_what_comes_before_and_after_the_network(make_network) -> None:
    """As `depthreg.load()` has it; what no return can be counts as none."""
    network = make_network().eval()
    rgb, depth_m = made_frame(Size(70, 90))
    result = Model(network)(rgb.numpy(), depth_m.numpy())
    depth_m[depth_m == 0] = torch.tensor([torch.nan, torch.inf, -1.0])[torch.arange(int((depth_m == 0).sum())) % 3]
    outputs = dict(zip(OUTPUTS, FrameNetwork(network)(rgb, depth_m), strict=True))
    for name, value in outputs.items():
        np.testing.assert_array_equal(value.detach().numpy(), getattr(result, name), err_msg=name)


@pytest.mark.parametrize("precision", ["fp16", "int8"])
def test_lower_precision_is_of_the_convolutions_alone(precision: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'depthreg[export]'")
    import onnx

    network, path, size = half_resolution(), tmp_path / "network.onnx", Size(70, 90)
    export(network, path, "onnx", precision, size, {})
    model = onnx.load(path)
    kinds = {node.op_type for node in model.graph.node}
    halves = {value.name for value in model.graph.initializer if value.data_type == onnx.TensorProto.FLOAT16}
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    if precision == "fp16":
        assert convolutions and all(set(node.input[1:]) <= halves for node in convolutions)
    else:
        assert "ConvInteger" in kinds and not convolutions
    exported, frame = open_exported(path, "onnx"), made_frame(size, seed=1)
    with torch.no_grad():
        whole_m = FrameNetwork(network)(*frame)[0].numpy()
    relative = np.abs(exported(*frame)["depth_m"] / whole_m - 1)
    assert 0 < relative.mean() < 0.05


def _run(folder: Path, *argv: str) -> int:
    write_published(folder / "weights.safetensors", half_resolution(), {})
    return cli.main(["export", str(folder / "weights.safetensors"), *argv])


def test_the_command_writes_a_file_that_says_what_goes_in_and_comes_out(tmp_path: Path, capsys) -> None:
    onnxruntime = pytest.importorskip("onnxruntime", reason="pip install 'depthreg[export]'")
    path = tmp_path / "network.onnx"
    assert _run(tmp_path, str(path), "--size", "80x64") == 0
    assert "80x64" in capsys.readouterr().out
    session = onnxruntime.InferenceSession(path)
    told = json.loads(session.get_modelmeta().custom_metadata_map["depthreg"])
    assert (told["network"], told["size"], told["precision"]) == ("HalfResolutionNetwork", "80x64", "fp32")
    assert told["inputs"] == INPUTS and told["outputs"] == OUTPUTS
    inputs = {value.name: (value.type, value.shape) for value in session.get_inputs()}
    assert inputs == {"rgb": ("tensor(uint8)", [64, 80, 3]), "sparse_depth_m": ("tensor(float)", [64, 80])}
    assert [value.name for value in session.get_outputs()] == list(OUTPUTS)
    assert sorted(child.name for child in tmp_path.iterdir()) == ["network.onnx", "weights.safetensors"]


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        (["there.onnx"], "there.onnx"),
        (["network.bin"], ".onnx, .pt, .pt2"),
        (["network.pt", "--format", "onnx"], ".onnx"),
        (["network.onnx", "--format", "tensorrt"], "tensorrt"),
        (["missing/network.onnx"], "missing"),
        (["network.onnx", "--size", "80"], "WIDTHxHEIGHT"),
        (["network.onnx", "--size", "40x80"], "64 to 4096"),
        (["network.onnx", "--precision", "fp8"], "fp8"),
        (["network.pt", "--precision", "int8"], "onnx"),
        (["network.pt2"], "--size"),
    ],
)
def test_what_cannot_be_written_is_refused_in_one_sentence(
    argv: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.onnx").write_text("mine")
    assert _run(Path(), *argv) == 2
    said = capsys.readouterr().err
    assert told in said and len(said.splitlines()) == 1
    assert (tmp_path / "there.onnx").read_text() == "mine"
    assert sorted(child.name for child in tmp_path.iterdir()) == ["there.onnx", "weights.safetensors"]


def test_a_missing_package_is_named_with_how_to_install_it(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert _run(tmp_path, str(tmp_path / "network.onnx")) == 2
    assert "depthreg[export]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rgb", "depth", "scale"),
    [
        ("kitti_odom_04/cam2/image/0000000005.png", "kitti_odom_04/cam2/velodyne_raw/0000000005.png", 256),
        ("nyu/kitchenette/rgb.png", "nyu/kitchenette/sparse_depth.png", 1000),
    ],
)
def test_onnx_runtime_agrees_within_a_millimetre_on_real_frames(
    rgb: str, depth: str, scale: float, real_data: Path, tmp_path: Path
) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'depthreg[export]'")
    network, path = half_resolution(), tmp_path / "network.onnx"
    export(network, path, "onnx", "fp32", None, {})
    frame = torch.from_numpy(read_rgb(real_data / rgb)), torch.from_numpy(read_depth_m(real_data / depth, scale))
    with torch.no_grad():
        ours = dict(zip(OUTPUTS, FrameNetwork(network)(*frame), strict=True))
    theirs = open_exported(path, "onnx")(*frame)
    seen = ours["depth_m"].numpy() < 80  # beyond, KITTI's sensor sees nothing, and a rounding of the answer is as large
    assert np.abs(theirs["depth_m"] - ours["depth_m"].numpy())[seen].max() < MILLIMETRE
    np.testing.assert_allclose(theirs["affine_rgb_from_depth"], ours["affine_rgb_from_depth"].numpy(), atol=1e-3)
