import json
import sys
from pathlib import Path

import inference
import pytest
import torch
from speed import measure
from speed.methods import METHODS, Case, Runner
from speed.unets import RESNET18, RESNET34, ResNetUNet

from depthreg.checkpoint import load_network, write_published
from depthreg.export import Size


@pytest.fixture
def weights(tmp_path: Path, make_network) -> Path:
    path = tmp_path / "weights.safetensors"
    write_published(path, make_network(), {})
    return path


def test_the_unet_has_the_parameters_of_segmentation_models_pytorch() -> None:
    """Of smp.Unet("resnet18", classes=1) and smp.Unet("resnet34", classes=1)."""
    counts = [sum(p.numel() for p in ResNetUNet(3, blocks).parameters()) for blocks in (RESNET18, RESNET34)]
    assert counts == [14_328_209, 24_436_369]
    assert ResNetUNet(4)(torch.zeros(1, 4, 64, 96)).shape == (1, 1, 64, 96)


@pytest.mark.parametrize("method", [name for name in METHODS if name not in ("ours, compiled", "ours, ONNX Runtime")])
def test_every_method_does_a_frame(method: str, weights: Path) -> None:
    for precision in METHODS[method][1]:
        timing = measure.measure_here(Case(method, precision, Size(64, 70), 1, weights), runs=1, seconds=0)
        assert timing.reason == "" and timing.seconds > 0 and timing.runs == 1


def test_what_fails_says_why_and_the_rest_goes_on(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(case: Case) -> Runner:
        raise RuntimeError("no compiler\nsearched everywhere")

    monkeypatch.setitem(METHODS, "broken", (broken, ("fp32",)))
    timing = measure.measure_here(Case("broken", "fp32", Size(64, 64), 1, weights), runs=1, seconds=0)
    assert timing.reason == "RuntimeError: no compiler"


def test_the_command_measures_in_processes_of_their_own_and_sets_times_beside_ours(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    ballast = bytearray(b"x") * 600_000_000  # of this process; a row's memory must not have it
    path = tmp_path / "inference.json"
    options = ["--sizes", "70x64", "--threads", "1", "--methods", "ours, eager", "IP-Basic", "--runs", "1"]
    monkeypatch.setattr(sys, "argv", ["inference.py", *options, "--checkpoint", str(weights), "--json", str(path)])
    inference.main()
    rows = json.loads(path.read_text())["rows"]
    assert [(row["method"], row["precision"]) for row in rows] == [
        ("ours, eager", "fp32"),
        ("ours, eager", "bf16"),
        ("IP-Basic", "fp32"),
    ]
    assert rows[0]["ratio"] == 1 and rows[2]["ratio"] == pytest.approx(rows[2]["seconds"] / rows[0]["seconds"])
    assert rows[0]["frames_per_s"] == pytest.approx(1 / rows[0]["seconds"])
    assert rows[0]["parameters"] == pytest.approx(sum(p.numel() for p in load_network(weights).parameters()) / 1e6)
    if sys.platform == "linux":
        assert all(50 < row["ready_mb"] <= row["peak_mb"] + 50 for row in rows)
        assert max(row["peak_mb"] for row in rows) < measure._memory_mb("VmHWM")
    assert len(ballast) and "IP-Basic" in capsys.readouterr().out
