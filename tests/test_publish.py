"""Published weights: read by safetensors itself, as good as the checkpoint within half precision, and honest."""

import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from depthreg.checkpoint import described, load_network
from depthreg.cli import main
from depthreg.run_folder import write_record

RECORD = {
    **{"id": "1234abcd", "started": "2026-01-02T03:04:05+00:00", "overrides": ["preset=release", "seed=7"]},
    **{"git": {"revision": "0" * 40, "dirty": False}, "versions": {"torch": "2.13.0"}, "hardware": {"cores": 2}},
    "config": {"seed": 7},
}


@pytest.fixture
def checkpoint(tmp_path: Path, make_network: Callable[..., Any]) -> Path:
    network = make_network()
    state = {f"network.{key}": value for key, value in network.state_dict().items()}
    described_stage = {**described(network), "stage": "full"}
    (tmp_path / "run" / "full").mkdir(parents=True)
    write_record(tmp_path / "run", RECORD)
    path = tmp_path / "run" / "full" / "last.ckpt"
    torch.save({"state_dict": state, "depthreg": described_stage, "epoch": 3, "global_step": 12}, path)
    return path


def test_weights_say_where_they_come_from_and_answer_as_the_checkpoint_does(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "weights.safetensors"
    assert main(["publish", str(checkpoint), str(out)]) == 0
    assert sha256(out.read_bytes()).hexdigest() in capsys.readouterr().out
    with safe_open(out, "pt") as file:
        said = json.loads(file.metadata()["depthreg"])
        assert {file.get_tensor(key).dtype for key in file.keys()} <= {torch.float16, torch.int64}  # noqa: SIM118
    assert said["origin"]["overrides"] == ["preset=release", "seed=7"] and said["origin"]["step"] == 12
    before, after = load_network(checkpoint), load_network(out)
    assert after.config == before.config and not after.training
    for key, value in before.state_dict().items():
        torch.testing.assert_close(after.state_dict()[key], value, rtol=2**-10, atol=2**-24)  # half precision
        assert after.state_dict()[key].dtype == value.dtype


@pytest.mark.parametrize(
    ("out", "said"),
    [("weights.bin", "ends in .safetensors"), ("there.safetensors", "expected a new file"), ("no/w.safetensors", "no")],
)
def test_weights_go_into_a_new_file_of_their_kind(
    out: str, said: str, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there.safetensors").write_text("mine")
    assert main(["publish", str(checkpoint), str(tmp_path / out)]) == 2
    assert said in capsys.readouterr().err
    assert (tmp_path / "there.safetensors").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"run", "there.safetensors"}


def test_a_checkpoint_without_its_run_is_not_published(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (checkpoint.parents[1] / "run.yaml").unlink()
    assert main(["publish", str(checkpoint), str(tmp_path / "w.safetensors")]) == 2
    assert "run.yaml" in capsys.readouterr().err and not (tmp_path / "w.safetensors").exists()


@pytest.mark.parametrize("kind", ["missing", "text", "another program's", "cut"])
def test_other_files_are_refused_in_one_sentence(
    kind: str, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "given.safetensors"
    if kind == "text":
        path.write_text("no weights at all")
    elif kind == "another program's":
        save_file({"weight": torch.ones(2)}, path)
    elif kind == "cut":
        assert main(["publish", str(checkpoint), str(path)]) == 0
        path.write_bytes(path.read_bytes()[:-100])
    capsys.readouterr()
    assert main(["evaluate", f"checkpoint={path}", "data.root=nowhere"]) == 2
    said = capsys.readouterr().err
    assert "given.safetensors" in said and said.count("\n") == 1
