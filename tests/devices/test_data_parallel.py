"""Two processes train as one does, and agree to the bit."""

import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from depthreg.devices import average_statistics

PROGRAM = str(Path(__file__).with_name("train_together.py"))
STEPS = 6  # three epochs of two

Seen = Callable[[str], dict[str, Any]]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """What a process saw and held, by the name of its plan and its rank."""
    folder = tmp_path_factory.mktemp("seen")
    runpy.run_path(PROGRAM)["main"](folder, "doubled:4", "accumulated:2:trainer.accumulate_grad_batches=2")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", PROGRAM]
    plans = [str(folder), "shared:2:trainer.devices=2", "plain:2:trainer.devices=2"]
    subprocess.run([*command, *plans], check=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True)
    return lambda name: torch.load(folder / f"{name}.pt", weights_only=True)


def largest_difference(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> float:
    return max((ours[key] - theirs[key]).abs().max().item() for key in theirs)


def test_two_processes_learn_what_one_does_from_the_doubled_batch(seen: Seen) -> None:
    alone, shared = seen("doubled_0")["states"], seen("shared_0")["states"]
    assert len(alone) == len(shared) == STEPS
    assert max(map(largest_difference, shared, alone)) < 1e-5
    assert largest_difference(alone[0], alone[-1]) > 1e-3  # it did learn


def test_gradients_of_two_batches_together_teach_what_the_doubled_batch_does(seen: Seen) -> None:
    alone, accumulated = seen("doubled_0")["states"], seen("accumulated_0")["states"][1::2]
    assert len(alone) == len(accumulated) == STEPS
    assert max(map(largest_difference, accumulated, alone)) < 1e-5


@pytest.mark.parametrize("plan", ["shared", "plain"])
def test_weights_and_statistics_are_identical_in_both_processes_after_every_step(plan: str, seen: Seen) -> None:
    first, second = (seen(f"{plan}_{rank}")["states"] for rank in range(2))
    assert len(first) == len(second) == STEPS
    for ours, theirs in zip(first, second, strict=True):
        assert [key for key in ours if not torch.equal(ours[key], theirs[key])] == []
    assert any(key.endswith("running_var") for key in first[0]) == (plan == "plain")


def test_what_rests_in_an_epoch_stays_as_it_was_and_has_no_gradient(seen: Seen) -> None:
    """The second epoch rests completion, BatchNorm's statistics included; all of it learns before and after."""
    plain = seen("plain_1")
    states, gradients = plain["states"], plain["gradients"]
    completion = [key for key in states[0] if key.startswith("completion.")]
    moved = [any(not torch.equal(a[key], b[key]) for key in completion) for a, b in pairwise(states)]
    assert moved == [True, False, False, True, True]
    learns = [any(name.startswith("completion.") for name in names) for names in gradients]
    assert learns == [True, True, False, False, True, True]
    assert all(any(name.startswith("registration.") for name in names) for names in gradients)


def test_every_frame_is_seen_by_one_process_alone_and_in_the_same_step_as_by_one(seen: Seen) -> None:
    alone, *each = (seen(name)["frames"] for name in ("doubled_0", "shared_0", "shared_1"))
    epochs = [alone[i : i + 4] for i in range(0, 12, 4)]  # two steps, then validation frames 0 to 3 and 4
    assert [epoch[2:] for epoch in epochs] == [[[0, 1, 2, 3], [4]]] * 3
    ours = [each[0][i : i + 4] for i in range(0, 12, 4)]
    theirs = [each[1][i : i + 3] for i in range(0, 9, 3)]
    for whole, first, second in zip(epochs, ours, theirs, strict=True):
        for step in range(2):
            assert sorted(first[step] + second[step]) == sorted(whole[step])
        assert (first[2:], second[2:]) == ([[0, 2], [4]], [[1, 3]])


def test_metrics_are_those_of_one_process(seen: Seen) -> None:
    """Five validation frames on two processes: none counts twice, and one process has a batch more."""
    alone, first, second = (seen(name)["metrics"] for name in ("doubled_0", "shared_0", "shared_1"))
    assert {"val/loss", "val/rmse_m", "val/corner_error_median_px", "train/loss"} <= alone[-1].keys()
    assert first == second
    for ours, theirs in zip(first, alone, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-5)


def test_statistics_of_frozen_norms_take_no_part_in_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the other process held twice this one's values."""
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda tensor: tensor.mul_(3))
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    network = nn.Sequential(nn.BatchNorm2d(2), nn.BatchNorm1d(3).eval(), nn.GroupNorm(1, 2))
    with torch.no_grad():
        network[0].running_mean.fill_(4.0)
        network[1].running_mean.fill_(4.0)
    average_statistics(network)
    assert network[0].running_mean.tolist() == [6.0, 6.0] and network[0].running_var.tolist() == [1.5, 1.5]
    assert network[1].running_mean.tolist() == [4.0] * 3 and network[1].running_var.tolist() == [1.0] * 3
