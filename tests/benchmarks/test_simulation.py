import json
import sys
import time
from pathlib import Path

import pytest
import simulation
import torch

from depthreg.config import CONF_DIR
from depthreg.sensors import Clean

TINY = ["preset=quick", "data.width=64", "data.height=64", "data.batch_size=1", "data.train_count=2"]


def _main(monkeypatch: pytest.MonkeyPatch, folder: Path, *rows: str) -> dict:
    monkeypatch.setattr(simulation, "PRESETS", {"tiny": TINY})
    path = folder / "simulation.json"
    arguments = ["--json", str(path), "--presets", "tiny", "--frames", "1", "--draws", "1", "--rows", *rows]
    monkeypatch.setattr(sys, "argv", ["simulation.py", *arguments])
    simulation.main()
    return json.loads(path.read_text())


def test_shares_are_simulation_over_step_and_the_worst_stage_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = _main(monkeypatch, tmp_path, "joint", "completion", "full", "sensor=kinect")
    rows = {row["name"]: row for row in results["rows"] if row["device"] == "cpu"}
    assert list(rows) == ["joint", "completion", "full", "sensor=kinect"]
    assert all(row["share"] == pytest.approx(row["simulate_ms"] / row["step_ms"]) for row in rows.values())
    assert all(row["loader_ms"] > 0 for row in rows.values())
    stages = (rows[name]["simulate_ms"] / rows[name]["step_ms"] for name in simulation.STAGES)
    assert results["simulation_share"]["tiny"]["cpu"] == pytest.approx(max(stages))


def test_a_slow_sensor_shows_in_its_own_row_by_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(self: Clean, frames: dict, difficulty: float, generator: torch.Generator | None = None) -> torch.Tensor:
        until = time.process_time() + 0.2
        while time.process_time() < until:
            pass
        return frames["depth_m"]

    monkeypatch.setattr(Clean, "__call__", slow)
    monkeypatch.setattr(simulation, "PRESETS", {"tiny": TINY})
    cpu = torch.device("cpu")
    slowed, other = simulation.measure("tiny", ["sensor=clean", "sensor=hdl64"], [cpu], frames=1, draws=1)
    assert slowed.simulate_ms > 200
    assert other.simulate_ms < 200
    assert slowed.step_ms == other.step_ms  # the network's step is not the sensor's


def test_there_is_a_row_for_every_sensor_and_every_stage() -> None:
    names = {f"sensor={path.stem}" for path in (CONF_DIR / "sensor").iterdir()}
    names |= {path.stem for path in (CONF_DIR / "stage").iterdir()} - {"curriculum"}
    assert names | {"color=camera", "weather=outdoors", "offset=car"} == set(simulation.row_overrides())
