"""Rendered frames as a data set: drawn on the fly, or kept on disk after the first time."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from depthreg.data.io import atomic_write
from depthreg.data.sample import Frame, FrameBatch, Measurement
from depthreg.rendering import Camera, ScanPattern, render_frame
from depthreg.sensors.misalignment import REFERENCE_WIDTH_PX, margin_for
from depthreg.sensors.simulator import SensorSimulator, simulate_each
from depthreg.worlds.scene import Scene


@dataclass(frozen=True)
class RandomCamera:
    """A camera with a random field of view and principal point, so that a network can't memorise one rig.

    Args:
        width, height: Image size in pixels.
        focal_px: Smallest and largest focal length; drawn uniformly in its logarithm.
        center_jitter: Largest offset of the principal point from the image's centre, as a share of the image's size.
        max_corner_shift_px: Largest misalignment that the margin has to serve, for an image 1242 pixels wide.
    """

    width: int
    height: int
    focal_px: tuple[float, float]
    center_jitter: float = 0.0
    max_corner_shift_px: float = 24.0

    def __post_init__(self) -> None:
        low, high = self.focal_px
        if not 0 < low <= high:
            raise ValueError(f"focal_px must be two positive lengths, the smaller first, got {list(self.focal_px)}")

    def __call__(self, rng: np.random.Generator) -> Camera:
        """One camera."""
        low, high = np.log(self.focal_px)
        size = np.array([self.width, self.height])
        center = (size - 1) / 2 + self.center_jitter * size * rng.uniform(-1, 1, 2)
        return Camera(
            width=self.width,
            height=self.height,
            focal_px=float(np.exp(rng.uniform(low, high))),
            center_px=(float(center[0]), float(center[1])),
            margin_px=margin_for(self.max_corner_shift_px * self.width / REFERENCE_WIDTH_PX),
        )


class SyntheticFrames(Dataset[dict[str, Any]]):
    """Frames of one world; item i is a function of (world, camera, scan, seed, i) alone.

    Args:
        world: Builds the scene of (seed, index).
        camera: Draws the camera.
        scan: The LiDAR's pattern; None where no LiDAR is wanted.
        seed: First number of every scene; training and validation take different ones.
        count: How many frames.
        max_depth_m: Depth beyond this is unknown (0), as beyond any scanner's range.
        cache_dir: Folder that keeps rendered frames; None renders each time.
    """

    def __init__(
        self,
        world: Callable[[int, int], Scene],
        camera: RandomCamera,
        scan: ScanPattern | None,
        seed: int,
        count: int,
        max_depth_m: float,
        cache_dir: Path | None = None,
    ) -> None:
        self.world, self.camera, self.scan, self.seed, self.count = world, camera, scan, seed, count
        self.max_depth_m = max_depth_m
        recipe = repr((world, camera, scan, seed, max_depth_m)).encode() + _code_of("worlds", "rendering")
        self.folder = cache_dir / hashlib.sha256(recipe).hexdigest()[:16] if cache_dir else None

    def __len__(self) -> int:
        return self.count

    def frame(self, index: int) -> Frame:
        """Render frame `index`, with everything in it but the right camera's image."""
        camera = self.camera(np.random.default_rng([self.seed, index, 1]))
        return render_frame(self.world(self.seed, index), camera, self.scan, right=False)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """What the simulator needs of a frame, as NumPy arrays; see `collate_frames`."""
        if not 0 <= index < self.count:
            raise IndexError(index)
        if self.folder is None:
            return {**self._pack(self.frame(index)), "index": index}
        path = self.folder / f"{index:06d}.npz"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as temporary:  # several workers may fill one cache
                np.savez(temporary, **self._pack(self.frame(index)))  # type: ignore[arg-type]
        with np.load(path) as arrays:
            return {**{key: arrays[key] for key in arrays.files}, "index": index}

    def _pack(self, frame: Frame) -> dict[str, np.ndarray]:
        lidar = frame.lidar
        columns = (lidar.uv_px, lidar.depth_m, lidar.range_m, lidar.cos_incidence, lidar.albedo, lidar.ring)
        return {
            "rgb": frame.rgb,
            "depth_m": np.where(frame.depth_m > self.max_depth_m, 0, frame.depth_m),
            "intrinsics": frame.intrinsics,
            "lidar": np.column_stack(columns).astype(np.float32),
        }


def _code_of(*packages: str) -> bytes:
    """Source text of our packages: a cached frame belongs to the code that rendered it."""
    root = Path(__file__).parents[1]
    return b"".join(path.read_bytes() for package in packages for path in sorted((root / package).glob("*.py")))


def collate_frames(items: Sequence[dict[str, Any]]) -> FrameBatch:
    """Stack items; returns are padded with zeros (range 0) to the longest list."""
    longest = max(len(item["lidar"]) for item in items)
    lidar = torch.zeros(len(items), longest, 7)
    for row, item in zip(lidar, items, strict=True):
        row[: len(item["lidar"])] = torch.from_numpy(item["lidar"])
    return FrameBatch(
        rgb=torch.from_numpy(np.stack([item["rgb"] for item in items])).permute(0, 3, 1, 2).contiguous(),
        depth_m=torch.from_numpy(np.stack([item["depth_m"] for item in items]))[:, None],
        intrinsics=torch.from_numpy(np.stack([item["intrinsics"] for item in items])),
        lidar=lidar,
        index=torch.tensor([item["index"] for item in items]),
    )


class SyntheticMeasurements(Dataset[Measurement]):
    """Simulated measurements of frames, each a function of its index alone; items have no batch axis.

    Args:
        frames: What perfect instruments see.
        simulator: Turns it into what real instruments report.
        difficulty: In [0, 1].
        seed: First number of every draw.
    """

    def __init__(self, frames: SyntheticFrames, simulator: SensorSimulator, difficulty: float, seed: int) -> None:
        self.frames, self.simulator, self.difficulty, self.seed = frames, simulator, difficulty, seed

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Measurement:
        batch = collate_frames([self.frames[index]])
        measured = simulate_each(self.simulator, batch, self.difficulty, self.seed)
        return Measurement(**{key: value[0] for key, value in measured.items()}, name=f"{index:06d}")  # type: ignore[typeddict-item, index]
