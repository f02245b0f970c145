"""What the framework costs: a training step of `depthreg train` beside one of a bare PyTorch loop.

python benchmarks/training.py --json training.json

Both take the same batches of rendered frames, simulate the same measurements of them, and train the same network by the
same loss, optimizer and clipping; they take turns step by step, so that whatever else the machine does disturbs both.
The framework's step has in it what Lightning, the callbacks, the progress bar and the loggers do for it; what happens
once an epoch isn't in it: validation, pictures, checkpoints. Times are CPU time on one thread, and time on a GPU where
there is one. Then the framework trains alone, from its own loader's processes with all frames in the cache, which gives
the share of time waiting for data, the speed, and the most memory that the process had.
"""

import argparse
import copy
import json
import resource
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import lightning as L
import torch
from omegaconf import DictConfig
from rich.console import Console
from torch.utils.data import DataLoader

from depthreg.config import build, compose_config
from depthreg.curriculum import StageParts, build_stage
from depthreg.data.sample import FrameBatch
from depthreg.run_folder import start_record, write_record
from depthreg.sensors.simulator import augment, frame_generators, simulate_each
from depthreg.stage import Stage
from depthreg.trackers import open_trackers
from depthreg.train import make_trainer
from depthreg.walk import walk

_WARM_UP = 3  # steps that don't count


@dataclass(frozen=True)
class Costs:
    """What was measured; times of a step are medians, in milliseconds."""

    overhead: float  # framework_ms / bare_ms - 1
    framework_ms: float
    bare_ms: float
    wait_share: float
    frames_per_s: float
    peak_memory_mb: float
    device: str


def now_s(device: torch.device) -> float:
    """CPU time so far; on a GPU, the time when its work is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        return time.perf_counter()
    return time.process_time()


class BareLoop:
    """Trains a copy of a stage's network as a script of a page would, at one learning rate.

    Args:
        stage: Whose network, loss, simulator and optimizer.
        clip_norm: Largest norm of the gradient.
        device: Where.
    """

    def __init__(self, stage: Stage, clip_norm: float, device: torch.device) -> None:
        self.stage, self.clip_norm, self.device = stage, clip_norm, device
        self.network = copy.deepcopy(stage.network).to(device).train()
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=stage.learning_rate, weight_decay=stage.weight_decay
        )

    def step(self, frames: FrameBatch) -> None:
        """Simulate, predict, learn."""
        frames = {key: value.to(self.device) for key, value in frames.items()}
        generators = frame_generators(frames, self.stage.seed, *self.stage.name.encode(), 0)
        batch = simulate_each(self.stage.simulator, frames, self.stage.difficulty, generators)
        batch = augment(batch, generators, self.stage.brightness)
        loss = self.stage.loss(self.network(batch["rgb"], batch["depth_m"]), batch)["total"]
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.clip_norm)
        self.optimizer.step()


class TakingTurns:
    """A loader for the framework, which trains the bare loop while the framework waits for the next batch.

    Args:
        batches: Of an epoch.
        bare: Takes the same.
    """

    def __init__(self, batches: Sequence[FrameBatch], bare: BareLoop) -> None:
        self.batches, self.bare = batches, bare
        self.framework_s: list[float] = []
        self.bare_s: list[float] = []

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[FrameBatch]:
        for batch in self.batches:
            start_s = now_s(self.bare.device)
            self.bare.step(batch)
            handed_over_s = now_s(self.bare.device)
            yield batch
            self.bare_s.append(handed_over_s - start_s)
            self.framework_s.append(now_s(self.bare.device) - handed_over_s)


@contextmanager
def prepared(overrides: Sequence[str]) -> Iterator[tuple[DictConfig, StageParts, L.Trainer]]:
    """Configuration, stage and Trainer of a run in a folder of its own, with the trackers that it would have."""
    with tempfile.TemporaryDirectory() as name:
        config, folder = compose_config("train", overrides), Path(name)
        write_record(folder, start_record(config, overrides))
        (entry,) = walk(config)
        parts = build_stage(config, entry, build(config.model))
        (folder / entry.label).mkdir()
        with open_trackers(config, folder, [entry.label], {}) as trackers:
            yield config, parts, make_trainer(config, entry, folder / entry.label, parts.callbacks, trackers)


def train_both(overrides: Sequence[str], steps: int) -> tuple[Stage, TakingTurns]:
    """So many steps of the framework and of the bare loop."""
    with prepared(overrides) as (config, (stage, data, (freeze, *_)), trainer):
        rendered = [*DataLoader(data.train_frames, data.batch_size, collate_fn=data.options["collate_fn"])]
        bare = BareLoop(stage, config.trainer.gradient_clip_val, trainer.strategy.root_device)
        freeze.apply(bare.network, epoch=0)
        turns = TakingTurns([rendered[i % len(rendered)] for i in range(steps)], bare)
        trainer.fit(stage, turns, DataLoader(rendered[:1], batch_size=None))
    return stage, turns


def measure_run(overrides: Sequence[str]) -> dict[str, float]:
    """What the last epoch of a run logs of its speed."""
    with prepared(overrides) as (_, (stage, data, _), trainer):
        trainer.fit(stage, data)
        return {name: trainer.callback_metrics[f"train/{name}"].item() for name in ("wait_share", "frames_per_s")}


def peak_memory_mb(device: torch.device) -> float:
    """The most that this process held; on a GPU, of its memory."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(overrides: Sequence[str], steps: int, frames: int, epochs: int = 3) -> Costs:
    """All figures of one stage.

    Args:
        overrides: Of `depthreg train`, with one stage as `curriculum`.
        steps: How many steps each of the two makes.
        frames: How many are rendered.
        epochs: Of the run with a loader; the last one counts.
    """
    stage = compose_config("train", overrides).curriculum[0]
    with tempfile.TemporaryDirectory() as cache:
        common = [*overrides, f"data.cache_dir={cache}", f"data.train_count={frames}", "data.val_count=1"]
        _, turns = train_both([*common, f"stages.{stage}.epochs=1"], steps + _WARM_UP)
        speed = measure_run([*common, f"stages.{stage}.epochs={epochs}"])
    framework_ms, bare_ms = (1000 * statistics.median(times[_WARM_UP:]) for times in (turns.framework_s, turns.bare_s))
    device = turns.bare.device
    return Costs(
        overhead=framework_ms / bare_ms - 1,
        framework_ms=framework_ms,
        bare_ms=bare_ms,
        peak_memory_mb=peak_memory_mb(device),
        device=device.type,
        **speed,
    )


def main() -> None:
    """Measure, print, and write what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the numbers")
    parser.add_argument("--steps", type=int, default=40, help="that the framework and the bare loop make each")
    parser.add_argument("--frames", type=int, default=40, help="that are rendered for them")
    parser.add_argument("overrides", nargs="*", default=["curriculum=[full]"], help="of depthreg train, one stage")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    costs = measure(arguments.overrides, arguments.steps, arguments.frames)
    Console().print(
        f"a step: {costs.framework_ms:.1f} ms, {costs.bare_ms:.1f} ms of a bare loop, {costs.overhead:+.1%}\n"
        f"a run: {costs.frames_per_s:.1f} frames/s, {costs.wait_share:.1%} of the time waiting for data, "
        f"at most {costs.peak_memory_mb:.0f} MB ({costs.device})"
    )
    if arguments.json:
        arguments.json.write_text(json.dumps(asdict(costs), indent=2))


if __name__ == "__main__":
    main()
