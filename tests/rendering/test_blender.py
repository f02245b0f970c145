"""The process that Blender runs in, played by a short script where Blender itself isn't needed."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from depthreg.errors import InputError
from depthreg.rendering import blender

PLAYER = """
import json, os, sys, time
for line in sys.stdin:
    job = json.loads(line)
    if job["task"] == "die":
        print("out of memory", file=sys.stderr)
        sys.exit(7)
    time.sleep(job.get("sleep_s", 0))
    print(json.dumps({"error": "no such scene"} if job["task"] == "fail" else {"pid": os.getpid()}), flush=True)
"""


@pytest.fixture
def python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A Python whose Blender is the player above."""
    script = tmp_path / "player.py"
    script.write_text(PLAYER)
    monkeypatch.setattr(blender, "_SCRIPT", script)
    monkeypatch.setattr(blender, "_running", {})
    yield Path(sys.executable)
    for process in blender._running.values():
        process.stop()


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")  # where nobody waits for it, an ended process is still listed, as a zombie
    return not (status.exists() and status.read_text().rsplit(")", 1)[1].split()[0] == "Z")


def test_one_process_does_many_jobs(python: Path) -> None:
    first, second = (blender.ask(python, {"task": "draw"}, 60)["pid"] for _ in range(2))
    assert first == second != os.getpid()


def test_a_failed_job_is_told_and_the_next_one_is_done(python: Path) -> None:
    with pytest.raises(RuntimeError, match="no such scene"):
        blender.ask(python, {"task": "fail"}, 60)
    assert "pid" in blender.ask(python, {"task": "draw"}, 60)


def test_a_process_that_died_is_told_with_its_last_words_and_replaced(python: Path) -> None:
    with pytest.raises(RuntimeError, match="status 7: out of memory"):
        blender.ask(python, {"task": "die"}, 60)
    assert "pid" in blender.ask(python, {"task": "draw"}, 60)


def test_a_job_that_takes_too_long_is_stopped(python: Path) -> None:
    pid = blender.ask(python, {"task": "draw"}, 60)["pid"]
    with pytest.raises(RuntimeError, match=r"longer than 0\.2 s"):
        blender.ask(python, {"task": "draw", "sleep_s": 600}, 0.2)
    assert not _is_running(pid)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_child_starts_its_own_and_leaves_its_parents_alone(python: Path) -> None:
    pid = blender.ask(python, {"task": "draw"}, 60)["pid"]
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        own = blender.ask(python, {"task": "draw"}, 60)["pid"]
        os.write(writer, str(own).encode())
        os._exit(0)
    os.waitpid(child, 0)
    assert int(os.read(reader, 20)) != pid
    assert blender.ask(python, {"task": "draw"}, 60)["pid"] == pid


def test_a_python_that_is_not_there_is_one_sentence_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(blender.VARIABLE, str(tmp_path / "python"))
    with pytest.raises(InputError, match="make blender") as error:
        blender.find_python()
    assert str(tmp_path) in str(error.value)


def test_the_environment_of_the_working_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(blender.VARIABLE, raising=False)
    monkeypatch.chdir(tmp_path)
    expected = tmp_path / blender._ENVIRONMENT
    expected.parent.mkdir(parents=True)
    expected.touch()
    assert blender.find_python() == expected


def test_a_python_without_bpy_is_one_sentence() -> None:
    with pytest.raises(InputError, match="has no bpy: run `make blender`"):
        blender.ask(Path(sys.executable), {"task": "render"}, 60)


IDLE_BLENDER = """
import sys, time
from pathlib import Path
from depthreg.rendering.blender import BlenderProcess
process = BlenderProcess(Path(sys.argv[1]))
try:
    process.ask({"task": "render", "scene": "none.npz"}, 60)
except RuntimeError:
    print(process.process.pid, flush=True)
time.sleep(600)
"""


def test_blender_ends_when_its_parent_is_killed(blender_python: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", IDLE_BLENDER, blender_python], stdout=subprocess.PIPE) as parent:
        assert parent.stdout
        pid = int(parent.stdout.readline())
        assert _is_running(pid)
        parent.kill()
    deadline = time.monotonic() + 30
    while _is_running(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _is_running(pid)
