"""Training in two processes that a real Slurm starts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

TINY = [
    *("data.width=80", "data.height=64", "data.train_count=4", "data.val_count=3", "data.batch_size=2"),
    *("data.workers=0", "data.cache_dir=null", "model.completion_widths=[16,16]", "logger=csv", "curriculum=[joint]"),
    *("epochs.joint=2", "trainer.accelerator=cpu", "trainer.devices=2", "hydra.run.dir=runs/here"),
]


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="two tasks need two cores")
def test_srun_trains_as_torchrun_does(slurm: list[str], tmp_path: Path) -> None:
    python = [sys.executable, "-m"]
    launchers = {
        "srun": [*slurm, "srun", "--nodes=1", "--ntasks-per-node=2", *python],
        "torchrun": [*python, "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m"],
    }
    weights = []
    for name, launcher in launchers.items():
        folder = tmp_path / name
        folder.mkdir()
        command = [*launcher, "depthreg", "train", *TINY]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        finished = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        assert finished.returncode == 0, finished.stderr
        assert finished.stdout.count("frames never trained on") == 1
        weights.append(torch.load(folder / "runs/here/joint/last.ckpt", weights_only=True)["state_dict"])
    ours, theirs = weights
    assert [key for key in theirs if not torch.equal(ours[key], theirs[key])] == []
