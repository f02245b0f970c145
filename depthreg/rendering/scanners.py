"""Where the beams of LiDARs go: tables of beams, and the firings of one sweep.

LiDAR coordinates: x forward, y left, z up. Azimuth 0 is forward, positive to the left; ring 0 is the highest beam.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from depthreg.errors import InputError


class Firings(NamedTuple):
    """The laser pulses of one sweep, on a grid of R rings and C columns; LiDAR coordinates."""

    rays: np.ndarray  # (R, C, 3) float32, unit directions in which the pulses go
    slip_rad: np.ndarray  # (R, C) float32, how far to the left of them the scanner believes that they went
    up_m: np.ndarray  # (R,) float32, height of each laser above the LiDAR's origin
    time_s: np.ndarray  # (R, C) float32, since the moment when the camera takes its picture


@dataclass(frozen=True)
class ScanPattern:
    """The beams of a LiDAR that sweeps over azimuth.

    Attributes:
        elevations_deg: Angle of each laser above the horizon, the highest first.
        azimuth_step_deg: Angle between two firings of the same laser.
        max_range_m: Farthest return.
        min_range_m: Nearest return.
        divergence_mrad: Full angle of a beam.
        azimuth_offsets_deg: How far each laser points to the left of the sweep's azimuth; none for a scanner whose
            columns line up.
        laser_up_m: How far each laser sits above the LiDAR's origin; none for a scanner whose lasers share a centre.
        azimuth_tick_deg: Azimuths are reported in whole ticks of the encoder (plus the laser's offset); 0 = exact.
        view_deg: Horizontal field of view, centred forward.
        sweep_s: Time for a full turn (or for the whole field of view).
        raster: Whether it fires row after row, from the top, instead of column after column.
        motion_residual: Share of the vehicle's motion during the sweep that the reported points still carry: 1 = as
            fired, 0 = wholly compensated. Data sets that people use compensate for it (KITTI's odometry and depth), and
            a driver that does so knows the speed to a few per cent.
        start: Phase of the sweep's first firing, in steps, [0, 1). Free-running scanners never fire twice at the same
            azimuths; see `started`.

    Raises:
        InputError: A table doesn't fit the lasers, or a number can't be meant.
    """

    elevations_deg: tuple[float, ...]
    azimuth_step_deg: float
    max_range_m: float = 120.0
    min_range_m: float = 0.9
    divergence_mrad: float = 2.0
    azimuth_offsets_deg: tuple[float, ...] = ()
    laser_up_m: tuple[float, ...] = ()
    azimuth_tick_deg: float = 0.0
    view_deg: float = 360.0
    sweep_s: float = 0.1
    raster: bool = False
    motion_residual: float = 0.05
    start: float = 0.0

    def __post_init__(self) -> None:
        lasers = len(self.elevations_deg)
        for name in ("azimuth_offsets_deg", "laser_up_m"):
            if len(getattr(self, name)) not in (0, lasers):
                raise InputError(
                    f"{name} has {len(getattr(self, name))} entries for {lasers} lasers: one each or none."
                )
        if not lasers or list(self.elevations_deg) != sorted(self.elevations_deg, reverse=True):
            raise InputError(f"elevations_deg must name at least one laser, the highest first: {self.elevations_deg}.")
        if not (self.azimuth_step_deg > 0 and 0 < self.min_range_m < self.max_range_m and 0 < self.view_deg <= 360):
            raise InputError(f"A scanner needs a positive step, range limits and a view of up to 360 degrees: {self}.")
        if min(self.divergence_mrad, self.azimuth_tick_deg, self.sweep_s) < 0 or not 0 <= self.motion_residual <= 1:
            raise InputError(f"Divergence, tick and sweep must not be negative, motion_residual in [0, 1]: {self}.")

    def started(self, rng: np.random.Generator) -> "ScanPattern":
        """The same scanner, its sweep starting at a random phase."""
        return replace(self, start=float(rng.random()))

    def firings(self, min_azimuth_deg: float = -180.0, max_azimuth_deg: float = 180.0) -> Firings:
        """All firings of a sweep whose azimuth lies between two limits, before the lasers' own offsets.

        Firings lie `start` steps beyond whole multiples of the step, whatever the limits.
        """
        low, high = max(min_azimuth_deg, -self.view_deg / 2), min(max_azimuth_deg, self.view_deg / 2)
        first = np.ceil(low / self.azimuth_step_deg - self.start)
        steps = np.arange(first, np.floor(high / self.azimuth_step_deg - self.start) + 1) + self.start
        offsets_deg = self._table(self.azimuth_offsets_deg)[:, None]
        # A laser that is turned by so many steps looks there so many firings earlier: the grid stays the same.
        earlier = np.rint(offsets_deg / self.azimuth_step_deg)
        azimuth_deg = (steps - earlier) * self.azimuth_step_deg  # (R, C)
        stated_deg = azimuth_deg
        if self.azimuth_tick_deg:
            stated_deg = (np.floor(azimuth_deg / self.azimuth_tick_deg) + 0.5) * self.azimuth_tick_deg
        lasers = len(self.elevations_deg)
        turn = np.arange(lasers)[:, None] / lasers - 0.5 if self.raster else azimuth_deg / self.view_deg
        return Firings(
            rays=_directions(
                np.asarray(self.elevations_deg),
                (offsets_deg - earlier * self.azimuth_step_deg)[:, 0],
                steps * self.azimuth_step_deg,
            ),
            slip_rad=np.deg2rad(stated_deg - azimuth_deg).astype(np.float32),
            up_m=self._table(self.laser_up_m).astype(np.float32),
            time_s=np.broadcast_to(self.sweep_s * turn, (lasers, len(steps))).astype(np.float32),
        )

    def _table(self, values: tuple[float, ...]) -> np.ndarray:
        return np.asarray(values or np.zeros(len(self.elevations_deg)))


def _directions(elevation_deg: np.ndarray, offset_deg: np.ndarray, azimuth_deg: np.ndarray) -> np.ndarray:
    """Unit vectors (R, C, 3) float32 of rings (R,) and columns (C,)."""
    elevation, offset, azimuth = (np.deg2rad(angle) for angle in (elevation_deg, offset_deg, azimuth_deg))
    # Planes of x, y and z lie apart in memory, where NumPy is quick.
    rays = np.moveaxis(np.empty((3, len(elevation), len(azimuth)), np.float32), 0, -1)
    # By the addition theorem, a few sines do for the whole grid.
    along, across = np.cos(elevation) * np.cos(offset), np.cos(elevation) * np.sin(offset)
    rays[..., 0] = np.outer(along, np.cos(azimuth)) - np.outer(across, np.sin(azimuth))
    rays[..., 1] = np.outer(along, np.sin(azimuth)) + np.outer(across, np.cos(azimuth))
    rays[..., 2] = np.sin(elevation)[:, None]
    return rays


def _spread(first: float, last: float, count: int) -> tuple[float, ...]:
    """Evenly spread numbers."""
    return tuple(float(value) for value in np.linspace(first, last, count))


def _scattered(count: int, most_deg: float) -> tuple[float, ...]:
    """Azimuth offsets, as good as random, the same in every run.

    Real lasers are turned by up to some degrees, in every unit differently, which its calibration file states. It shows
    in two ways: columns of neighbouring rings stand at no fixed phase from each other, as multiples of a number would,
    and the encoder's ticks make gaps at other azimuths in every ring, which would else run through all of them.
    """
    return tuple(np.random.default_rng(count).uniform(-most_deg, most_deg, count).tolist())


# Of the HDL-64E in KITTI's car. Slopes of z against horizontal range, ring by ring, in the 14 scans of its object
# benchmark that were looked at (they agree to 0.001 deg); the lowest nine rings never reach the camera's image and are
# spread down to the data sheet's last angle.
_KITTI_ELEVATIONS_DEG = (
    1.937, 1.574, 1.305, 0.872, 0.579, 0.181, -0.089, -0.452, -0.803, -1.201, -1.494, -1.833, -2.208, -2.547, -2.874,
    -3.236, -3.539, -3.936, -4.216, -4.588, -4.914, -5.251, -5.611, -5.958, -6.329, -6.676, -6.999, -7.287, -7.679,
    -8.058, -8.310, -8.712,
    -9.026, -9.573, -10.063, -10.471, -10.957, -11.599, -12.115, -12.562, -13.041, -13.485, -14.048, -14.598, -15.189,
    -15.657, -16.177, -16.554, -17.186, -17.730, -18.322, -18.795, -19.317, -19.734, -20.374,
    *_spread(-20.9, -24.9, 9),
)  # fmt: skip


def hdl64() -> ScanPattern:
    """Velodyne HDL-64E as in KITTI's car.

    From the data sheet: 32 lasers about 1/3 deg apart above 32 that are about 1/2 deg apart; 0.1728 deg between firings
    at 10 turns a second; 2 mrad. From KITTI's recordings: the lasers' angles; it turns 9.65 times a second; z against
    horizontal range is a line for each ring (residual 0.3 mm), so the upper block's lasers sit 0.209 to 0.198 m above
    the origin that the calibration speaks of and the lower block's 0.125 to 0.119 m; azimuths come in ticks of
    0.09 deg; no return lies beyond 80 m (the data sheet has 120 m).
    """
    turns_per_s = 9.65
    step_deg = 0.01728 * turns_per_s
    return ScanPattern(
        elevations_deg=_KITTI_ELEVATIONS_DEG,
        azimuth_step_deg=step_deg,
        max_range_m=80.0,
        azimuth_offsets_deg=_scattered(64, most_deg=5.0),
        laser_up_m=_spread(0.209, 0.198, 32) + _spread(0.125, 0.119, 32),
        azimuth_tick_deg=0.09,
        sweep_s=1 / turns_per_s,
    )


def _interleaved(lasers: int, between_deg: float) -> tuple[float, ...]:
    """Azimuth offsets of lasers that fire one after the other, from below: lower and upper half take turns."""
    half = lasers // 2
    upper = [2 * (half - 1 - ring) + 1 for ring in range(half)]
    return tuple(between_deg * turn for turn in (*upper, *(turn - 1 for turn in upper)))


def hdl32() -> ScanPattern:
    """Velodyne HDL-32E: +10.67..-30.67 deg in steps of 4/3 deg, up to 100 m (user manual); 2.79 mrad.

    A cycle takes 46.08 us, 0.1659 deg at 10 turns a second; its lasers fire 1.152 us apart.
    """
    step_deg = 3600 * 46.08e-6
    return ScanPattern(
        elevations_deg=_spread(10.67, -30.67, 32),
        azimuth_step_deg=step_deg,
        max_range_m=100.0,
        divergence_mrad=2.79,
        azimuth_offsets_deg=_interleaved(32, 3600 * 1.152e-6),
    )


def vlp16() -> ScanPattern:
    """Velodyne VLP-16: +15..-15 deg in steps of 2 deg, up to 100 m (user manual); 3 mrad.

    A cycle takes 55.296 us, 0.1991 deg at 10 turns a second; its lasers fire 2.304 us apart.
    """
    return ScanPattern(
        elevations_deg=_spread(15, -15, 16),
        azimuth_step_deg=3600 * 55.296e-6,
        max_range_m=100.0,
        divergence_mrad=3.0,
        azimuth_offsets_deg=_interleaved(16, 3600 * 2.304e-6),
    )


def os1(lines: int, columns: int) -> ScanPattern:
    """Ouster OS1, second generation: `lines` beams evenly over +-22.5 deg, `columns` a turn that line up.

    Data sheet: 120 m at 80 % reflectivity, 0.8 m at least, 0.18 deg (FWHM) of divergence.
    """
    return ScanPattern(_spread(22.5, -22.5, lines), 360 / columns, 120.0, min_range_m=0.8, divergence_mrad=3.14)


def solid_state() -> ScanPattern:
    """A raster of 120 x 25 deg in steps of 0.2 deg: the class of RoboSense's M1 (MEMS mirror, 126 lines, 200 m).

    Chosen over Livox' rosettes because most forward-looking scanners in production are rasters (M1, AT128, Innoviz).
    In the real one, rows bend and break where five mirrors' fields meet; here they are straight.
    """
    return ScanPattern(
        elevations_deg=_spread(12.5, -12.5, 126),
        azimuth_step_deg=0.2,
        max_range_m=200.0,
        min_range_m=0.5,
        divergence_mrad=1.7,
        view_deg=120.0,
        raster=True,
    )


SCANNERS: dict[str, ScanPattern] = {  # by the names that configurations use
    "hdl64": hdl64(),
    "hdl32": hdl32(),
    "vlp16": vlp16(),
    "os1_64": os1(64, 1024),
    "os1_128": os1(128, 2048),
    "solid_state": solid_state(),
}
