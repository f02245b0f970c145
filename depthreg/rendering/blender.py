"""Blender as a process of its own: its bpy needs Python 3.11 and NumPy 1.26, which our packages refuse."""

import atexit
import json
import os
import queue
import subprocess
import threading
from collections import deque
from pathlib import Path
from typing import IO, Any

from depthreg.errors import InputError

VARIABLE = "DEPTHREG_BLENDER_PYTHON"
_SCRIPT = Path(__file__).with_name("blender_process.py")
_ENVIRONMENT = Path(".venv-blender") / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
_CHECKOUT = Path(__file__).parents[2]
_PIPE = subprocess.PIPE
_LAST_LINES = 3  # of what Blender said before it died

_running: dict[Path, "BlenderProcess"] = {}  # by the Python that runs them


def find_python(python: str | None = None) -> Path:
    """The Python that has bpy.

    Args:
        python: Its path; where not given, the environment variable `DEPTHREG_BLENDER_PYTHON` names it, or it is the
            `.venv-blender` of the working folder or of the checkout.

    Raises:
        InputError: There is none.
    """
    named = python or os.environ.get(VARIABLE)
    places = [Path(named).expanduser()] if named else [Path.cwd() / _ENVIRONMENT, _CHECKOUT / _ENVIRONMENT]
    for place in places:
        if place.is_file():
            return place.absolute()  # a link has to stay one: it is how an environment knows itself
    raise InputError(f"Blender's Python is not at {places[0]}: run `make blender`, or name it by {VARIABLE}.")


def ask(python: Path, job: dict[str, Any], timeout_s: float) -> dict[str, Any]:
    """Have a job done by this process's Blender, which is started where none is running.

    Args:
        python: The Python that has bpy.
        job: See `blender_process.py`.
        timeout_s: How long to wait.

    Returns:
        The answer: `cpu_s`, the CPU time that the job took.

    Raises:
        InputError: The Python has no bpy.
        RuntimeError: Blender failed, died or took too long.
    """
    running = _running.get(python)
    if running is None or not running.alive:
        running = _running[python] = BlenderProcess(python)
    return running.ask(job, timeout_s)


def _forget_parents() -> None:
    """A forked child starts its own: two processes can't share one's answers."""
    for process in _running.values():
        process.abandon()
    _running.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_parents)


class BlenderProcess:
    """A running Blender; it ends with this process, even when that is killed.

    Args:
        python: The Python that has bpy.
    """

    def __init__(self, python: Path) -> None:
        self.python = python
        # Isolated (-I), or our PYTHONPATH would bring a NumPy that bpy wasn't built for.
        self.process = subprocess.Popen([python, "-I", _SCRIPT], stdin=_PIPE, stdout=_PIPE, stderr=_PIPE, text=True)
        assert self.process.stdin and self.process.stdout and self.process.stderr
        self.jobs: IO[str] = self.process.stdin
        self.answers: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.complaints: deque[str] = deque(maxlen=_LAST_LINES)
        # Threads, because not every system can wait for a pipe with a time limit.
        self.listeners = [
            threading.Thread(target=self._listen, args=(self.process.stdout,), daemon=True),
            threading.Thread(target=self.complaints.extend, args=(self.process.stderr,), daemon=True),
        ]
        for listener in self.listeners:
            listener.start()
        atexit.register(self.stop)

    @property
    def alive(self) -> bool:
        """Whether it can take jobs."""
        return self.process.poll() is None

    def ask(self, job: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """Have a job done; see `depthreg.rendering.blender.ask`."""
        try:
            self.jobs.write(json.dumps(job) + "\n")
            self.jobs.flush()
            line = self.answers.get(timeout=timeout_s)
        except OSError:  # its end of the pipe is gone
            line = ""
        except queue.Empty:
            self.stop()
            raise RuntimeError(f"Blender took longer than {timeout_s:g} s and was stopped.") from None
        if not line:
            raise self._explained()
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RuntimeError(f"Blender: {answer['error']}")
        return answer

    def stop(self) -> None:
        """End it, whatever it does."""
        self.process.kill()
        self.process.wait()

    def abandon(self) -> None:
        """Close this end of its pipe without ending it."""
        self.jobs.close()
        atexit.unregister(self.stop)

    def _listen(self, answers: IO[str]) -> None:
        for line in answers:
            self.answers.put(line)
        self.answers.put("")

    def _explained(self) -> Exception:
        """Why it ended."""
        self.process.wait()
        for listener in self.listeners:
            listener.join()
        said = " ".join(line.strip() for line in self.complaints)
        if "No module named 'bpy'" in said:
            return InputError(f"{self.python} has no bpy: run `make blender`, or name another by {VARIABLE}.")
        return RuntimeError(f"Blender ended with status {self.process.returncode}: {said}")
