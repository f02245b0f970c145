"""Reading the network out of a stage's checkpoint."""

import pickle
from pathlib import Path
from typing import Any

import torch

from depthreg.errors import InputError
from depthreg.networks import JointNetwork

_PREFIX = "network."  # of the network's weights in a stage's state


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
    if not isinstance(checkpoint, dict) or "network" not in checkpoint.get("depthreg", {}):
        raise InputError(f"{path} is a checkpoint of another program: expected one that `depthreg train` wrote")
    return checkpoint


def find_checkpoint(path: Path | None, runs: Path = Path("runs")) -> Path:
    """`path`, or where that is None the newest `last.ckpt` of the runs in the current folder.

    Raises:
        InputError: There is none.
    """
    if path is not None:
        return path
    trained = sorted(runs.glob("*/*/last.ckpt"), key=lambda file: file.stat().st_mtime)
    if not trained:
        raise InputError(f"no checkpoint in {runs}/*/*/last.ckpt: run `depthreg train` here first, or name one")
    return trained[-1]


def _weights(checkpoint: dict[str, Any]) -> dict[str, torch.Tensor]:
    state = checkpoint["state_dict"]
    return {key.removeprefix(_PREFIX): value for key, value in state.items() if key.startswith(_PREFIX)}


def load_network(path: Path) -> JointNetwork:
    """The network of any stage's checkpoint, on the CPU and in evaluation mode.

    Raises:
        InputError: See `read_checkpoint`.
    """
    checkpoint = read_checkpoint(path)
    try:
        network = JointNetwork(**checkpoint["depthreg"]["network"])
        network.load_state_dict(_weights(checkpoint))
    except (TypeError, RuntimeError, KeyError) as error:
        raise InputError(f"{path} holds a network that this version of depthreg does not know") from error
    return network.eval()


def steps_done(path: Path) -> int:
    """Steps of the stage that a checkpoint is from, 0 where there is none yet.

    Raises:
        InputError: See `read_checkpoint`.
    """
    return read_checkpoint(path)["global_step"] if path.exists() else 0


def load_weights(network: JointNetwork, path: Path) -> None:
    """Copy a checkpoint's weights into a network of the same configuration.

    Raises:
        InputError: The checkpoint is of another model, or see `read_checkpoint`.
    """
    checkpoint = read_checkpoint(path)
    theirs = checkpoint["depthreg"]["network"]
    different = sorted(
        key for key in network.config.keys() | theirs.keys() if network.config.get(key) != theirs.get(key)
    )
    if different:
        key = different[0]
        raise InputError(
            f"{path} is a checkpoint of another model: expected {key}={network.config.get(key)}, "
            f"it has {key}={theirs.get(key)}"
        )
    network.load_state_dict(_weights(checkpoint))
