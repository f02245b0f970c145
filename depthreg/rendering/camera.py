"""Where the rays of a camera and of a rotating LiDAR go."""

from dataclasses import dataclass

import numpy as np

from depthreg.errors import InputError


@dataclass(frozen=True)
class Camera:
    """Pinhole camera whose colour image may reach beyond the frame on all sides.

    Attributes:
        width: Columns of the frame, without margin.
        height: Rows of the frame, without margin.
        focal_px: Focal length, pixels.
        center_px: Principal point (column, row) in the frame; its middle where not given.
        margin_px: How far the colour image reaches beyond the frame on each side.
        baseline_m: Distance to the right camera of the rectified pair; the scene's where not given.

    Raises:
        InputError: A size or the focal length isn't positive, or the margin is negative.
    """

    width: int
    height: int
    focal_px: float
    center_px: tuple[float, float] | None = None
    margin_px: int = 0
    baseline_m: float | None = None

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.focal_px) <= 0 or self.margin_px < 0:
            raise InputError(f"A camera needs a positive width, height and focal_px and no negative margin_px: {self}.")

    @property
    def intrinsics(self) -> np.ndarray:
        """K of the frame without margin, (3, 3) float32."""
        u, v = self.center_px or ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.array([[self.focal_px, 0, u], [0, self.focal_px, v], [0, 0, 1]], dtype=np.float32)

    def rays(self, border_px: int = 0) -> np.ndarray:
        """Directions through the pixel centres of the frame and a border round it.

        Returns:
            (H + 2 border, W + 2 border, 3) float32 in camera coordinates; z = 1, so lengths along them are z-depths.
        """
        u, v = self.center_px or ((self.width - 1) / 2, (self.height - 1) / 2)
        x = (np.arange(-border_px, self.width + border_px) - u) / self.focal_px
        y = (np.arange(-border_px, self.height + border_px) - v) / self.focal_px
        rays = np.ones((len(y), len(x), 3), dtype=np.float32)
        rays[..., 0] = x
        rays[..., 1] = y[:, None]
        return rays


@dataclass(frozen=True)
class ScanPattern:
    """The beams of a rotating LiDAR.

    Attributes:
        elevations_deg: Angle of each laser above the horizon; ring 0 is the highest.
        azimuth_step_deg: Angle between two firings of the same laser.
        max_range_m: Farthest return.
    """

    elevations_deg: tuple[float, ...]
    azimuth_step_deg: float
    max_range_m: float = 120.0

    @classmethod
    def hdl64(cls) -> "ScanPattern":
        """Velodyne HDL-64E at 10 Hz: 32 lasers over +1.97..-8.5 deg, 32 over -8.9..-24.9 deg."""
        elevations = (*np.linspace(1.97, -8.5, 32), *np.linspace(-8.9, -24.9, 32))
        return cls(tuple(float(e) for e in elevations), azimuth_step_deg=0.1728)

    def rays(self, min_azimuth_deg: float, max_azimuth_deg: float) -> tuple[np.ndarray, np.ndarray]:
        """Unit directions of all firings between two azimuths (0 = forward, positive = left).

        Firings lie at whole multiples of the step, whatever the limits.

        Returns:
            Directions (N, 3) float32 in LiDAR coordinates (x forward, y left, z up) and ring numbers (N,) int16.
        """
        first = np.ceil(min_azimuth_deg / self.azimuth_step_deg)
        steps = np.arange(first, np.floor(max_azimuth_deg / self.azimuth_step_deg) + 1)
        azimuth = np.deg2rad(steps * self.azimuth_step_deg)
        elevation = np.deg2rad(np.asarray(self.elevations_deg))[:, None]
        shape = (len(elevation), len(azimuth))
        rays = np.empty((*shape, 3), dtype=np.float32)
        rays[..., 0] = np.cos(elevation) * np.cos(azimuth)
        rays[..., 1] = np.cos(elevation) * np.sin(azimuth)
        rays[..., 2] = np.sin(elevation)
        ring = np.repeat(np.arange(len(elevation), dtype=np.int16), len(azimuth))
        return rays.reshape(-1, 3), ring


def hdl64() -> ScanPattern:
    """Velodyne HDL-64E at 10 Hz: the scanner of KITTI."""
    return ScanPattern.hdl64()


SCANNERS: dict[str, ScanPattern] = {"hdl64": hdl64()}  # by the names that configurations use
