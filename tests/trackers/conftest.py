"""Runs to look at, without training."""

from collections.abc import Callable
from pathlib import Path

import pytest

from depthreg.trackers import Run


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Run]:
    """A run of two stages in a folder of its own."""

    def make(name: str = "2026-11-25_14-40-40", **choices: str) -> Run:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        record = {
            "id": f"{len(name):08x}",
            "overrides": ["seed=2"],
            "git": {"revision": "c0ffee", "dirty": False},
            "versions": {"python": "3.12.1"},
            "hardware": {"cores": 2},
            "config": {"seed": 2, "loss": {"depth": {"weight": 0.9}}},
        }
        return Run(folder, record, ("joint", "full"), {"preset": "quick", **choices})

    return make


@pytest.fixture(autouse=True)
def nothing_in_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """wandb keeps what it has to send there."""
    monkeypatch.setenv("WANDB_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("WANDB_CACHE_DIR", str(tmp_path))


@pytest.fixture
def results() -> dict[str, dict[str, dict[str, float]]]:
    """A final table; `nearest` doesn't register."""
    return {
        "depth, aligned": {"ours": {"rmse_m": 1.5}, "nearest": {"rmse_m": 2.5}},
        "registration": {"ours": {"corner_error_px": 0.75}},
    }
