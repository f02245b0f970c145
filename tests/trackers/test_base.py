"""How trackers call a run."""

from collections.abc import Callable
from pathlib import Path

import yaml

from depthreg.trackers import Run


def test_a_single_run_is_named_by_its_start(make_run: Callable[..., Run]) -> None:
    run = make_run()
    assert run.name == run.group == "2026-11-25_14-40-40"
    assert run.job_type == "train" and run.tags == ["quick", "joint", "full"]


def test_the_runs_of_a_sweep_are_a_group_and_named_by_what_differs(tmp_path: Path) -> None:
    plan = {
        "hydra": {"overrides": {"task": ["seed=1,2", "experiment=ablation/full,ablation/no_rgb", "data.workers=0"]}}
    }
    (tmp_path / "multirun.yaml").write_text(yaml.safe_dump(plan))
    record = {"id": "0", "config": {}, "overrides": ["seed=2", "experiment=ablation/no_rgb", "data.workers=0"]}
    run = Run(tmp_path / "3", record, ("joint",), {"experiment": "ablation/no_rgb", "preset": "quick"})
    assert run.name == "seed=2 experiment=ablation/no_rgb"
    assert run.group == tmp_path.name
    assert run.job_type == "ablation/no_rgb" and run.tags == ["ablation/no_rgb", "quick", "joint"]
