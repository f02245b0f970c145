"""The same command over a real Ray and a real Slurm: the union of the shards is what one process writes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SMALL = [
    *("world=driving", "camera=random", "camera.width=96", "camera.height=64", "camera.focal_px=[60,120]"),
    *("offset=car", "count=6", "workers=1", "depth_scale=256"),
]
SHARDS = ["shard=0,1,2", "shards=3"]


def _launch(
    launcher: str, folder: Path, request: pytest.FixtureRequest, *overrides: str
) -> subprocess.CompletedProcess[str]:
    """Run `depthreg render` as shards on a cluster of this machine; the data set is `folder / "frames"`."""
    plugin = {"ray": "hydra_ray_launcher", "submitit_slurm": "hydra_submitit_launcher"}[launcher]
    pytest.importorskip(f"hydra_plugins.{plugin}", reason=f"{plugin} isn't installed: pip install 'depthreg[cluster]'")
    before = request.getfixturevalue("slurm") if launcher == "submitit_slurm" else []
    command = [sys.executable, "-m", "depthreg", "render", "-m", f"hydra/launcher={launcher}", *SHARDS, *SMALL]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    return subprocess.run(
        [*before, *command, "out=frames", *overrides], cwd=folder, env=environment, capture_output=True, text=True
    )


def _files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Every file of the data set as one process writes it."""
    folder = tmp_path_factory.mktemp("whole")
    command = [sys.executable, "-m", "depthreg", "render", *SMALL, f"out={folder}"]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    return _files(folder)


@pytest.mark.parametrize("launcher", ["ray", "submitit_slurm"])
def test_the_union_of_shards_is_what_one_process_writes(
    launcher: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    finished = _launch(launcher, tmp_path, request)
    assert finished.returncode == 0, finished.stderr
    assert _files(tmp_path / "frames") == request.getfixturevalue("whole")


@pytest.mark.parametrize("launcher", ["ray", "submitit_slurm"])
def test_a_shard_that_fails_on_a_cluster_is_named_and_the_others_are_done(
    launcher: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / ".000002.partial").touch()  # where frame 2, of the second shard, wants its folder
    finished = _launch(launcher, tmp_path, request)
    assert finished.returncode == 2
    assert finished.stderr.splitlines()[-1].startswith(f"depthreg render: shard 1 of 3: {tmp_path / 'frames'} can't")
    done = {path.name for path in (tmp_path / "frames").glob("0*")}
    assert done == {"000000", "000001", "000004", "000005"}
    (tmp_path / "frames" / ".000002.partial").unlink()
    subprocess.run([sys.executable, "-m", "depthreg", "render", *SMALL, "out=frames"], check=True, cwd=tmp_path)
    assert (tmp_path / "frames" / "manifest.sha256").exists()
