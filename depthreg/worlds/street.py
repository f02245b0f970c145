"""The line that a street follows, and everything that runs along it with a constant cross-section."""

from dataclasses import dataclass

import numpy as np
import trimesh

_STEP_M = 4.0  # sweeps follow the line in steps of this length
_RUN_OUT_M = 30.0  # the line goes on this far beyond where things stand


@dataclass(frozen=True)
class Street:
    """A curved, sloping line on which positions are (metres along, metres to the right of it, metres above it).

    Attributes:
        along_m: Where the line is sampled, (S,), ascending.
        xyz_m: The line's points in the world, (S, 3).
        heading_rad: Its direction, counter-clockwise from the world's y axis, (S,).
    """

    along_m: np.ndarray
    xyz_m: np.ndarray
    heading_rad: np.ndarray

    @property
    def ahead_m(self) -> float:
        """How far ahead things stand: a little less far than the road goes."""
        return float(self.along_m[-1]) - _RUN_OUT_M

    @property
    def behind_m(self) -> float:
        """Where things begin, behind the camera (negative): they still throw shadows into the picture."""
        return float(self.along_m[0]) + _RUN_OUT_M

    @classmethod
    def winding(cls, curvature_per_m: float, bend_m: float, slope: float, behind_m: float, ahead_m: float) -> "Street":
        """A line that leaves the world's origin along y, then bends and climbs.

        Args:
            curvature_per_m: Largest curvature; positive bends to the left.
            bend_m: The curvature swings as cos(along / bend_m).
            slope: Largest gradient, reached about 100 m ahead.
            behind_m: Where things begin to stand along it (negative).
            ahead_m: Up to where they stand.
        """
        along = np.arange(behind_m - _RUN_OUT_M, ahead_m + _RUN_OUT_M + 1.0)
        heading = curvature_per_m * bend_m * np.sin(along / bend_m)
        x, y = -np.cumsum(np.sin(heading)), np.cumsum(np.cos(heading))
        z = slope * np.where(along > 0, along**2 / (along + 60.0), 0)  # level where the camera stands
        origin = np.searchsorted(along, 0.0)
        return cls(along, np.stack([x - x[origin], y - y[origin], z], axis=1), heading)

    def points(self, along_m: np.ndarray, right_m: np.ndarray, up_m: np.ndarray) -> np.ndarray:
        """World points (..., 3) of positions on the street; the arguments broadcast."""
        heading = np.interp(along_m, self.along_m, self.heading_rad)
        x, y, z = (np.interp(along_m, self.along_m, self.xyz_m[:, k]) for k in range(3))
        return np.stack(
            np.broadcast_arrays(x + right_m * np.cos(heading), y + right_m * np.sin(heading), z + up_m), axis=-1
        )

    def stand(self, along_m: float, right_m: float, up_m: float = 0.0) -> tuple[tuple[float, float, float], float]:
        """World position and yaw (deg) of something that stands beside the line and looks along it."""
        x, y, z = self.points(np.float64(along_m), np.float64(right_m), np.float64(up_m))
        yaw_deg = np.rad2deg(np.interp(along_m, self.along_m, self.heading_rad))
        return (float(x), float(y), float(z)), float(yaw_deg)

    def sweep(self, profile: list[tuple[float, float]], start_m: float, stop_m: float) -> trimesh.Trimesh:
        """The surface that a cross-section leaves when it runs along the line.

        Args:
            profile: Corners (metres to the right, metres up) from left to right, so that faces look up and outwards.
            start_m: Where along the line the surface starts.
            stop_m: Where it stops.
        """
        steps = max(int(np.ceil((stop_m - start_m) / _STEP_M)), 1) + 1
        along = np.linspace(start_m, stop_m, steps)[:, None]
        right, up = np.array(profile).T
        vertices = self.points(along, right, up).reshape(-1, 3)
        return trimesh.Trimesh(vertices, _grid_faces(steps, len(profile)), process=False)

    def dashes(
        self, right_m: float, width_m: float, up_m: float, starts_m: np.ndarray, length_m: float
    ) -> trimesh.Trimesh:
        """A row of flat dashes, each `length_m` long, centred `right_m` to the right of the line."""
        along = np.add.outer(starts_m, np.array([0.0, length_m]))[..., None]  # (D, 2, 1)
        right = right_m + np.array([-0.5, 0.5]) * width_m
        vertices = self.points(along, right, np.full(2, up_m)).reshape(-1, 3)
        faces = _grid_faces(2, 2) + 4 * np.arange(len(starts_m))[:, None, None]
        return trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    """Triangles (F, 3) between the points of a grid that are numbered row by row; counter-clockwise from above."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, ahead = corner + 1, corner + columns
    return np.concatenate([np.stack([corner, right, ahead], 1), np.stack([right, ahead + 1, ahead], 1)])
