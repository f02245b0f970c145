"""A stage's checkpoint: writing it whole or not at all, and reading the network out of it."""

import io
import json
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from depthreg.data.io import atomic_write
from depthreg.errors import InputError, RunError
from depthreg.networks import HalfResolutionNetwork, JointNetwork, Network

NETWORKS = {network.__name__: network for network in (JointNetwork, HalfResolutionNetwork)}
PUBLISHED_SUFFIX = ".safetensors"
RELEASED = Path(__file__).parent / "weights/release.safetensors"  # what commands use where no weights are named
_PREFIX = "network."  # of the network's weights in a stage's state


class AtomicCheckpointIO(TorchCheckpointIO):
    """Replaces a checkpoint at once: whatever ends the process, the old or the new one is there, and weights are sound.

    Lightning's own way writes into the system's folder for temporary files and copies from there.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint.

        Raises:
            RunError: A weight isn't finite.
            OSError: The file can't be written; an earlier one is as it was.
        """
        weights = [value for value in checkpoint["state_dict"].values() if value.is_floating_point()]
        if not all(value.isfinite().all() for value in weights):
            raise RunError(f"weights are not finite any more, so {path} stays as it was: try a lower learning_rate")
        buffer = io.BytesIO()  # a full disk is an OSError then, and not one of torch's own
        torch.save(checkpoint, buffer)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(Path(path)) as partial, partial.open("wb") as file:
            file.write(buffer.getbuffer())
            file.flush()
            os.fsync(file.fileno())


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A stage's checkpoint as plain containers and tensors; nothing in the file can run code.

    Raises:
        InputError: The file is missing, unreadable, or not a depthreg checkpoint.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist: expected a checkpoint that `depthreg train` wrote")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError, OSError) as error:
        raise InputError(f"{path} is not a readable checkpoint: expected one that `depthreg train` wrote") from error
    if not (isinstance(checkpoint, dict) and {"architecture", "network"} <= checkpoint.get("depthreg", {}).keys()):
        raise InputError(
            f"{path} is a checkpoint of another program or version: expected one that `depthreg train` wrote"
        )
    return checkpoint


def _weights(checkpoint: dict[str, Any]) -> dict[str, torch.Tensor]:
    state = checkpoint["state_dict"]
    return {key.removeprefix(_PREFIX): value for key, value in state.items() if key.startswith(_PREFIX)}


def described(network: Network) -> dict[str, Any]:
    """What it takes to build a network again, in plain containers."""
    return {"architecture": type(network).__name__, "network": network.config}


def load_network(path: Path) -> Network:
    """The network of any stage's checkpoint, or of published weights, on the CPU and in evaluation mode.

    Raises:
        InputError: See `read_checkpoint` and `read_published`.
    """
    if path.suffix == PUBLISHED_SUFFIX:
        description, weights = read_published(path)
    else:
        checkpoint = read_checkpoint(path)
        description, weights = checkpoint["depthreg"], _weights(checkpoint)
    try:
        network = NETWORKS[description["architecture"]](**description["network"])
        network.load_state_dict(weights)
    except (TypeError, RuntimeError, KeyError) as error:
        raise InputError(f"{path} holds a network that this version of depthreg does not know") from error
    return network.eval()


def write_published(path: Path, network: Network, origin: Mapping[str, Any]) -> None:
    """Write weights alone, in half precision and a format that can't run code (safetensors).

    Args:
        path: A `.safetensors` file.
        network: Whose weights.
        origin: Where they come from, in plain containers.
    """
    weights = {key: value.detach().cpu() for key, value in network.state_dict().items()}
    halves = {
        key: (value.half() if value.is_floating_point() else value).contiguous() for key, value in weights.items()
    }
    with atomic_write(path) as partial:
        save_file(halves, partial, {"depthreg": json.dumps({**described(network), "origin": dict(origin)})})


def read_published(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """What `write_published` wrote: architecture, configuration and origin, and the weights in single precision.

    Raises:
        InputError: The file is missing, unreadable, or not depthreg's.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist: expected weights that `depthreg publish` wrote")
    try:
        with safe_open(path, "pt") as file:
            description = json.loads(file.metadata()["depthreg"])
            weights = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118, it isn't a dictionary
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} holds no readable weights: expected what `depthreg publish` wrote") from error
    return description, {key: value.float() if value.is_floating_point() else value for key, value in weights.items()}


def steps_done(path: Path) -> int:
    """Steps of the stage that a checkpoint is from, 0 where there is none yet.

    Raises:
        InputError: See `read_checkpoint`.
    """
    return read_checkpoint(path)["global_step"] if path.exists() else 0


def load_weights(network: Network, path: Path) -> str:
    """Copy a checkpoint's weights into a network of the same configuration.

    Returns:
        What was loaded and what wasn't, in a sentence.

    Raises:
        InputError: The checkpoint is of another model, or see `read_checkpoint`.
    """
    checkpoint = read_checkpoint(path)
    ours, theirs = described(network), checkpoint["depthreg"]
    ours, theirs = ({"architecture": one["architecture"], **one["network"]} for one in (ours, theirs))
    different = [key for key in ours | theirs if ours.get(key) != theirs.get(key)]
    if different:
        key = min(different, key=lambda key: (key != "architecture", key))
        raise InputError(
            f"{path} is a checkpoint of another model: expected {key}={ours.get(key)}, it has {key}={theirs.get(key)}"
        )
    weights = _weights(checkpoint)
    network.load_state_dict(weights)
    origin = f"stage {checkpoint['depthreg']['stage']}, epoch {checkpoint['epoch']}, step {checkpoint['global_step']}"
    return (
        f"{path}: all {len(weights)} tensors of the network, of {origin}; "
        "the optimizer, the learning rate's schedule and the difficulty start anew"
    )
