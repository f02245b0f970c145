"""What a model made of colour and depth: arrays, a coloured cloud, a picture, files."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, cast

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from depthreg.data import io
from depthreg.data.sample import Measurement
from depthreg.geometry import decompose_affine, unproject, warp_affine
from depthreg.networks import JointOutput
from depthreg.viz import sample_panel, to_picture

Array = TypeVar("Array", np.ndarray, Tensor)
NEAR_ENOUGH = 0.05  # a depth within this share of the truth counts as right


def chance_near(log_error: Tensor) -> Tensor:
    """How likely a depth is within 5 % of the truth, by the expected error of its logarithm, taken to be Laplacian."""
    return 1 - (-math.log1p(NEAR_ENOUGH) / log_error.clamp(min=1e-6)).exp()


class PointCloud(NamedTuple):
    """Coloured points in the camera's coordinates: x to the right, y down, z forward."""

    points_m: np.ndarray  # (N, 3) float32
    rgb: np.ndarray  # (N, 3) uint8


@dataclass(frozen=True)
class Layout:
    """How a user has arrays, so that answers come back the same way."""

    numpy: bool  # else torch, on the model's device
    single: bool  # else a batch
    channel: bool  # whether depth has an axis for its one channel
    integer: bool  # whether colour is uint8, else float in [0, 1]

    @classmethod
    def of(cls, rgb: np.ndarray | Tensor, depth_m: np.ndarray | Tensor) -> "Layout":
        """That of colour and depth."""
        single, integer = rgb.ndim == 3, rgb.dtype in (np.uint8, torch.uint8)
        return cls(isinstance(rgb, np.ndarray), single, depth_m.ndim == rgb.ndim, integer)

    def colour(self, rgb: Tensor) -> Any:
        """Colour (B, 3, H, W) in [0, 1] as the user has it."""
        rgb = (255 * rgb.clamp(0, 1)).round().byte() if self.integer else rgb
        return self.plain(rgb.movedim(1, -1).contiguous() if self.numpy else rgb)

    def depth(self, depth: Tensor) -> Any:
        """A map (B, 1, H, W) as the user has depth."""
        return self.plain(depth if self.channel else depth[:, 0])

    def plain(self, values: Tensor) -> Any:
        """Whatever has a batch axis, without it for a single frame."""
        values = values[0] if self.single else values
        return values.cpu().numpy() if self.numpy else values


class Result(Generic[Array]):
    """Registered colour and completed depth, of one frame or of a batch.

    Arrays are as the user gave them: NumPy or torch, with the same axes, colour of the same type. A batch has a length,
    and `result[i]` is a frame of it; clouds, pictures and files are of a frame.

    Args:
        sample: What was measured, as a batch.
        output: What a network made of it.
        layout: How the user has arrays.
    """

    def __init__(self, sample: Measurement, output: JointOutput, layout: Layout) -> None:
        self._sample, self._output, self._layout = sample, output, layout

    @property
    def rgb(self) -> Array:
        """Colour as it was given."""
        return self._layout.colour(self._sample["rgb"])

    @property
    def sparse_depth_m(self) -> Array:
        """Depth as it was given, float32, 0 where there is none."""
        return self._layout.depth(self._sample["depth_m"])

    @property
    def K(self) -> Array | None:
        """The camera matrix as it was given, (3, 3) or (B, 3, 3); None without one."""
        return self._layout.plain(self._sample["intrinsics"]) if "intrinsics" in self._sample else None

    @property
    def depth_m(self) -> Array:
        """Dense z-depth in metres, float32, shaped as the sparse depth."""
        return self._layout.depth(self._output.depth_m)

    @property
    def rgb_aligned(self) -> Array:
        """Colour on the depth's grid, 0 where the colour image doesn't reach; shaped as the colour, and of its type."""
        return self._layout.colour(self._output.rgb_aligned)

    @property
    def affine_rgb_from_depth(self) -> Array:
        """A in pixels, (2, 3) or (B, 2, 3): rgb_aligned[y, x] = rgb[A @ (x, y, 1)], centres at integers."""
        return self._layout.plain(self._output.affine_rgb_from_depth)

    @property
    def trust(self) -> Array:
        """How likely the affine is right, in [0, 1], () or (B,); 1 from a network that can't tell."""
        return self._layout.plain(self._output.trust)

    @property
    def confidence(self) -> Array:
        """How likely each depth is within 5 % of the truth, in [0, 1], shaped as it; NaN if the network can't tell.

        See `chance_near`.
        """
        return self._layout.depth(self._confidence())

    @property
    def expected_error_m(self) -> Array:
        """How far off each depth may be expected to be, in metres, shaped as it; NaN if the network can't tell."""
        return self._layout.depth(self._output.depth_m * self._output.log_error)

    def _confidence(self) -> Tensor:
        return chance_near(self._output.log_error)

    def __len__(self) -> int:
        if self._layout.single:
            raise TypeError("this result is of a single frame: it has no length")
        return len(self._output.depth_m)

    def __getitem__(self, index: int) -> "Result[Array]":
        """A frame of a batch."""
        index = range(len(self))[index]  # IndexError beyond it, as a list has it
        part = slice(index, index + 1)
        sample = cast(Measurement, {key: cast(Tensor, value)[part] for key, value in self._sample.items()})
        tensors: dict[str, Any] = {
            name: value[part] for name, value in self._output._asdict().items() if isinstance(value, Tensor)
        }
        return Result(sample, self._output._replace(**tensors), replace(self._layout, single=True))

    def __iter__(self) -> "Iterator[Result[Array]]":
        return (self[index] for index in range(len(self)))

    def describe(self) -> dict[str, float]:
        """What happened to a frame, in numbers that say their unit."""
        depth_m, output = self._frame()["depth_m"], self._output
        height, width = depth_m.shape[-2:]
        moves = decompose_affine(output.affine_rgb_from_depth[0], (height, width))
        x_px, y_px = moves["translation_px"].tolist()
        return {
            "width": width,
            "height": height,
            "returns_percent": 100 * (depth_m > 0).float().mean().item(),
            "x_px": x_px,
            "y_px": y_px,
            "rotation_deg": moves["rotation_deg"].item(),
            "scale_percent": 100 * (moves["scale"].item() - 1),
            "trust": output.trust[0].item(),
            "nearest_m": output.depth_m.min().item(),
            "farthest_m": output.depth_m.max().item(),
        }

    def __repr__(self) -> str:
        if not self._layout.single:
            return f"<depthreg.Result of {len(self)} frames>"
        text = (
            "<depthreg.Result: {width}x{height}, colour was off by ({x_px:+.1f}, {y_px:+.1f}) px, "
            "{rotation_deg:+.2f} deg, {scale_percent:+.2f} % (trust {trust:.2f}); "
            "depth {nearest_m:.2f} to {farthest_m:.2f} m>"
        )
        return text.format(**self.describe())

    def point_cloud(self, min_confidence: float = 0.0) -> PointCloud:
        """The completed depth as points, where it has a colour and can be believed.

        Believable is what lies between the returns: inside their convex hull in the image and within their range of
        depths, give or take 5 %. The sky above a LiDAR's highest beam is not.

        Args:
            min_confidence: Leave out what the network believes less, see `confidence`; one that can't tell leaves
                nothing out.

        Raises:
            ValueError: The model wasn't given K, or this is a batch.
        """
        sample = self._frame()
        if "intrinsics" not in sample:
            raise ValueError("a point cloud needs the camera matrix: expected model(rgb, depth_m, K)")
        sparse_m, completed_m = sample["depth_m"][0, 0], self._output.depth_m[0, 0]
        returns_m = sparse_m[sparse_m > 0]
        kept = (completed_m >= 0.95 * returns_m.min()) & (completed_m <= 1.05 * returns_m.max())
        kept &= warp_affine(sample["rgb"], self._output.affine_rgb_from_depth)[1][0, 0]
        kept &= ~(self._confidence()[0, 0] < min_confidence)  # NaN is kept
        mask = kept.cpu().numpy() & _hull(sparse_m.cpu().numpy() > 0)
        points_m = unproject(completed_m.cpu(), sample["intrinsics"][0]).numpy()
        return PointCloud(points_m[mask], to_picture(self._output.rgb_aligned[0])[mask])

    def figure(self) -> Image.Image:
        """Colour before and after, sparse and completed depth, as a picture that notebooks show."""
        sample = self._frame()
        return Image.fromarray(sample_panel(sample["rgb"], sample["depth_m"], self._output))

    def save(self, folder: str | Path, depth_scale: float = 1000.0) -> None:
        """Write depth.npy, depth.png, confidence.png, rgb_aligned.png, affine.json, panel.png and, with K, cloud.ply.

        Args:
            folder: Made if need be; files of these names in it are replaced.
            depth_scale: Stored value per metre of depth.png; 16 bits end at 65535 / `depth_scale` metres.
        """
        folder, sample, output = Path(folder), self._frame(), self._output
        folder.mkdir(parents=True, exist_ok=True)
        completed_m, affine = output.depth_m[0, 0].cpu().numpy(), output.affine_rgb_from_depth[0].tolist()
        height, width = completed_m.shape
        told = {"affine_rgb_from_depth": affine, "width": width, "height": height, "trust": output.trust[0].item()}
        io.write_npy(folder / "depth.npy", completed_m)
        io.write_depth_png(folder / "depth.png", completed_m, depth_scale)
        io.write_png(folder / "rgb_aligned.png", to_picture(output.rgb_aligned[0]))
        io.write_json(folder / "affine.json", told)
        io.write_png(folder / "panel.png", np.asarray(self.figure()))
        confidence = self._confidence()[0, 0].cpu().numpy()
        if np.isfinite(confidence).all():  # a network that can't tell writes none
            io.write_png(folder / "confidence.png", np.rint(255 * confidence).astype(np.uint8))
        if "intrinsics" in sample:
            io.write_ply(folder / "cloud.ply", *self.point_cloud())

    def _frame(self) -> Measurement:
        """What was measured, of a single frame."""
        if not self._layout.single:
            raise ValueError(f"this result is of {len(self)} frames: expected one of them, result[0]")
        return self._sample


def _hull(mask: np.ndarray) -> np.ndarray:
    """The convex hull of a mask's pixels, (H, W) bool."""
    corners = cv2.convexHull(cv2.findNonZero(mask.astype(np.uint8)))
    return cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), corners, 1) > 0
