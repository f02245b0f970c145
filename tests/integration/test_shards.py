"""The same command over a real Ray and a real Slurm: the union of the shards is what one process writes."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

SMALL = [
    *("world=driving", "camera=random", "camera.width=96", "camera.height=64", "camera.focal_px=[60,120]"),
    *("offset=car", "count=6", "workers=1", "depth_scale=256"),
]
SHARDS = ["shard=0,1,2", "shards=3"]
Launch = Callable[..., subprocess.CompletedProcess[str]]


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
    launcher: str, tmp_path: Path, launch: Launch, request: pytest.FixtureRequest
) -> None:
    finished = launch(launcher, tmp_path, "render", *SHARDS, *SMALL, "out=frames")
    assert finished.returncode == 0, finished.stderr
    assert _files(tmp_path / "frames") == request.getfixturevalue("whole")


@pytest.mark.parametrize("launcher", ["ray", "submitit_slurm"])
def test_a_shard_that_fails_on_a_cluster_is_named_and_the_others_are_done(
    launcher: str, tmp_path: Path, launch: Launch
) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / ".000002.partial").touch()  # where frame 2, of the second shard, wants its folder
    finished = launch(launcher, tmp_path, "render", *SHARDS, *SMALL, "out=frames")
    assert finished.returncode == 2
    sentence = f"job 1 (shard=1): shard 1 of 3: {tmp_path / 'frames'} can't"
    assert f"depthreg render: 1 of 3 jobs failed:\n  {sentence}" in finished.stderr
    done = {path.name for path in (tmp_path / "frames").glob("0*")}
    assert done == {"000000", "000001", "000004", "000005"}
    (tmp_path / "frames" / ".000002.partial").unlink()
    subprocess.run([sys.executable, "-m", "depthreg", "render", *SMALL, "out=frames"], check=True, cwd=tmp_path)
    assert (tmp_path / "frames" / "manifest.sha256").exists()
