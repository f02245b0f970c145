"""What the clusters of the tests need."""

import os
import shutil
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
