"""What a run's folder says about the run: `run.yaml`, from which it can be repeated, resumed and compared."""

import os
import platform
import subprocess
import uuid
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from depthreg import __version__
from depthreg.data import io
from depthreg.errors import InputError

RECORD = "run.yaml"
FINISHED = "finished.yaml"  # in a stage's folder, when it needs no more training
_PACKAGES = ("torch", "lightning", "hydra-core", "kornia", "torchmetrics", "numpy", "opencv-python-headless", "embreex")


def git_state(folder: Path) -> dict[str, Any] | None:
    """Revision of the checkout that holds `folder`, and whether anything in it was changed; None outside of one."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(folder), *arguments], check=True, capture_output=True, text=True)
        return done.stdout.strip()

    try:
        return {"revision": git("rev-parse", "HEAD"), "dirty": bool(git("status", "--porcelain"))}
    except (OSError, subprocess.CalledProcessError):
        return None


def hardware() -> dict[str, Any]:
    """Processor, cores that this process may use, and GPUs."""
    import torch  # takes seconds, and who only reads records needs none of it

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return {"cpu": _processor(), "cores": cores, "gpus": gpus}


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def start_record(config: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """What `run.yaml` holds: how the run was asked for, and what it runs on."""
    versions = {"python": platform.python_version(), "depthreg": __version__}
    return {
        "id": uuid.uuid4().hex[:8],  # of the run in every tracker
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "overrides": list(overrides),
        "git": git_state(Path(__file__).parent),
        "versions": versions | {name: version(name) for name in _PACKAGES},
        "hardware": hardware(),
        "config": OmegaConf.to_container(config, resolve=True),
    }


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Write `run.yaml` into an existing folder, whole or not at all."""
    _write_yaml(folder / RECORD, record)


def read_record(folder: Path) -> dict[str, Any]:
    """Read `run.yaml`.

    Raises:
        InputError: There is none, or it isn't one that `depthreg train` wrote.
    """
    path = folder / RECORD
    try:
        record = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{folder} holds no {RECORD}: expected the folder of a run of `depthreg train`") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path} can't be read: {' '.join(str(error).split())}") from error
    if not isinstance(record, dict) or not {"id", "overrides", "config"} <= record.keys():
        raise InputError(f"{path} isn't what `depthreg train` wrote: expected id, overrides and config in it")
    return record


def finish_stage(folder: Path, epochs: int, steps: int) -> None:
    """Note that a stage needs no more training, and how much it had."""
    _write_yaml(folder / FINISHED, {"epochs": epochs, "steps": steps})


def is_finished(folder: Path) -> bool:
    """Whether a stage of this folder has ended."""
    return (folder / FINISHED).is_file()


def _write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    with io.atomic_write(path) as partial:
        partial.write_text(yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True), encoding="utf-8")
