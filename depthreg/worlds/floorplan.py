"""Where furniture fits in a rectangular room, and where a camera finds space between it."""

import numpy as np

Pose = tuple[tuple[float, float, float], float]  # where the middle of a piece's back goes, and its yaw in degrees

_GAP_M = 0.03  # between neighbours along a wall
_TRIES = 12


class Floorplan:
    """A room of which parts are taken, x in [0, width] and y in [0, depth].

    Args:
        width_m: Length of the walls along x.
        depth_m: Length of the walls along y.
    """

    def __init__(self, width_m: float, depth_m: float):
        self.width_m, self.depth_m = width_m, depth_m
        self._floor: list[np.ndarray] = []  # x0, y0, x1, y1
        self._walls: list[list[np.ndarray]] = [[], [], [], []]  # along the wall and up: s0, z0, s1, z1

    def along_wall(
        self, rng: np.random.Generator, width: float, depth: float, bottom: float, top: float
    ) -> Pose | None:
        """Take a free stretch of some wall.

        Args:
            rng: Source of the choice.
            width: Along the wall.
            depth: Into the room; takes floor only where the thing stands on it.
            bottom: Height at which the thing begins; 0 stands on the floor.
            top: Height at which it ends.

        Returns:
            Its pose, facing the room; None where nothing was found.
        """
        for _ in range(_TRIES):
            wall = int(rng.integers(4))
            length = self.width_m if wall % 2 == 0 else self.depth_m
            if length < width + 2 * _GAP_M:
                continue
            s = rng.uniform(width / 2 + _GAP_M, length - width / 2 - _GAP_M)
            stretch = np.array([s - width / 2, bottom, s + width / 2, top])
            at, along, inward = self._wall_frame(wall, s)
            ends = np.array([at - along * width / 2, at + along * width / 2 + inward * depth])
            floor = np.concatenate([ends.min(axis=0), ends.max(axis=0)])
            if self._free(stretch, self._walls[wall]) and (bottom > 0 or self._free(floor, self._floor)):
                self._walls[wall].append(stretch)
                if bottom == 0:
                    self._floor.append(floor)
                return (float(at[0]), float(at[1]), bottom), 90.0 * wall
        return None

    def in_the_open(self, rng: np.random.Generator, width: float, depth: float, clearance_m: float) -> Pose | None:
        """Take a free rectangle that keeps clear of everything else; None where nothing was found."""
        for _ in range(_TRIES):
            quarter = int(rng.integers(4))
            half = np.array([width, depth] if quarter % 2 == 0 else [depth, width]) / 2
            room = np.array([self.width_m, self.depth_m]) / 2 - half - clearance_m
            if (room < 0).any():
                continue
            middle = np.array([self.width_m, self.depth_m]) / 2 + rng.uniform(-room, room)
            floor = np.concatenate([middle - half, middle + half])
            if self._free(floor, self._floor, clearance_m):
                self._floor.append(floor)
                back = middle - self._wall_frame(quarter, 0.0)[2] * depth / 2
                return (float(back[0]), float(back[1]), 0.0), 90.0 * quarter
        return None

    def standing_places(self, clearance_m: float, step_m: float = 0.15) -> np.ndarray:
        """Points (N, 2) of the floor this far from all walls and furniture; the freest one where none is."""
        x, y = np.meshgrid(
            np.arange(step_m, self.width_m, step_m), np.arange(step_m, self.depth_m, step_m), indexing="ij"
        )
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        room = np.concatenate([points, np.array([self.width_m, self.depth_m]) - points], axis=1).min(axis=1)
        for x0, y0, x1, y1 in self._floor:
            outside = np.maximum(np.maximum([x0, y0] - points, points - [x1, y1]), 0)
            room = np.minimum(room, np.hypot(*outside.T))
        return points[room >= min(clearance_m, room.max())]

    def _wall_frame(self, wall: int, s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Point at s along a wall, and the directions along it and into the room."""
        corner = np.array([self.width_m * (wall in (1, 2)), self.depth_m * (wall in (2, 3))])
        along = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][wall])
        return corner + s * along, along, np.array([-along[1], along[0]])

    @staticmethod
    def _free(box: np.ndarray, taken: list[np.ndarray], gap_m: float = _GAP_M) -> bool:
        return all((box[2:] + gap_m <= other[:2]).any() or (other[2:] + gap_m <= box[:2]).any() for other in taken)
