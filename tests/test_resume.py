"""A run that was killed, whenever it was, ends as one that wasn't."""

import csv
import errno
import itertools
import os
import shutil
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from depthreg import checkpoint, train
from depthreg.cli import main
from depthreg.stage import Stage

SMALL = [
    *("data.width=80", "data.height=64", "data.train_count=6", "data.val_count=3", "data.batch_size=2"),
    *("data.workers=0", "model.completion_widths=[16,16]", "trainer.accelerator=cpu", "callbacks.panels=null"),
    *("epochs.joint=2", "epochs.completion=1", "epochs.full=2", "curriculum=[joint,full]", "logger=csv"),
    "hydra.run.dir=run",
]
STEPS = 3  # of an epoch


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def at_call(count: int, do: Callable[[], None], function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, but when it's called for the count-th time, `do` comes first."""
    calls = iter(range(1, 10**6))

    def counting(*arguments: Any, **options: Any) -> Any:
        if next(calls) == count:
            do()
        return function(*arguments, **options)

    return counting


def in_a_process(*overrides: str, patches: Sequence[tuple[object, str, int]] = (), do: Any = die) -> int:
    """Exit status of `depthreg train` in a process of its own, negative for a signal that ended it."""
    child = os.fork()
    if child == 0:
        status = 70
        try:
            for owner, name, count in patches:
                setattr(owner, name, at_call(count, do, getattr(owner, name)))
            status = main(["train", *overrides])
        except SystemExit as error:
            status = error.code if isinstance(error.code, int) else 71
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> str:
    return f"data.cache_dir={tmp_path_factory.mktemp('frames')}"


@pytest.fixture(scope="module")
def uninterrupted(frames: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that nothing disturbed."""
    here = tmp_path_factory.mktemp("uninterrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        assert in_a_process(*SMALL, frames) == 0
    return here / "run"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scores(run: Path) -> list[list[str]]:
    with (run / "metrics.csv").open() as file:
        return [row for row in csv.reader(file) if row[1] != "seconds"]


def assert_same(run: Path, other: Path) -> None:
    for stage in ("joint", "full"):
        ours, theirs = (torch.load(folder / stage / "last.ckpt", weights_only=True) for folder in (run, other))
        assert ours["global_step"] == theirs["global_step"] == 2 * STEPS
        different = [k for k, v in theirs["state_dict"].items() if not torch.equal(ours["state_dict"][k], v)]
        assert different == []
    assert scores(run) == scores(other)
    assert not list(run.glob("*/.*.ckpt"))


KILLED = {  # when, and what is called for the how-manieth time then
    "before the first step has ended": [(Stage, "training_step", 1)],
    "within the first epoch": [(Stage, "training_step", 3)],
    "within the second stage": [(Stage, "training_step", 2 * STEPS + 5)],
    "in the first validation": [(Stage, "validation_step", 2)],
    "in the last validation": [(Stage, "validation_step", 8)],
    "while it wrote the first checkpoint": [(checkpoint.os, "fsync", 1)],
    "while it wrote a later checkpoint": [(checkpoint.os, "fsync", 4)],
    "after the last checkpoint of a stage": [(train, "finish_stage", 1)],
    "between the stages": [(train, "train_stage", 2)],
    "in the final evaluation": [(train, "evaluate", 1)],
}


@pytest.mark.parametrize(
    ("when", "every_steps", "workers"),
    [(when, *options) for when, options in zip(KILLED, itertools.cycle([("null", 1), ("1", 0), ("1", 1)]))],
)
def test_a_killed_run_ends_as_one_that_was_not(
    when: str, every_steps: str, workers: int, frames: str, uninterrupted: Path, here: Path
) -> None:
    options = [f"checkpoint_every_steps={every_steps}", f"data.workers={workers}"]
    assert in_a_process(*SMALL, frames, *options, patches=KILLED[when]) == -signal.SIGKILL
    assert in_a_process("resume=run") == 0
    assert_same(here / "run", uninterrupted)


def test_a_run_may_be_killed_again_and_again(frames: str, uninterrupted: Path, here: Path) -> None:
    arguments = [*SMALL, frames, "checkpoint_every_steps=1"]
    starts = 0
    while in_a_process(*arguments, patches=[(Stage, "training_step", 4)]) != 0:
        arguments, starts = ["resume=run"], starts + 1
    assert starts == 3  # three steps more in each
    assert_same(here / "run", uninterrupted)


def test_a_killed_sweep_that_is_started_again_trains_what_is_left(
    frames: str, uninterrupted: Path, here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    sweep = ["-m", *(item for item in SMALL if not item.startswith("hydra")), frames, "hydra.sweep.dir=sweep"]
    killed = [(Stage, "training_step", 5 * STEPS)]  # in the second job
    assert in_a_process(*sweep, "seed=1,0", patches=killed) == -signal.SIGKILL
    first = here / "sweep" / "0" / "full" / "last.ckpt"
    before = first.stat().st_mtime_ns
    assert in_a_process(*sweep, "seed=1,0") == 0
    assert first.stat().st_mtime_ns == before and "0 has ended already" in capfd.readouterr().out
    assert_same(here / "sweep" / "1", uninterrupted)
    assert in_a_process(*sweep, "seed=2,0") == 2  # another sweep in the same folder: the first job isn't this one's
    assert "job 0 (seed=2)" in (said := capfd.readouterr().err) and "holds a run" in said


@pytest.mark.parametrize("step", [2, STEPS, 2 * STEPS + 1])
def test_sigterm_saves_first(step: int, frames: str, uninterrupted: Path, here: Path) -> None:
    def terminate() -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    ended = in_a_process(*SMALL, frames, patches=[(Stage, "training_step", step)], do=terminate)
    assert ended == 128 + signal.SIGTERM
    stage = "full" if step > 2 * STEPS else "joint"
    assert torch.load(Path("run") / stage / "last.ckpt", weights_only=True)["global_step"] == (step - 1) % 6 + 1
    assert in_a_process("resume=run") == 0
    assert_same(here / "run", uninterrupted)


def test_slurm_is_asked_to_queue_the_job_again_and_its_next_start_goes_on(
    frames: str, uninterrupted: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scontrol = here / "bin" / "scontrol"
    scontrol.parent.mkdir()
    scontrol.write_text(f'#!/bin/sh\necho "$@" > {here}/asked\n')
    scontrol.chmod(0o755)
    monkeypatch.setenv("PATH", str(scontrol.parent), prepend=os.pathsep)
    for key, value in {"SLURM_JOB_ID": "42", "SLURM_NTASKS": "1", "SLURM_JOB_NAME": "bash"}.items():
        monkeypatch.setenv(key, value)

    def warn() -> None:
        os.kill(os.getpid(), signal.SIGUSR1)

    command = [*SMALL, frames]
    assert in_a_process(*command, patches=[(Stage, "training_step", 4)], do=warn) == 128 + signal.SIGUSR1
    assert (here / "asked").read_text() == "requeue 42\n"
    assert in_a_process(*command) == 2  # a user's mistake: the folder holds a run
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert in_a_process(*command) == 0
    assert_same(here / "run", uninterrupted)


def no_space() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "run/joint/last.ckpt")


def test_a_full_disk_leaves_the_last_checkpoint_as_it_was(
    frames: str, uninterrupted: Path, here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    full = [(checkpoint.os, "fsync", 3)]  # after an epoch's last and best
    assert in_a_process(*SMALL, frames, patches=full, do=no_space) == 1
    message = capfd.readouterr().err.strip().splitlines()[-1]
    assert "last.ckpt can't be written: No space left on device" in message
    assert torch.load(Path("run/joint/last.ckpt"), weights_only=True)["global_step"] == STEPS
    assert in_a_process("resume=run") == 0
    assert_same(here / "run", uninterrupted)


def test_a_loss_that_is_no_number_ends_the_run_and_leaves_the_last_checkpoint(
    frames: str, uninterrupted: Path, here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(stage: Stage, batch: Any, batch_idx: int) -> torch.Tensor:
        return healthy(stage, batch, batch_idx) * (float("nan") if stage.global_step == STEPS + 1 else 1)

    healthy = Stage.training_step
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Stage, "training_step", broken)
        assert in_a_process(*SMALL, frames, "callbacks.finite.every_steps=1", "checkpoint_every_steps=1") == 1
    assert "the training loss became nan by step 5, epoch 1" in capfd.readouterr().err.strip().splitlines()[-1]
    kept = torch.load(Path("run/joint/last.ckpt"), weights_only=True)
    assert kept["global_step"] == STEPS + 1
    assert in_a_process("resume=run") == 0


def test_weights_that_are_no_numbers_are_never_saved(tmp_path: Path) -> None:
    writer, path = checkpoint.AtomicCheckpointIO(), tmp_path / "last.ckpt"
    good = {"state_dict": {"a": torch.ones(3), "b": torch.tensor([2**31])}}
    writer.save_checkpoint(good, path)
    with pytest.raises(checkpoint.RunError, match="stays as it was"):
        writer.save_checkpoint({"state_dict": {"a": torch.tensor([1, float("inf")])}}, path)
    assert torch.equal(torch.load(path)["state_dict"]["a"], torch.ones(3))
    assert [file.name for file in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_lost_worker_is_one_sentence(frames: str, here: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from depthreg.data import synthetic

    patches = [(synthetic.SyntheticFrames, "__getitem__", 2)]  # in each worker, which is a fork of this process
    assert in_a_process(*SMALL, frames, "data.workers=1", patches=patches) == 1
    assert "DataLoader worker" in capfd.readouterr().err.strip().splitlines()[-1]


def test_two_processes_cannot_train_one_run(frames: str, here: Path, capfd: pytest.CaptureFixture[str]) -> None:
    both: list[int] = []

    def start_another() -> None:
        both.append(in_a_process("resume=run"))
        os._exit(40 + both[0])

    assert in_a_process(*SMALL, frames, patches=[(Stage, "training_step", 2)], do=start_another) == 42
    assert "is being trained by another process" in capfd.readouterr().err


def test_a_run_that_has_ended_says_its_results_again(uninterrupted: Path, here: Path) -> None:
    shutil.copytree(uninterrupted, here / "run")
    before = (here / "run" / "full" / "last.ckpt").stat().st_mtime_ns
    assert main(["train", "resume=run"]) == 0
    assert (here / "run" / "full" / "last.ckpt").stat().st_mtime_ns == before
    assert_same(here / "run", uninterrupted)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["resume=nowhere"], "nowhere holds no run.yaml"),
        (["resume=run", "init_from=x"], "expected no init_from=x"),
        (["resume=run", "-m", "seed=1,2"], "expected no -m"),
        (["resume=run", "model.completion_widths=[16]"], "another model"),
    ],
)
def test_what_cannot_be_resumed_is_refused_and_left_alone(
    arguments: list[str], said: str, uninterrupted: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(uninterrupted, here / "run")
    before = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    assert main(["train", *arguments]) == 2
    message = capsys.readouterr().err
    assert said in message and len(message.splitlines()) == 1
    assert {path: path.read_bytes() for path in here.rglob("*") if path.is_file()} == before


def test_a_run_of_other_defaults_is_not_turned_into_another_experiment(
    uninterrupted: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(uninterrupted, here / "run")
    record = here / "run" / "run.yaml"
    record.write_text(record.read_text().replace("learning_rate: 0.002", "learning_rate: 0.004"))
    assert main(["train", "resume=run"]) == 2
    assert "run was started with learning_rate=0.004" in capsys.readouterr().err
