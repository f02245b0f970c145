"""What starts the processes of a run, and what isn't started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from depthreg.cli import main

TINY = [
    *("data.width=80", "data.height=64", "data.train_count=4", "data.val_count=3", "data.batch_size=2"),
    *("data.workers=0", "data.cache_dir=null", "model.completion_widths=[16,16]", "logger=csv"),
    *("epochs.joint=2", "epochs.completion=1", "trainer.accelerator=cpu"),
]
TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]


def train_on_two(folder: Path, launcher: list[str], *overrides: str) -> Path:
    """Run the command by a launcher, and give the run's folder."""
    command = [sys.executable, *launcher, "-m", "depthreg", "train", *TINY, "trainer.devices=2", *overrides]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    finished = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.count("frames never trained on") == 1  # one process evaluates and prints
    (run,) = (folder / "runs").iterdir()
    return run


def test_a_run_is_the_same_whether_lightning_or_torchrun_starts_its_processes(tmp_path: Path) -> None:
    """The first walks two stages in the same processes, and thaws in the second what rested in the first."""
    folders = [tmp_path / name for name in ("lightning", "torchrun")]
    for folder in folders:
        folder.mkdir()
    walk = train_on_two(folders[0], [], "curriculum=[joint,completion]")
    stage = train_on_two(folders[1], TORCHRUN, "curriculum=[joint]", "hydra.run.dir=runs/here")
    assert stage.name == "here"
    for run in (walk, stage):
        assert {"run.yaml", "metrics.csv", "metrics.md", "panels", "joint"} <= {path.name for path in run.iterdir()}
    ours, theirs, later = (
        torch.load(path, weights_only=True)["state_dict"]
        for path in (walk / "joint/last.ckpt", stage / "joint/last.ckpt", walk / "completion/last.ckpt")
    )
    assert [key for key in theirs if not torch.equal(ours[key], theirs[key])] == []
    changed = {key.split(".")[1] for key in theirs if not torch.equal(later[key], theirs[key])}
    assert changed == {"completion"}


BY_TORCHRUN = {"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "2"}
BY_SRUN = {"SLURM_NTASKS": "2", "SLURM_JOB_NAME": "python"}


@pytest.mark.parametrize(
    ("environment", "overrides", "said"),
    [
        (BY_TORCHRUN, ["trainer.devices=2"], "2 processes have to share a folder: expected hydra.run.dir="),
        (BY_SRUN, ["trainer.devices=2"], "2 processes have to share a folder: expected hydra.run.dir="),
        (BY_TORCHRUN, ["hydra.run.dir=runs/x"], "2 processes were started for trainer.devices=1"),
        (BY_SRUN, ["hydra.run.dir=runs/x", "trainer.devices=2"], "expected srun --ntasks-per-node"),
        ({}, ["trainer.devices=2", "trainer.strategy=fsdp"], "expected one of auto, ddp"),
        ({}, ["trainer.devices=3"], "4 training frames: expected at least one batch of 2 in each of 3 processes"),
        ({}, ["-m", "trainer.devices=2", "seed=1,2"], "trainer.devices=2 in a sweep would start the whole sweep again"),
    ],
)
def test_processes_that_cannot_train_together_are_refused(
    environment: dict[str, str],
    overrides: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    flags = [override for override in overrides if override == "-m"]
    assert main(["train", *flags, *TINY, *(override for override in overrides if override != "-m")]) != 0
    message = capsys.readouterr().err
    assert said in message
    if not flags:
        assert len(message.splitlines()) == 1 and list(tmp_path.iterdir()) == []
