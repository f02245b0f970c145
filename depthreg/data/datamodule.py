"""Training and validation frames for one stage."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
from torch.utils.data import DataLoader

from depthreg.data.synthetic import RandomCamera, SyntheticFrames, collate_frames
from depthreg.rendering import ScanPattern
from depthreg.worlds.scene import Scene

VALIDATION_SEED_OFFSET = 1_000_003  # a prime far from any seed that users type


class SyntheticDataModule(L.LightningDataModule):
    """Rendered frames of one world, training and validation drawn from different seeds.

    Args:
        world: Builds the scene of (seed, index).
        camera: Draws the camera.
        scan: The LiDAR's pattern.
        train_count: Training frames; every epoch sees each once.
        val_count: Validation frames.
        batch_size: Frames a step.
        workers: Processes that render or load.
        seed: Seed of the training frames.
        max_depth_m: Depth beyond this is unknown.
        cache_dir: Folder that keeps rendered frames; None renders each time.
    """

    def __init__(
        self,
        world: Callable[[int, int], Scene],
        camera: RandomCamera,
        scan: ScanPattern | None,
        train_count: int,
        val_count: int,
        batch_size: int,
        workers: int = 2,
        seed: int = 0,
        max_depth_m: float = 120.0,
        cache_dir: str | None = None,
    ) -> None:
        super().__init__()
        cache = Path(cache_dir) if cache_dir else None
        self.train_frames = SyntheticFrames(world, camera, scan, seed, train_count, max_depth_m, cache)
        self.val_frames = SyntheticFrames(
            world, camera, scan, seed + VALIDATION_SEED_OFFSET, val_count, max_depth_m, cache
        )
        self.options: dict[str, Any] = {
            "batch_size": batch_size,
            "num_workers": workers,
            "collate_fn": collate_frames,
            "persistent_workers": workers > 0,
        }

    def train_dataloader(self) -> DataLoader:
        """Shuffled; a last incomplete batch is left out, as its normalisation statistics would be poor."""
        return DataLoader(self.train_frames, shuffle=True, drop_last=True, **self.options)

    def val_dataloader(self) -> DataLoader:
        """In order, complete."""
        return DataLoader(self.val_frames, **self.options)
