"""Training and validation frames for one stage."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Sampler

from depthreg.data.synthetic import RandomCamera, SyntheticFrames, collate_frames
from depthreg.rendering import Renderer, Rig
from depthreg.sensors.simulator import seeded_generator
from depthreg.worlds.scene import Scene

VALIDATION_SEED_OFFSET = 1_000_003  # a prime far from any seed that users type


class EpochShuffle(Sampler[int]):
    """Every item once an epoch, in an order drawn from (seed, epoch) alone: a resumed run sees what it would have seen.

    Args:
        count: How many items.
        seed: First number of every draw.
    """

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.seed, self.epoch = count, seed, 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning says so before each epoch."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[int]:
        order = torch.randperm(self.count, generator=seeded_generator(self.seed, self.epoch))
        return iter(order.tolist())

    def __len__(self) -> int:
        return self.count


class SyntheticDataModule(L.LightningDataModule):
    """Rendered frames of one world, training and validation drawn from different seeds.

    Args:
        world: Builds the scene of (seed, index).
        camera: Draws the camera.
        rig: What else to render, as the sensor simulator needs it.
        train_count: Training frames; every epoch sees each once.
        val_count: Validation frames.
        batch_size: Frames a step.
        workers: Processes that render or load.
        seed: Seed of the training frames.
        max_depth_m: Depth beyond this is unknown.
        cache_dir: Folder that keeps rendered frames; None renders each time.
        renderer: Renders them; Embree where not given.
    """

    def __init__(
        self,
        world: Callable[[int, int], Scene],
        camera: RandomCamera,
        rig: Rig,
        train_count: int,
        val_count: int,
        batch_size: int,
        workers: int = 2,
        seed: int = 0,
        max_depth_m: float = 120.0,
        cache_dir: str | None = None,
        renderer: Renderer | None = None,
    ) -> None:
        super().__init__()
        cache = Path(cache_dir) if cache_dir else None
        self.train_frames = SyntheticFrames(world, camera, rig, seed, train_count, max_depth_m, cache, renderer)
        self.val_frames = SyntheticFrames(
            world, camera, rig, seed + VALIDATION_SEED_OFFSET, val_count, max_depth_m, cache, renderer
        )
        self.shuffle = EpochShuffle(train_count, seed)
        self.options: dict[str, Any] = {
            "batch_size": batch_size,
            "num_workers": workers,
            "collate_fn": collate_frames,
            "persistent_workers": workers > 0,
        }

    def train_dataloader(self) -> DataLoader:
        """Shuffled; a last incomplete batch is left out, as its normalisation statistics would be poor."""
        return DataLoader(self.train_frames, sampler=self.shuffle, drop_last=True, **self.options)

    def val_dataloader(self) -> DataLoader:
        """In order, complete."""
        return DataLoader(self.val_frames, **self.options)
