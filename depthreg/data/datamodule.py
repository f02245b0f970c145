"""Training and validation frames for one stage."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Sampler, Subset

from depthreg.data.rendered import RenderedFrames, Store, split
from depthreg.data.synthetic import RandomCamera, SyntheticFrames, collate_frames
from depthreg.errors import InputError
from depthreg.rendering import Renderer, Rig
from depthreg.sensors.simulator import seeded_generator
from depthreg.worlds.scene import Scene

VALIDATION_SEED_OFFSET = 1_000_003  # a prime far from any seed that users type


def _ignore_signals(worker: int) -> None:
    """A scheduler's signals go to every process, but it is the one that trains which saves and ends."""
    for signum in (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(signum, signal.SIG_IGN)


class EpochShuffle(Sampler[int]):
    """Every item once an epoch, in an order drawn from (seed, epoch) alone: a resumed run sees what it would have seen.

    Several processes deal the order out among them like cards. So none sees another's items, and their k-th batches
    together are the k-th batch of one process whose batches are as large as theirs together.

    Args:
        count: How many items.
        seed: First number of every draw.
        rank: Which process this is.
        ranks: How many there are; at the end of the order, what doesn't go round is left out.
        done: An epoch, and how many items of it this process had before an interruption; it goes on after them.
    """

    def __init__(self, count: int, seed: int, rank: int = 0, ranks: int = 1, done: tuple[int, int] = (0, 0)) -> None:
        self.count, self.seed, self.rank, self.ranks, self.done = count, seed, rank, ranks, done
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Lightning says so before each epoch."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[int]:
        order = torch.randperm(self.count, generator=seeded_generator(self.seed, self.epoch)).tolist()
        ours = order[self.rank : len(self) * self.ranks : self.ranks]
        done_epoch, done_items = self.done
        return iter(ours[done_items:] if self.epoch == done_epoch else ours)

    def __len__(self) -> int:
        """Items of a whole epoch, also where a part of it is done: Lightning counts that part itself."""
        return self.count // self.ranks


class FramesDataModule(L.LightningDataModule):
    """Training and validation frames, from wherever they come, split between the processes of a run.

    A checkpoint within an epoch holds how far that went, so that a resumed run goes on with the next batch.

    Args:
        train_frames: Gives items as `pack` makes them; every epoch sees each once.
        val_frames: Likewise.
        batch_size: Frames a step of one process.
        workers: Processes that render or load, for each process of the run.
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
        self.train_frames, self.val_frames, self.batch_size, self.seed = train_frames, val_frames, batch_size, seed
        self.require_frames(ranks=1)
        self.done = (0, 0)  # epoch, and batches of it
        self.options: dict[str, Any] = {
            "batch_size": batch_size,
            "num_workers": workers,
            "collate_fn": collate_frames,
            "persistent_workers": workers > 0,
            "worker_init_fn": _ignore_signals,
        }

    def require_frames(self, ranks: int) -> None:
        """Check that every process of a run gets a training batch and a validation frame.

        Raises:
            InputError: There are too few.
        """
        count, val_count, needed = len(self.train_frames), len(self.val_frames), ranks * self.batch_size
        if count < needed:
            batch = f"{self.batch_size} in each of {ranks} processes" if ranks > 1 else f"{self.batch_size}"
            raise InputError(f"{count} training frames: expected at least one batch of {batch}")
        if val_count < ranks:
            raise InputError(f"{val_count} validation frames: expected at least one for each of {ranks} processes")

    def _place(self) -> tuple[int, int]:
        """Rank of this process, and how many there are."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def train_dataloader(self) -> DataLoader:
        """Shuffled; a last incomplete batch is left out, as its normalisation statistics would be poor.

        Raises:
            InputError: There are too few frames for so many processes.
        """
        rank, ranks = self._place()
        self.require_frames(ranks)
        epoch, batches = self.done
        shuffle = EpochShuffle(len(self.train_frames), self.seed, rank, ranks, (epoch, batches * self.batch_size))
        shuffle.set_epoch(epoch)  # workers draw the order before Lightning names the epoch
        return DataLoader(self.train_frames, sampler=shuffle, drop_last=True, **self.options)

    def val_dataloader(self) -> DataLoader:
        """In order, complete; every `ranks`-th frame. None comes twice to fill up: metrics would count it twice."""
        rank, ranks = self._place()
        ours = Subset(self.val_frames, range(rank, len(self.val_frames), ranks))
        return DataLoader(ours, **self.options)

    def state_dict(self) -> dict[str, int]:
        """The epoch that training is in, and how many batches of it are done; the next epoch where all are."""
        assert self.trainer is not None
        epoch = self.trainer.current_epoch
        batches = self.trainer.fit_loop.epoch_loop.batch_progress.current.processed  # type: ignore[attr-defined]
        if batches < self.trainer.num_training_batches:
            return {"epoch": epoch, "batches": batches}
        return {"epoch": epoch + 1, "batches": 0}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Go on after the batches that a checkpoint counts."""
        self.done = state_dict["epoch"], state_dict["batches"]


class SyntheticDataModule(FramesDataModule):
    """Rendered frames of one world, training and validation drawn from different seeds.

    Args:
        world: Builds the scene of (seed, index).
        camera: Draws the camera.
        rig: What else to render, as the sensor simulator needs it.
        train_count: Training frames; every epoch sees each once.
        val_count: Validation frames.
        batch_size: Frames a step of one process.
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
