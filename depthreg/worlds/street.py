"""What a street is: the line that it follows, its kind, and what runs along it with a constant cross-section."""

from dataclasses import dataclass

import numpy as np
import trimesh

from depthreg.worlds.scene import Material, SceneObject

_STEP_M = 4.0  # sweeps follow the line in steps of this length
HORIZON_M = 260.0  # streets and the land beside them go on to here


@dataclass(frozen=True)
class Street:
    """A curved, sloping line on which positions are (metres along, metres to the right of it, metres above it).

    Attributes:
        along_m: Where the line is sampled, (S,), ascending.
        xyz_m: The line's points in the world, (S, 3).
        heading_rad: Its direction, counter-clockwise from the world's y axis, (S,).
        behind_m: Where things begin to stand along it, behind the camera (negative): they throw shadows into view.
        ahead_m: Up to where things stand; the line itself goes on to the horizon.
        banks_m: How much higher the land 8 m away from the street is, left and right.
    """

    along_m: np.ndarray
    xyz_m: np.ndarray
    heading_rad: np.ndarray
    behind_m: float
    ahead_m: float
    banks_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def winding(
        cls,
        curvature_per_m: float,
        bend_m: float,
        slope: float,
        behind_m: float,
        ahead_m: float,
        banks_m: tuple[float, float] = (0.0, 0.0),
    ) -> "Street":
        """A line that leaves the world's origin along y, then bends and climbs.

        Args:
            curvature_per_m: Largest curvature; positive bends to the left.
            bend_m: The curvature swings as cos(along / bend_m).
            slope: Largest gradient, reached about 100 m ahead.
            behind_m: Where things begin to stand along it (negative).
            ahead_m: Up to where they stand, at most 240 m.
            banks_m: How much higher the land beside it is, left and right.
        """
        along = np.arange(2 * behind_m, HORIZON_M + 10.0)
        heading = curvature_per_m * bend_m * np.sin(along / bend_m)
        x, y = -np.cumsum(np.sin(heading)), np.cumsum(np.cos(heading))
        z = slope * np.where(along > 0, along**2 / (along + 60.0), 0)  # level where the camera stands
        origin = np.searchsorted(along, 0.0)
        return cls(along, np.stack([x - x[origin], y - y[origin], z], axis=1), heading, behind_m, ahead_m, banks_m)

    def points(self, along_m: np.ndarray, right_m: np.ndarray, up_m: np.ndarray) -> np.ndarray:
        """World points (..., 3) of positions on the street; the arguments broadcast."""
        heading = np.interp(along_m, self.along_m, self.heading_rad)
        x, y, z = (np.interp(along_m, self.along_m, self.xyz_m[:, k]) for k in range(3))
        return np.stack(
            np.broadcast_arrays(x + right_m * np.cos(heading), y + right_m * np.sin(heading), z + up_m), axis=-1
        )

    def stand(self, along_m: float, right_m: float, up_m: float = 0.0) -> tuple[tuple[float, float, float], float]:
        """World position and yaw (deg) of something that stands beside the line and looks along it."""
        x, y, z = self.points(np.array(along_m), np.array(right_m), np.array(up_m))
        yaw_deg = np.rad2deg(np.interp(along_m, self.along_m, self.heading_rad))
        return (float(x), float(y), float(z)), float(yaw_deg)

    def land_up_m(self, side: int, beside_m: float) -> float:
        """How much higher than the street the land is, so many metres beside it on its left (-1) or right (1)."""
        return float(np.interp(beside_m, [0, 8, 100], np.array([0, 1, 1]) * self.banks_m[side > 0] + [0, 0, 1]))

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
        return trimesh.Trimesh(vertices, grid_faces(steps, len(profile)), process=False)

    def dashes(
        self, right_m: float, width_m: float, up_m: float, starts_m: np.ndarray, length_m: float
    ) -> trimesh.Trimesh:
        """A row of flat dashes, each `length_m` long, centred `right_m` to the right of the line."""
        along = np.add.outer(starts_m, np.array([0.0, length_m]))[..., None]  # (D, 2, 1)
        right = right_m + np.array([-0.5, 0.5]) * width_m
        vertices = self.points(along, right, np.full(2, up_m)).reshape(-1, 3)
        faces = grid_faces(2, 2) + 4 * np.arange(len(starts_m))[:, None, None]
        return trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)


@dataclass(frozen=True)
class StreetStyle:
    """What a kind of street is made of. Shares and chances lie in [0, 1].

    Attributes:
        lanes: Lanes in each direction.
        lane_m: Width of a lane.
        parking_m: Width of the strip for parked cars on either side; 0 = none.
        pavement_m: Width of the pavement behind a kerb; 0 = a verge instead.
        verge_m: Grass between pavement (or road) and whatever stands behind it.
        houses: Share of the street's length with houses beside it.
        storeys: Fewest and most storeys of a house.
        house_gap_m: Longest gap between neighbours.
        front_m: Fewest and most metres of front garden.
        fence: Chance of a wall, fence or hedge in front of a garden.
        tree_gap_m: Mean distance between the trees of the row along the street.
        wood: How densely trees stand behind it.
        belts: Chance that a belt of trees runs along a side.
        rails: Whether guard rails run along.
        traffic_gap_m: Mean distance between cars in a lane.
        people: How many people there are, at most.
        max_curvature: Of the street, 1/m.
    """

    lanes: int = 1
    lane_m: float = 3.2
    parking_m: float = 0.0
    pavement_m: float = 0.0
    verge_m: float = 2.0
    houses: float = 0.0
    storeys: tuple[int, int] = (1, 2)
    house_gap_m: float = 6.0
    front_m: tuple[float, float] = (0.0, 0.0)
    fence: float = 0.0
    tree_gap_m: float = 20.0
    wood: float = 0.0
    belts: float = 0.0
    rails: bool = False
    traffic_gap_m: float = 40.0
    people: int = 0
    max_curvature: float = 1 / 500

    @property
    def half_m(self) -> float:
        """From the middle of the road to its edge."""
        return self.lanes * self.lane_m + self.parking_m

    @property
    def border_m(self) -> float:
        """From the middle of the road to where gardens, woods or fields begin."""
        return self.half_m + self.pavement_m + self.verge_m


def swept(
    name: str,
    street: Street,
    profile: list[tuple[float, float]],
    material: Material,
    *,
    side: int = 1,
    reach_m: tuple[float, float] | None = None,
) -> SceneObject:
    """What a cross-section leaves when it runs along a street.

    Args:
        name: Class of the thing.
        street: The line to follow.
        profile: Corners (metres to the right, metres up) from left to right, as they are on the street's right side.
        material: Its surface.
        side: 1 for the right side, -1 for the same on the left.
        reach_m: From where to where it runs; all along the street where not given.
    """
    start, stop = reach_m or (street.behind_m, HORIZON_M)
    section = profile if side > 0 else [(-right, up) for right, up in reversed(profile)]
    return SceneObject(name, street.sweep(section, start, stop), material)


def stops(rng: np.random.Generator, street: Street, start_m: float, gap_m: float, least_m: float) -> list[float]:
    """Random places along a street from `start_m` on, `least_m` or more apart and `gap_m` in the mean."""
    gaps = least_m + rng.exponential(max(gap_m - least_m, 0.1), int(2 * (street.ahead_m - start_m) / gap_m) + 2)
    along = start_m + np.cumsum(gaps) - gaps[0] * rng.uniform(0.3, 1)
    return along[along < street.ahead_m - 20].tolist()


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Triangles (F, 3) between the points of a grid that are numbered row by row; counter-clockwise from above."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, ahead = corner + 1, corner + columns
    return np.concatenate([np.stack([corner, right, ahead], 1), np.stack([right, ahead + 1, ahead], 1)])
