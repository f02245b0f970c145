"""Rendered frames as a data set: drawn on the fly, or kept on disk after the first time."""

import hashlib
from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch.utils.data import Dataset

from depthreg.data.io import atomic_write
from depthreg.data.sample import Frame, FrameBatch, LidarColumns, Measurement
from depthreg.rendering import Camera, Embree, Renderer, Rig
from depthreg.sensors.misalignment import REFERENCE_WIDTH_PX, fit_affine, margin_for
from depthreg.sensors.simulator import SensorSimulator, frame_generators, simulate_each
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


@dataclass(frozen=True)
class FixedCamera:
    """One camera for all frames, where `RandomCamera` draws one for each."""

    camera: Camera

    def __call__(self, rng: np.random.Generator) -> Camera:
        """Always the same."""
        return self.camera


class SyntheticFrames(Dataset[dict[str, Any]]):
    """Frames of one world; item i is a function of (world, camera, rig, seed, renderer, i) alone.

    Args:
        world: Builds the scene of (seed, index).
        camera: Draws the camera.
        rig: What else to render, as the sensor simulator needs it.
        seed: First number of every scene; training and validation take different ones.
        count: How many frames.
        max_depth_m: Depth beyond this is unknown (0), as beyond any scanner's range.
        cache_dir: Folder that keeps rendered frames; None renders each time.
        renderer: Renders them; Embree where not given.
    """

    def __init__(
        self,
        world: Callable[[int, int], Scene],
        camera: Callable[[np.random.Generator], Camera],
        rig: Rig,
        seed: int,
        count: int,
        max_depth_m: float,
        cache_dir: Path | None = None,
        renderer: Renderer | None = None,
    ) -> None:
        self.world, self.camera, self.rig, self.seed, self.count = world, camera, rig, seed, count
        self.max_depth_m, self.renderer = max_depth_m, renderer or Embree()
        recipe = repr((world, camera, rig, seed, max_depth_m, self.renderer)).encode()
        recipe += code_of("worlds", "rendering", "sensors")
        self.folder = cache_dir / hashlib.sha256(recipe).hexdigest()[:16] if cache_dir else None

    def __len__(self) -> int:
        return self.count

    def frame(self, index: int) -> Frame:
        """Render frame `index`, with what the rig needs in it."""
        return self.look(self.world(self.seed, index), index)

    def look(self, scene: Scene, index: int) -> Frame:
        """Render frame `index`, whose scene is there already."""
        camera = self.camera(np.random.default_rng([self.seed, index, 1]))
        rng, rig = np.random.default_rng([self.seed, index, 2]), self.rig
        return self.renderer(
            scene,
            camera,
            rig.scans[rng.integers(len(rig.scans))].started(rng) if rig.scans else None,
            right=rig.right or bool(rig.matchers),
            rgb_from_depth=rig.offset(rng) if rig.offset else None,
        )

    def __getitem__(self, index: int) -> dict[str, Any]:
        """What the simulator needs of a frame, as NumPy arrays; see `collate_frames`."""
        if not 0 <= index < self.count:
            raise IndexError(index)
        if self.folder is None:
            return {**self._packed(index), "index": index}
        path = self.folder / f"{index:06d}.npz"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as temporary:  # several workers may fill one cache
                np.savez(temporary, **self._packed(index))  # type: ignore[arg-type]
        with np.load(path) as arrays:
            return {**{key: arrays[key] for key in arrays.files}, "index": index}

    def _packed(self, index: int) -> dict[str, np.ndarray]:
        return pack(self.frame(index), self.rig, pack_rng(self.seed, index), self.max_depth_m)


def pack_rng(seed: int, index: int) -> np.random.Generator:
    """What `pack` draws from for frame `index`, whether it is rendered now or was long ago."""
    return np.random.default_rng([seed, index, 3])


def pack(frame: Frame, rig: Rig, rng: np.random.Generator, max_depth_m: float) -> dict[str, np.ndarray]:
    """What the sensor simulator needs of a frame, under the names of `FrameBatch` and without its batch axis.

    Args:
        frame: Holds all that the rig asks for.
        rig: What the simulator needs.
        rng: For matchers.
        max_depth_m: Depth beyond this becomes unknown (0).
    """
    lidar = frame.lidar
    item: dict[str, Any] = {"rgb": frame.rgb, "intrinsics": frame.intrinsics}
    item["depth_m"] = np.where(frame.depth_m > max_depth_m, 0, frame.depth_m)
    item["baseline_m"] = np.float32(frame.baseline_m)
    columns = (getattr(lidar, name) for name in LidarColumns._fields[2:-3])
    item["lidar"] = np.column_stack([lidar.uv_px, *columns, lidar.ray]).astype(np.float32)
    if rig.surfaces:
        item |= {"normal": frame.normal, "albedo": frame.albedo, "gloss": frame.gloss}
    if rig.matchers:
        item["disparity_px"] = rig.matchers[rng.integers(len(rig.matchers))](frame, rng)
    if frame.offset:
        affine, parallax_px = fit_affine(item["depth_m"], frame.intrinsics, frame.offset.rgb_from_depth)
        item |= {"offset_rgb": frame.offset.rgb, "offset_affine_rgb_from_depth": affine}
        item["offset_parallax_px"] = np.float32(parallax_px)
    return item


_CHANNELS_LAST = ("rgb", "normal", "offset_rgb")  # (H, W, C) as NumPy and OpenCV have it
_PLANES = ("depth_m", "albedo", "gloss", "disparity_px")  # (H, W)


def code_of(*packages: str) -> bytes:
    """Source text of our packages: a cached frame belongs to the code that rendered it."""
    root = Path(__file__).parents[1]
    return b"".join(path.read_bytes() for package in packages for path in sorted((root / package).glob("*.py")))


def collate_frames(items: Sequence[dict[str, Any]]) -> FrameBatch:
    """Stack items; returns are padded with zeros (range 0) to the longest list."""
    longest = max(len(item["lidar"]) for item in items)
    lidar = torch.zeros(len(items), longest, len(LidarColumns._fields))
    for row, item in zip(lidar, items, strict=True):
        row[: len(item["lidar"])] = torch.from_numpy(item["lidar"])
    batch = {"lidar": lidar}
    for key in items[0].keys() - {"lidar"}:
        stacked = torch.from_numpy(np.stack([item[key] for item in items]))
        if key in _CHANNELS_LAST:
            stacked = stacked.permute(0, 3, 1, 2).contiguous()
        batch[key] = stacked[:, None] if key in _PLANES else stacked
    return cast(FrameBatch, batch)


class SyntheticMeasurements(Dataset[Measurement]):
    """Simulated measurements of frames, each a function of its index alone; items have no batch axis.

    Args:
        frames: What perfect instruments see.
        simulator: Turns it into what real instruments report.
        difficulty: In [0, 1].
        seed: First number of every draw.
    """

    def __init__(
        self, frames: Dataset[dict[str, Any]], simulator: SensorSimulator, difficulty: float, seed: int
    ) -> None:
        self.frames, self.simulator, self.difficulty, self.seed = frames, simulator, difficulty, seed

    def __len__(self) -> int:
        return len(cast(Sized, self.frames))

    def __getitem__(self, index: int) -> Measurement:
        batch = collate_frames([self.frames[index]])
        measured = simulate_each(self.simulator, batch, self.difficulty, frame_generators(batch, self.seed))
        return Measurement(**{key: value[0] for key, value in measured.items()}, name=f"{index:06d}")  # type: ignore[typeddict-item, index]
