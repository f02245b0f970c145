"""What the clusters of the tests need."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

PROGRAMS = ("slurmctld", "slurmd", "munged")  # Debian puts some of them where only root looks


@pytest.fixture(scope="session")
def slurm() -> list[str]:
    """What to put before a command that needs a Slurm: it gets one of its own."""
    path = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])
    missing = [name for name in PROGRAMS if not shutil.which(name, path=path)]
    if missing:
        pytest.skip(f"{', '.join(missing)} isn't installed: apt-get install slurm-wlm munge")
    return [str(Path(__file__).with_name("with_slurm.sh"))]


PLUGINS = {"ray": "hydra_ray_launcher", "submitit_slurm": "hydra_submitit_launcher"}


@pytest.fixture
def launch(request: pytest.FixtureRequest) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs `depthreg COMMAND -m OVERRIDES` in a folder, its jobs by one of Hydra's launchers for clusters."""

    def run(launcher: str, folder: Path, command: str, *overrides: str) -> subprocess.CompletedProcess[str]:
        reason = f"{PLUGINS[launcher]} isn't installed: pip install 'depthreg[cluster]'"
        pytest.importorskip(f"hydra_plugins.{PLUGINS[launcher]}", reason=reason)
        before = request.getfixturevalue("slurm") if launcher == "submitit_slurm" else []
        arguments = [sys.executable, "-m", "depthreg", command, "-m", f"hydra/launcher={launcher}", *overrides]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
        return subprocess.run([*before, *arguments], cwd=folder, env=environment, capture_output=True, text=True)

    return run
