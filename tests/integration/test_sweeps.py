"""Sweeps of `depthreg train` over a real Ray and a real Slurm: jobs train, and one that fails is named."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

TINY = [
    *("data.width=80", "data.height=64", "data.train_count=4", "data.val_count=2", "data.batch_size=2"),
    *("data.workers=0", "data.cache_dir=null", "model.completion_widths=[16,16]", "trainer.accelerator=cpu"),
    *("logger=csv", "curriculum=[joint]", "epochs.joint=1", "callbacks.panels=null", "hydra.sweep.dir=sweep"),
]
RESOURCES = {
    "ray": ["+hydra.launcher.ray.init.num_cpus=2"],
    "submitit_slurm": ["hydra.launcher.cpus_per_task=1", "+hydra.launcher.mem_gb=null"],
}
Launch = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.parametrize("launcher", ["ray", "submitit_slurm"])
def test_jobs_train_on_a_cluster_and_the_one_that_fails_is_named(launcher: str, tmp_path: Path, launch: Launch) -> None:
    (tmp_path / "sweep" / "1").mkdir(parents=True)
    (tmp_path / "sweep" / "1" / "joint").touch()  # where the second job wants a folder
    finished = launch(launcher, tmp_path, "train", *TINY, *RESOURCES[launcher], "seed=0,1,2")
    assert finished.returncode in (1, 2), finished.stderr
    assert "depthreg train: 1 of 3 jobs failed:\n  job 1 (seed=1): " in finished.stderr
    results = [line for line in finished.stdout.splitlines() if line.startswith("job ")]
    assert [line.split()[:2] for line in results] == [["job", "0"], ["job", "2"]]
    for number in (0, 2):
        run = tmp_path / "sweep" / str(number)
        assert yaml.safe_load((run / "run.yaml").read_text())["config"]["seed"] == number
        assert (run / "joint" / "last.ckpt").is_file() and (run / "metrics.md").is_file()
