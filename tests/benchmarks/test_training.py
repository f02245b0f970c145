import json
import sys
import time
from pathlib import Path

import pytest
import torch
import training

from depthreg.callbacks import Throughput

TINY = [
    "curriculum=[joint]",
    "data.width=80",
    "data.height=64",
    "data.batch_size=2",
    "data.workers=0",
    "model.completion_widths=[16,16]",
    "trainer.accelerator=cpu",
    "logger=csv",
]


def _main(monkeypatch: pytest.MonkeyPatch, folder: Path) -> dict:
    path = folder / "training.json"
    arguments = ["--json", str(path), "--steps", "2", "--frames", "2", *TINY]
    monkeypatch.setattr(sys, "argv", ["training.py", *arguments])
    training.main()
    return json.loads(path.read_text())


def test_what_a_callback_costs_is_overhead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(self: Throughput, *_: object) -> None:
        until = time.process_time() + 0.3
        while time.process_time() < until:
            pass

    monkeypatch.setattr(Throughput, "on_before_optimizer_step", slow)
    costs = _main(monkeypatch, tmp_path)
    assert costs["overhead"] == pytest.approx(costs["framework_ms"] / costs["bare_ms"] - 1)
    assert costs["framework_ms"] - costs["bare_ms"] > 250
    assert 0 <= costs["wait_share"] <= 1 and costs["frames_per_s"] > 0 and costs["peak_memory_mb"] > 50


def test_both_do_the_same_work(tmp_path: Path) -> None:
    """They learn the same weights to the bit, so none of them leaves anything out."""
    overrides = [*TINY, "data.train_count=2", "data.val_count=1", f"data.cache_dir={tmp_path}"]
    at_one_rate = ["stages.joint.epochs=1", "+stages.joint.module.warmup_steps=0"]
    stage, turns = training.train_both([*overrides, *at_one_rate], steps=3)
    ours, theirs = stage.network.state_dict(), turns.bare.network.state_dict()
    assert [key for key in ours if not torch.equal(ours[key], theirs[key])] == []
    assert len(turns.framework_s) == len(turns.bare_s) == 2  # nobody asks for a batch after the last one
