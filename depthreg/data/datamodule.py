"""Training and validation frames for one stage."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Sampler

from depthreg.data.rendered import RenderedFrames, Store, split
from depthreg.data.synthetic import RandomCamera, SyntheticFrames, collate_frames
from depthreg.errors import InputError
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


class FramesDataModule(L.LightningDataModule):
    """Training and validation frames, from wherever they come.

    Args:
        train_frames: Gives items as `pack` makes them; every epoch sees each once.
        val_frames: Likewise.
        batch_size: Frames a step.
        workers: Processes that render or load.
        seed: Of the training frames' order.

    Raises:
        InputError: The training frames don't make a batch.
    """

    def __init__(
        self,
        train_frames: SyntheticFrames | RenderedFrames,
        val_frames: SyntheticFrames | RenderedFrames,
        batch_size: int,
        workers: int,
        seed: int,
    ) -> None:
        super().__init__()
        self.train_frames, self.val_frames = train_frames, val_frames
        count = len(train_frames)
        if count < batch_size:
            raise InputError(f"{count} training frames: expected at least one batch of {batch_size}")
        self.shuffle = EpochShuffle(count, seed)
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


class SyntheticDataModule(FramesDataModule):
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
        cache = Path(cache_dir) if cache_dir else None
        train, val = (
            SyntheticFrames(world, camera, rig, first, count, max_depth_m, cache, renderer)
            for first, count in ((seed, train_count), (seed + VALIDATION_SEED_OFFSET, val_count))
        )
        super().__init__(train, val, batch_size, workers, seed)


class RenderedDataModule(FramesDataModule):
    """Frames that `depthreg render` wrote: the first of a data set for training, its last ones for validation.

    Args:
        store: A folder, or tar files anywhere.
        rig: What the sensor simulator needs.
        max_corner_shift_px: Largest misalignment that the colour's margin has to serve.
        val_share: Share of the frames that are for validation.
        batch_size, workers, seed, max_depth_m: As for `SyntheticDataModule`.

    Raises:
        InputError: The frames lack what is needed, or are too few.
    """

    def __init__(
        self,
        store: Store,
        rig: Rig,
        max_corner_shift_px: float,
        val_share: float,
        batch_size: int,
        workers: int = 2,
        seed: int = 0,
        max_depth_m: float = 120.0,
    ) -> None:
        train, val = (
            RenderedFrames(store, indices, rig, max_corner_shift_px, max_depth_m)
            for indices in split(store.description["config"]["count"], val_share)
        )
        super().__init__(train, val, batch_size, workers, seed)
