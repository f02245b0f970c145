"""What simulating measurements costs as a share of a training step, sensor by sensor and stage by stage.

python benchmarks/simulation.py --json simulation.json

Simulating is all that happens on the device between the loader and the network; a step is forward, loss, backward and
the optimizer on what was simulated. Both are CPU time on one thread, and time on a GPU where there is one. Stages are
those that train; other rows change one thing of the last stage, with a perfect sensor and bare misalignment around it.
Everything is at difficulty 1. The loader's side, a frame drawn, rendered and matched in a worker, is CPU time.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import cv2
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from depthreg.config import CONF_DIR, build, compose_config
from depthreg.curriculum import build_stage
from depthreg.data.sample import FrameBatch
from depthreg.data.synthetic import collate_frames
from depthreg.sensors.simulator import augment, frame_generators, seeded_generator, simulate_each
from depthreg.stage import Stage
from depthreg.walk import Entry

# Overrides of `depthreg train` that say how large it is.
PRESETS = {"quick": ["preset=quick"], "paper": ["preset=paper", "model=paper", "data.batch_size=1"]}
STAGES = ("joint", "completion", "full")
_MOST_SHIFT_PX = 24.0
_ROUNDS = 2  # of each measurement; the quickest counts, as other processes disturb it least


@dataclass(frozen=True)
class Row:
    """One line of the results; times of a batch are in milliseconds."""

    preset: str
    device: str
    name: str
    simulate_ms: float
    step_ms: float
    share: float  # simulate_ms / step_ms
    loader_ms: float  # of a frame


def row_overrides() -> dict[str, tuple[str, list[str]]]:
    """Stage and overrides of each row, by its name."""
    plain = {"sensor": "clean", "offset": None, "color": None, "weather": None}
    sensors = sorted(path.stem for path in (CONF_DIR / "sensor").glob("*.yaml"))
    changes = [("sensor", name) for name in sensors]
    changes += [("color", "camera"), ("weather", "outdoors"), ("offset", "car")]
    rows: dict[str, tuple[str, list[str]]] = {stage: (stage, []) for stage in STAGES}
    for group, choice in changes:
        parts = {**plain, group: choice}
        overrides = [
            f"{key}@stages.full.{key}={value}" if value else f"stages.full.{key}=null" for key, value in parts.items()
        ]
        rows[f"{group}={choice}"] = ("full", [*overrides, f"stages.full.max_corner_shift_px={_MOST_SHIFT_PX}"])
    return rows


def elapsed_ms(action: Callable[[], object], device: torch.device) -> float:
    """CPU time of an action, in milliseconds; on a GPU, time until it is done."""
    clock = time.process_time
    if device.type == "cuda":
        clock = time.perf_counter
        torch.cuda.synchronize(device)
    start = clock()
    action()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1000 * (clock() - start)


def mean_ms(action: Callable[[int], object], count: int, device: torch.device) -> float:
    """Mean time over actions 0 to count - 1, each at its quickest, after one to warm up."""
    action(0)
    rounds = [[elapsed_ms(partial(action, i), device) for i in range(count)] for _ in range(_ROUNDS)]
    return sum(map(min, *rounds)) / count


def load(frames: Sequence[dict], batch_size: int, count: int) -> tuple[list[FrameBatch], float]:
    """Whole batches of about `count` frames, and the CPU time of a frame in milliseconds."""
    count, items = max(1, count // batch_size) * batch_size, []
    _ = frames[count]  # textures are made once
    spent_ms = elapsed_ms(lambda: items.extend(frames[i] for i in range(count)), torch.device("cpu"))
    made = [collate_frames(items[i : i + batch_size]) for i in range(0, len(items), batch_size)]
    return made, spent_ms / len(items)


def simulate_ms(module: Stage, batches: Sequence[FrameBatch], draws: int, device: torch.device) -> float:
    """Milliseconds of a batch, the mean over so many draws."""

    def simulate(draw: int) -> None:
        frames = batches[draw % len(batches)]
        generators = frame_generators(frames, draw)
        augment(simulate_each(module.simulator, frames, 1.0, generators), generators, module.brightness)

    return mean_ms(simulate, draws, device)


def step_ms(module: Stage, batch: FrameBatch, steps: int, device: torch.device) -> float:
    """Milliseconds of a training step, without simulation."""
    measurement, network = module.simulator(batch, 1.0, seeded_generator(0)), module.network
    optimizer = torch.optim.Adam(network.parameters(), lr=module.learning_rate, weight_decay=module.weight_decay)

    def step(_: int) -> None:
        optimizer.zero_grad()
        module.loss(network(measurement["rgb"], measurement["depth_m"]), measurement)["total"].backward()
        optimizer.step()

    return mean_ms(step, steps, device)


def measure(
    preset: str, names: Sequence[str], devices: Sequence[torch.device], frames: int = 8, draws: int = 16
) -> list[Row]:
    """The rows of one preset, on every device.

    Args:
        preset: Of `PRESETS`.
        names: Which rows, of `row_overrides`.
        devices: Where to simulate and train.
        frames: How many to render for each row, in whole batches.
        draws: How often to simulate them, each time anew.
    """
    rows, steps = [], dict[tuple[str, torch.device], float]()
    for name in track(names, preset):
        stage, changes = row_overrides()[name]
        config: DictConfig = compose_config(
            "train", [*PRESETS[preset], *changes, f"curriculum=[{stage}]", "data.cache_dir=null"]
        )
        module, data, (freeze, *_) = build_stage(config, Entry(stage, stage), build(config.model))
        batches, loader_ms = load(data.train_frames, config.data.batch_size, frames)
        for device in devices:
            on_device = [{key: value.to(device) for key, value in batch.items()} for batch in batches]
            module.to(device)
            if (stage, device) not in steps:  # what the depth looks like doesn't change a step
                freeze.apply(module.network, epoch=1)  # where alternating stages have their cheapest steps
                steps[stage, device] = step_ms(module, on_device[0], _ROUNDS, device)
            cost, step = simulate_ms(module, on_device, draws, device), steps[stage, device]
            rows.append(Row(preset, device.type, name, cost, step, cost / step, loader_ms))
    return rows


def worst_shares(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The largest share of a step that a stage's simulation costs, by preset and device."""
    shares: dict[str, dict[str, float]] = {}
    for row in rows:
        if row.name in STAGES:
            devices = shares.setdefault(row.preset, {})
            devices[row.device] = max(row.share, devices.get(row.device, 0))
    return shares


def print_table(rows: Sequence[Row]) -> None:
    """Print one line a row."""
    table = Table("preset", "device", "", "simulate ms", "step ms", "share %", "loader ms", title="A batch; a frame")
    for row in rows:
        times = (f"{value:.1f}" for value in (row.simulate_ms, row.step_ms, 100 * row.share, row.loader_ms))
        table.add_row(row.preset, row.device, row.name, *times)
    Console(width=110).print(table)


def main() -> None:
    """Measure, print, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=list(PRESETS))
    parser.add_argument("--rows", nargs="+", choices=row_overrides(), default=list(row_overrides()), metavar="ROW")
    parser.add_argument("--frames", type=int, default=8, help="rendered for each row, in whole batches")
    parser.add_argument("--draws", type=int, default=16, help="how often a row's batches are simulated")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    devices = [torch.device("cpu"), *([torch.device("cuda")] if torch.cuda.is_available() else [])]
    rows: list[Row] = []
    for preset in arguments.presets:
        rows += measure(preset, arguments.rows, devices, arguments.frames, arguments.draws)
    print_table(rows)
    if arguments.json:
        results = {"simulation_share": worst_shares(rows), "rows": [asdict(row) for row in rows]}
        arguments.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
