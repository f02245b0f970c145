"""An infrared projector that throws pseudo-random dots onto a scene for two cameras, as in Intel's RealSense D400.

Keselman et al. 2017, "Intel RealSense Stereoscopic Depth Cameras": the dots only give the matcher texture; their places
needn't be known. Arrays are (H, W); light is linear and float32.
"""

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from depthreg.data.sample import Frame
from depthreg.errors import InputError

_CELLS = 64  # dots along a side of the tile: farther apart than any search reaches
_TEXELS = 8  # across a cell
_SHADOW_PX = 2.0  # slack of the shadow test, so that slanted surfaces don't shade themselves


@functools.cache
def dot_tile(dot_size: float) -> np.ndarray:
    """One dot at a random place in each cell of a square tile that repeats seamlessly, (512, 512) float32 in [0, 1].

    Args:
        dot_size: Standard deviation of a dot's profile, as a share of a cell.
    """
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:_CELLS, :_CELLS] * _TEXELS + rng.integers(0, _TEXELS, (2, _CELLS, _CELLS))
    tile = np.zeros((_CELLS * _TEXELS, _CELLS * _TEXELS), np.float32)
    tile[row, column] = 1
    sigma = dot_size * _TEXELS
    padded = cv2.GaussianBlur(np.pad(tile, _TEXELS * 2, mode="wrap"), (0, 0), sigma)
    inner = padded[2 * _TEXELS : -2 * _TEXELS, 2 * _TEXELS : -2 * _TEXELS]
    return (inner * np.float32(2 * np.pi * sigma**2)).clip(max=1)


def left_cosine(frame: Frame) -> np.ndarray:
    """Cosine between surfaces and the left camera's rays, (H, W) in [0, 1]; 0 in the sky."""
    x, y = _ray_slopes(frame)
    facing = frame.normal[..., 0] * x + frame.normal[..., 1] * y + frame.normal[..., 2]
    return (-facing / np.sqrt(1 + x**2 + y**2)).clip(0, 1)


def _ray_slopes(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """x / z (1, W) and y / z (H, 1) of a camera's pixels, float32."""
    height, width = frame.depth_m.shape
    focal, (u, v) = frame.intrinsics[0, 0], frame.intrinsics[:2, 2]
    column, row = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    return (column - u)[None] / focal, (row - v)[:, None] / focal


def from_left(values: np.ndarray, frame: Frame, disparity_share: float = 1.0) -> np.ndarray:
    """Values (H, W) of the left image at the right image's points, (H, W) float32; 0 outside and in the sky.

    Where the left camera doesn't see a point, it is the value of what hides it.

    Args:
        values: On the left image's grid.
        frame: Holds the right camera's depth.
        disparity_share: Moves the points by this share of their disparity.
    """
    depth_m = frame.depth_right_m
    reach = np.float32(disparity_share * frame.intrinsics[0, 0] * frame.baseline_m)
    column = np.arange(depth_m.shape[1], dtype=np.float32) + reach / depth_m.clip(1e-3)
    row = np.broadcast_to(np.arange(depth_m.shape[0], dtype=np.float32)[:, None], depth_m.shape)
    return np.where(depth_m > 0, cv2.remap(values.astype(np.float32), column, row, cv2.INTER_LINEAR), 0)


def lit(depth_m: np.ndarray, shift_px: np.ndarray) -> np.ndarray:
    """Which pixels of a camera a projector beside it reaches, bool (H, W).

    Both look along parallel axes and stand on a line along the rows, so a shadow stays in its row: of all points of a
    row that fall into one column of the projector, the light reaches the nearest.

    Args:
        depth_m: z-depth (H, W), 0 = sky.
        shift_px: How far a point's column in the projector lies left of that in the camera, (H, W): focal length times
            the projector's offset to the right, over the depth.
    """
    height, width = depth_m.shape
    reach = int(np.ceil(np.abs(shift_px).max(initial=0))) + 1
    stride = width + 2 * reach + 1
    target = np.arange(width) - shift_px + reach  # column in the projector's buffer, never outside it
    index = np.floor(target).astype(np.int32) + stride * np.arange(height, dtype=np.int32)[:, None]
    nearness = np.abs(shift_px)
    nearest = np.zeros(height * stride, np.float32)
    for neighbour in (0, 1):  # both columns beside the point, or stretched surfaces would let light through
        np.maximum.at(nearest, (index + neighbour).ravel(), nearness.ravel())
    return (depth_m > 0) & (nearness + _SHADOW_PX >= nearest.take(index))


@dataclass(frozen=True)
class Projector:
    """A dot projector on the line between the two cameras' centres.

    Args:
        position: Where it stands, as a share of the way from the left to the right camera.
        dot_spacing_mrad: Mean angle between neighbouring dots.
        dot_size: Standard deviation of a dot's profile, as a share of the spacing.
        ambient: Least and most infrared light from elsewhere, the image's mean, relative to a dot's on a white wall 1 m
            away; drawn uniformly in its logarithm. Lamps give 0.02 to 0.5, the sun 10 and more.
        exposed: Where automatic exposure puts the image's 90th percentile, as a share of the full scale.
        darkest: The least such light that exposure can still lift there, in the unit of `ambient`.
    """

    position: float = 0.5
    dot_spacing_mrad: float = 12.0
    dot_size: float = 0.15
    ambient: tuple[float, float] = (0.02, 0.5)
    exposed: float = 0.4
    darkest: float = 0.02

    def __post_init__(self) -> None:
        object.__setattr__(self, "ambient", tuple(self.ambient))  # a configuration's list has no hash, which rigs need
        low, high = self.ambient
        if not 0 < low <= high:
            raise InputError(f"ambient must be two positive numbers, the smaller first, got {list(self.ambient)}")
        if min(self.dot_spacing_mrad, self.dot_size, self.darkest) <= 0 or not 0 < self.exposed <= 1:
            raise InputError(f"a projector's lengths and lights must be positive, and exposed at most 1, got {self}")

    def __call__(
        self, frame: Frame, left: np.ndarray, right: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Infrared images (H, W) of the scene under dots and other light, exposed.

        Args:
            frame: The scene.
            left, right: The two views under that other light, (H, W), of any scale.
            rng: For the dots' places and the ambient light.
        """
        phase = rng.uniform(0, 1, 2)
        ambient = float(np.exp(rng.uniform(*np.log(self.ambient)))) / max(float(left.mean()), 1e-3)
        # Polish throws the dots away from the cameras.
        returned = frame.albedo * (1 - frame.gloss) * left_cosine(frame)
        base_m, at_m = frame.baseline_m, self.position * frame.baseline_m
        left = ambient * left + returned * self.dots(frame, frame.depth_m, at_m, phase)
        right = ambient * right + from_left(returned, frame) * self.dots(
            frame, frame.depth_right_m, at_m - base_m, phase
        )
        gain = self.exposed / max(float(np.quantile(left[::8, ::8], 0.9)), self.darkest)
        return np.float32(gain) * left, np.float32(gain) * right

    def dots(self, frame: Frame, depth_m: np.ndarray, offset_m: float, phase: np.ndarray) -> np.ndarray:
        """Light that the dots throw, (H, W): 1 at a dot's centre, 1 m away, head-on.

        Args:
            frame: For its intrinsics.
            depth_m: z-depth in the camera that looks, (H, W).
            offset_m: How far the projector stands to the right of that camera.
            phase: Where the pattern starts, (2,) in tiles.
        """
        focal_px = frame.intrinsics[0, 0]
        x, y = _ray_slopes(frame)
        shift_px = np.where(depth_m > 0, np.float32(focal_px * offset_m) / depth_m.clip(1e-3), 0)
        cells_per_rad = 1e3 / self.dot_spacing_mrad
        column, row = (
            np.ascontiguousarray(
                np.broadcast_to(_TEXELS * (cells_per_rad * slope + _CELLS * start), depth_m.shape), np.float32
            )
            for slope, start in ((x - shift_px / focal_px, phase[0]), (y, phase[1]))
        )
        seen = cv2.remap(dot_tile(self.dot_size), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        squared_range = depth_m**2 * (1 + x**2 + y**2)
        return np.where(lit(depth_m, shift_px), seen / squared_range.clip(1e-6), 0)
