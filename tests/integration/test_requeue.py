"""A real Slurm takes a training job off its node and starts it again: it ends as if nothing had happened."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

TRAIN = [
    *(sys.executable, "-m", "depthreg", "train", "curriculum=[joint]", "epochs.joint=12", "logger=csv"),
    *("data.width=80", "data.height=64", "data.train_count=6", "data.val_count=2", "data.batch_size=2"),
    *("data.workers=1", "model.completion_widths=[16,16]", "trainer.accelerator=cpu", "callbacks.panels=null"),
]
JOB = """#!/bin/bash
#SBATCH --requeue --output=said.txt --open-mode=append
exec {command} hydra.run.dir=run
"""
WATCH = """
set -e
job=$(sbatch --parsable job.sh)
until [ -f run/joint/last.ckpt ]; do sleep 0.2; done
{interrupt}
until [ "$(squeue --noheader --job=$job --format=%t)" = PD ]; do sleep 0.2; done
scontrol update jobid=$job StartTime=now
until [ -f run/metrics.csv ]; do squeue --noheader --job=$job --format=%t | grep -q . || exit 1; sleep 0.5; done
"""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    subprocess.run([*TRAIN, "hydra.run.dir=run"], check=True, cwd=folder, capture_output=True)
    return folder / "run"


@pytest.mark.parametrize(
    "interrupt",
    [
        pytest.param("scancel --signal=USR1 --batch $job", id="warned"),  # as sbatch --signal=B:USR1@... does
        pytest.param("scontrol requeue $job", id="preempted"),  # SIGTERM, as from PreemptMode=REQUEUE
    ],
)
def test_a_job_that_is_queued_again_goes_on(
    interrupt: str, slurm: list[str], undisturbed: Path, tmp_path: Path
) -> None:
    (tmp_path / "job.sh").write_text(JOB.format(command=" ".join(TRAIN)))
    (tmp_path / "watch.sh").write_text(WATCH.format(interrupt=interrupt))
    done = subprocess.run([*slurm, "bash", "watch.sh"], cwd=tmp_path, capture_output=True, text=True)
    said = (tmp_path / "said.txt").read_text()
    assert done.returncode == 0, done.stderr + said
    assert "saved" in said
    ours, theirs = (
        torch.load(run / "joint" / "last.ckpt", weights_only=True)["state_dict"]
        for run in (tmp_path / "run", undisturbed)
    )
    assert [key for key in theirs if not torch.equal(ours[key], theirs[key])] == []
