"""Reading checkpoints: ours come back whole, everything else is refused and runs no code."""

import pickle
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import torch

from depthreg.checkpoint import RELEASED, described, load_network, load_weights, read_checkpoint, read_published
from depthreg.errors import InputError
from depthreg.networks import HalfResolutionNetwork, JointNetwork


@pytest.fixture
def checkpoint(tmp_path: Path, make_network: Callable[..., Any]) -> Path:
    """What a stage writes, as far as the reader looks at it."""
    network = make_network()
    state = {f"network.{key}": value for key, value in network.state_dict().items()}
    path = tmp_path / "last.ckpt"
    torch.save(
        {
            "state_dict": {**state, "loss.other": torch.ones(1)},
            "depthreg": {**described(network), "stage": "full"},
            "epoch": 3,
            "global_step": 12,
        },
        path,
    )
    return path


def test_the_network_comes_back_whole_and_ready(checkpoint: Path, make_network: Callable[..., Any]) -> None:
    network, original = load_network(checkpoint), make_network()
    assert network.config == original.config and not network.training
    for key, value in original.state_dict().items():
        assert torch.equal(network.state_dict()[key], value)


def test_weights_go_into_a_network_of_the_same_kind(checkpoint: Path, make_network: Callable[..., Any]) -> None:
    network = make_network()
    for parameter in network.parameters():
        torch.nn.init.zeros_(parameter)
    said = load_weights(network, checkpoint)
    assert f"all {len(network.state_dict())} tensors" in said and "stage full, epoch 3, step 12" in said
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), make_network().parameters(), strict=True))


def test_weights_of_another_model_are_refused_by_naming_the_difference(checkpoint: Path) -> None:
    other = JointNetwork(
        first_channels=8,
        completion_widths=(32,),
        registration_widths=(8, 8),
        registration_hidden=8,
        matchers=((4, 2, 5),),
        residual=True,
    )
    before = [parameter.clone() for parameter in other.parameters()]
    with pytest.raises(InputError, match=r"last\.ckpt.*another model.*completion_widths=\[32\].*\[16\]"):
        load_weights(other, checkpoint)
    assert all(torch.equal(a, b) for a, b in zip(before, other.parameters(), strict=True))


def test_weights_of_another_architecture_are_refused_by_its_name(checkpoint: Path) -> None:
    other = HalfResolutionNetwork(completion_widths=(16,), matchers=())
    with pytest.raises(InputError, match=r"expected architecture=HalfResolutionNetwork.*architecture=JointNetwork"):
        load_weights(other, checkpoint)


class RunsCode:
    """Creates a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def write(kind: str, path: Path) -> None:
    contents: dict[str, Callable[[], object]] = {
        "text": lambda: path.write_text("not a checkpoint"),
        "empty": lambda: path.write_bytes(b""),
        "code": lambda: torch.save({"depthreg": RunsCode(path.with_name("ran")), "state_dict": {}}, path),
        "bare pickle with code": lambda: path.write_bytes(pickle.dumps(RunsCode(path.with_name("ran")))),
        "another program's": lambda: torch.save({"state_dict": {"weight": torch.ones(2)}}, path),
        "a tensor": lambda: torch.save(torch.ones(3), path),
        "no network": lambda: torch.save({"depthreg": {"stage": "full"}, "state_dict": {}}, path),
        "no weights": lambda: torch.save(
            {"depthreg": {"architecture": "JointNetwork", "network": {}}, "state_dict": {}}, path
        ),
        "future network": lambda: torch.save(
            {"depthreg": {"architecture": "JointNetwork", "network": {"depth": 9}}, "state_dict": {}}, path
        ),
        "folder": path.mkdir,
        "missing": lambda: None,
    }
    contents[kind]()


KINDS = ["text", "empty", "code", "bare pickle with code", "another program's", "a tensor", "no network"]
KINDS += ["no weights", "future network", "folder", "missing"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("purpose", ["a new network", "weights"])
def test_anything_else_is_refused_in_one_sentence_and_never_run(
    kind: str, purpose: str, tmp_path: Path, make_network: Callable[..., Any]
) -> None:
    path = tmp_path / "given.ckpt"
    write(kind, path)
    with pytest.raises(InputError, match=r"given\.ckpt") as refusal:
        if purpose == "weights":
            load_weights(make_network(), path)
        else:
            load_network(path)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "ran").exists()


def test_a_checkpoint_cut_short_is_refused(checkpoint: Path) -> None:
    checkpoint.write_bytes(checkpoint.read_bytes()[:-200])
    with pytest.raises(InputError, match=r"last\.ckpt is not a readable checkpoint"):
        read_checkpoint(checkpoint)


def test_the_released_weights_load_and_are_small() -> None:
    network = load_network(RELEASED)
    assert sum(parameter.numel() for parameter in network.parameters()) <= 5.2e6
    assert RELEASED.stat().st_size <= 12e6
    description, _ = read_published(RELEASED)
    assert {"git", "overrides", "versions", "stage", "step"} <= description["origin"].keys()


def test_the_model_card_is_of_the_released_weights() -> None:
    card = (RELEASED.parent / "README.md").read_text(encoding="utf-8")
    assert sha256(RELEASED.read_bytes()).hexdigest() in card
    assert read_published(RELEASED)[0]["origin"]["git"]["revision"] in card
