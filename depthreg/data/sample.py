"""The data contract: what a frame, a measurement and a batch hold, in which units and on which grid.

Pixel centres lie at integers. Depth is z-depth (along the optical axis) in metres, float32, 0 where there is none;
`range_m` is the length along a ray. Camera coordinates: x right, y down, z forward. `affine_rgb_from_depth` (2, 3) is
in pixels: `rgb[A @ (x, y, 1)]` belongs to `depth_m[y, x]`. Axes: B batch, H rows, W columns, N returns, M margin.
"""

from dataclasses import dataclass
from typing import NamedTuple, NotRequired, TypedDict

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class LidarReturns:
    """Noise-free returns of a scanner that stands beside the camera, as seen in the camera's image.

    Rays start at the LiDAR's own origin, so some returns are hidden from the camera ("see-through" points) and still
    project into the image.
    """

    uv_px: np.ndarray  # (N, 2) float32, column and row in the image without margin; always inside it
    depth_m: np.ndarray  # (N,) float32, z-depth in the camera
    range_m: np.ndarray  # (N,) float32, distance from the LiDAR's origin
    cos_incidence: np.ndarray  # (N,) float32 in [0, 1], 1 = ray hits the surface head-on
    albedo: np.ndarray  # (N,) float32 in [0, 1], diffuse reflectivity
    gloss: np.ndarray  # (N,) float32 in [0, 1], share of the light that a polished surface mirrors away
    far_range_m: np.ndarray  # (N,) float32, where the rest of a beam lands that an edge splits; else = range_m
    near_share: np.ndarray  # (N,) float32 in (0, 1], share of the beam's light that lands at range_m
    ring: np.ndarray  # (N,) int16, laser number, 0 = the highest beam
    far_cos_incidence: np.ndarray  # (N,) float32, of what lies at far_range_m
    far_albedo: np.ndarray  # (N,) float32; 0 where the rest of the beam goes into the sky
    far_gloss: np.ndarray  # (N,) float32
    ray: np.ndarray  # (N, 3) float32, unit, camera axes: a return at another range moves along it


class LidarColumns(NamedTuple):
    """The last axis of `FrameBatch.lidar`, in its order: `LidarColumns(*lidar.unbind(-1)).range_m` is (B, N)."""

    u_px: Tensor
    v_px: Tensor
    depth_m: Tensor
    range_m: Tensor
    cos_incidence: Tensor
    albedo: Tensor
    gloss: Tensor
    far_range_m: Tensor
    near_share: Tensor
    ring: Tensor
    far_cos_incidence: Tensor
    far_albedo: Tensor
    far_gloss: Tensor
    ray_x: Tensor
    ray_y: Tensor
    ray_z: Tensor


@dataclass(frozen=True)
class OffsetView:
    """What a colour camera sees that doesn't stand where the depth camera does: parallax and occlusions included."""

    rgb: np.ndarray  # (H + 2M, W + 2M, 3) uint8, of the depth camera's intrinsics
    rgb_from_depth: np.ndarray  # (4, 4) rigid, from the depth camera's coordinates into the colour camera's


@dataclass(frozen=True)
class Frame:
    """What perfect instruments would see of one scene."""

    rgb: np.ndarray  # (H + 2M, W + 2M, 3) uint8; the margin lets a misaligned view be drawn without black borders
    margin_px: int  # M
    depth_m: np.ndarray  # (H, W) float32, 0 = sky
    object_id: np.ndarray  # (H, W) int32, -1 = sky
    normal: np.ndarray  # (H, W, 3) float32, unit, camera coordinates, facing the camera; 0 in the sky
    albedo: np.ndarray  # (H, W) float32 in [0, 1], diffuse reflectivity, mean over colours; 0 in the sky
    gloss: np.ndarray  # (H, W) float32 in [0, 1], share of the light that a polished surface mirrors away
    intrinsics: np.ndarray  # (3, 3) float32, K of the image without margin
    rgb_right: np.ndarray  # (H, W, 3) uint8, the right camera of a rectified pair; (0, 0, 3) without one
    depth_right_m: np.ndarray  # (H, W) float32, its z-depth; (0, 0) without one
    baseline_m: float  # distance from the left to the right camera
    lidar: LidarReturns
    offset: OffsetView | None = None


class FrameBatch(TypedDict):
    """Frames collated for the sensor simulator, which gets what its `Rig` asks for."""

    rgb: Tensor  # (B, 3, H + 2M, W + 2M) uint8
    depth_m: Tensor  # (B, 1, H, W)
    intrinsics: Tensor  # (B, 3, 3)
    lidar: Tensor  # (B, N, 16): `LidarColumns`; padded with zeros (range 0)
    baseline_m: Tensor  # (B,), from the left to the right camera (or to the projector)
    index: Tensor  # (B,) int64, the sample's number in its data set
    normal: NotRequired[Tensor]  # (B, 3, H, W), unit, camera coordinates; 0 in the sky
    albedo: NotRequired[Tensor]  # (B, 1, H, W) in [0, 1]
    gloss: NotRequired[Tensor]  # (B, 1, H, W) in [0, 1]
    disparity_px: NotRequired[Tensor]  # (B, 1, H, W), a matcher's answer to the rendered pair; 0 where it has none
    offset_rgb: NotRequired[Tensor]  # (B, 3, H + 2M, W + 2M) uint8, seen by a colour camera beside the depth camera
    offset_affine_rgb_from_depth: NotRequired[Tensor]  # (B, 2, 3), least squares over the depth's pixels
    offset_parallax_px: NotRequired[Tensor]  # (B,), RMS distance that this affine leaves


class Measurement(TypedDict, total=False):
    """What real instruments report, with the truth where it is known. Real data enters here too."""

    rgb: Tensor  # (B, 3, H, W) in [0, 1], misaligned
    depth_m: Tensor  # (B, 1, H, W) sparse and noisy
    intrinsics: Tensor  # (B, 3, 3); absent where unknown
    truth_depth_m: Tensor  # (B, 1, H, W), 0 where unknown
    truth_rgb: Tensor  # (B, 3, H, W), colour on the depth's grid; absent where unknown
    truth_affine_rgb_from_depth: Tensor  # (B, 2, 3); absent where unknown
    truth_parallax_px: Tensor  # (B,), RMS distance that the true affine leaves: 0 where the misalignment is an affine
    paired: Tensor  # (B,) bool, whether the colour belongs to the depth at all; absent where all does
    name: list[str]  # for messages and pictures
