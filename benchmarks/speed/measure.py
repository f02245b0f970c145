"""Time and memory of one case, in a process of its own."""

import gc
import multiprocessing
import os
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import cv2
import torch

from speed.methods import METHODS, Case


@dataclass(frozen=True)
class Timing:
    """What a case costs.

    Attributes:
        seconds: Median of a frame.
        runs: How many runs that is the median of.
        peak_mb: The most memory that the process held while it ran, Python and libraries included.
        ready_mb: What it held before, with libraries and weights loaded.
        parameters: In millions.
        reason: Why there is nothing of this; empty where there is.
    """

    seconds: float = 0.0
    runs: int = 0
    peak_mb: float = 0.0
    ready_mb: float = 0.0
    parameters: float = 0.0
    reason: str = ""


def measure(case: Case, runs: int, seconds: float) -> Timing:
    """Measure in a new process; what fails there, or kills it, becomes the reason."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as process:
        try:
            return process.submit(measure_here, case, runs, seconds).result()
        except BrokenProcessPool:
            return Timing(reason="its process was killed, as for want of memory")


def measure_here(case: Case, runs: int, seconds: float) -> Timing:
    """The same in this process.

    Args:
        case: What to measure.
        runs: How many runs at most, after one that doesn't count.
        seconds: Begin no further run after so long.
    """
    torch.set_num_threads(case.threads)
    cv2.setNumThreads(case.threads)
    make, _ = METHODS[case.method]
    try:
        runner = make(case)
        ready_mb = _memory_mb("VmRSS")
        runner.run()
        _forget_peak()
        taken_s = _take_times(runner.run, runs, seconds)
    except Exception as error:  # such as no compiler, or a missing package: the other rows don't depend on it
        return Timing(reason=f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error) else ''}")
    median_s = statistics.median(taken_s) / runner.frames
    return Timing(median_s, len(taken_s), _memory_mb("VmHWM"), ready_mb, runner.parameters)


def _take_times(run: Callable[[], object], runs: int, seconds: float) -> list[float]:
    begin_s = time.perf_counter()
    taken_s: list[float] = []
    while not taken_s or (len(taken_s) < runs and time.perf_counter() - begin_s < seconds):
        start_s = time.perf_counter()
        run()
        taken_s.append(time.perf_counter() - start_s)
    return taken_s


def _forget_peak() -> None:
    """Let the peak begin here: compiling, exporting and the first run are not what a frame takes."""
    gc.collect()
    if os.access("/proc/self/clear_refs", os.W_OK):
        Path("/proc/self/clear_refs").write_text("5")


def _memory_mb(key: str) -> float:
    """A line of Linux's account of this process; unlike `getrusage`, it starts anew with the program."""
    if sys.platform != "linux":
        return float("nan")
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key)) / 1024
