"""Streets as a car's camera and LiDAR see them: city, suburb, country road and motorway."""

from dataclasses import dataclass

import numpy as np

from depthreg.errors import InputError
from depthreg.worlds import houses, poses, street_ground, street_layout
from depthreg.worlds.scene import Light, Scene
from depthreg.worlds.street import Street, StreetStyle

STYLES: dict[str, StreetStyle] = {
    "city": StreetStyle(
        lane_m=3.1, parking_m=2.2, pavement_m=2.8, verge_m=0.0, houses=0.93, storeys=(3, 5), house_gap_m=1.5,
        tree_gap_m=28, traffic_gap_m=26, people=9, max_curvature=1 / 500,
    ),
    "suburb": StreetStyle(
        lane_m=3.0, parking_m=2.0, pavement_m=1.8, verge_m=0.5, houses=0.75, storeys=(1, 3), house_gap_m=9,
        front_m=(2, 8), fence=0.7, tree_gap_m=26, wood=0.25, traffic_gap_m=60, people=4, max_curvature=1 / 250,
    ),
    "country": StreetStyle(
        lane_m=3.3, verge_m=2.5, houses=0.06, storeys=(1, 2), front_m=(6, 20), tree_gap_m=60, wood=0.7, belts=0.5,
        traffic_gap_m=70, max_curvature=1 / 220,
    ),
    "motorway": StreetStyle(
        lanes=2, lane_m=3.7, verge_m=5.0, tree_gap_m=400, wood=0.6, belts=0.8, rails=True, traffic_gap_m=38,
        max_curvature=1 / 800,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class DrivingWorld:
    """Streets: `DrivingWorld()(seed, index)` draws one, the same for the same two numbers.

    Attributes:
        styles: Which kinds of street to draw from, keys of `STYLES`.
        camera_up_m: Height of the camera above the road.
        ahead_m: How far ahead things stand, up to 240 m; a shorter street is quicker to build and to render.
        coarse_leaves: Whether trees have a third of their leaves: quicker, and enough for small pictures.

    Raises:
        InputError: A style is unknown, or `ahead_m` is out of range.
    """

    styles: tuple[str, ...] = tuple(STYLES)
    camera_up_m: float = 1.65
    ahead_m: float = 240.0
    coarse_leaves: bool = False

    def __post_init__(self) -> None:
        unknown = sorted(set(self.styles) - set(STYLES))
        if unknown or not self.styles:
            raise InputError(f"world.styles must name some of {sorted(STYLES)}, got {list(self.styles)}.")
        if not 40 <= self.ahead_m <= 240:
            raise InputError(f"world.ahead_m must lie between 40 and 240 metres, got {self.ahead_m}.")

    def __call__(self, seed: int, index: int) -> Scene:
        """Draw the street of a seed and an index."""
        rng = np.random.default_rng([seed, index])
        style = STYLES[self.styles[rng.integers(len(self.styles))]]
        street = Street.winding(
            curvature_per_m=rng.uniform(-1, 1) * style.max_curvature,
            bend_m=rng.uniform(40, 150),
            slope=rng.normal(0, 0.012),
            behind_m=-25.0,
            ahead_m=self.ahead_m,
            banks_m=(0.0, 0.0) if style.houses > 0.5 else tuple(rng.choice([0.0, 0.0, 0.6, 2.0, -0.8], 2).tolist()),
        )
        lane = int(rng.integers(style.lanes))
        objects = [
            *street_ground.roadway(rng, street, style),
            *street_ground.roadside(rng, street, style),
            street_ground.backdrop(rng, street),
            *street_layout.traffic(rng, street, style, lane),
            *houses.houses(rng, street, style),
            *street_layout.greenery(rng, street, style, self.coarse_leaves),
            *street_layout.furniture(rng, street, style),
            *street_layout.gantries(rng, street, style),
            *street_layout.people(rng, street, style),
        ]
        right = (lane + 0.5) * style.lane_m + rng.normal(0, 0.2)
        x, y, z = street.stand(0.0, right, self.camera_up_m + rng.normal(0, 0.04))[0]
        yaw, pitch, roll = rng.normal(0, [1.5, 0.7, 0.4])
        pose, light = poses.camera_from_world((x, y, z), yaw, pitch, roll), _weather(rng)
        speed_m_per_s = rng.uniform(0, min(style.traffic_gap_m / 2, 30))  # drivers keep two seconds' distance
        velocity = tuple((speed_m_per_s * pose[2, :3]).tolist())  # along the optical axis
        lidar = poses.lidar_from_camera(poses.KITTI_LIDAR_IN_COLOUR_CAMERA_M, _mounting(rng))
        return Scene(objects, light, pose, lidar, velocity_m_per_s=velocity)


def _mounting(rng: np.random.Generator) -> tuple[float, float, float]:
    """How the LiDAR is turned against the camera, degrees: no car's is level.

    KITTI's calibrations: right side up by 0.5 to 0.7, nose down by -0.4 to 0.6, sideways by 0.3 at most.
    """
    return float(rng.normal(-0.6, 0.1)), float(rng.uniform(-0.4, 0.7)), float(rng.normal(0.0, 0.15))


def _weather(rng: np.random.Generator) -> Light:
    """Sun or an overcast sky, clear air or haze; the exposure suits the light."""
    elevation, azimuth = np.deg2rad(rng.uniform(22, 65)), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])
    overcast = rng.random() < 0.2
    strength = rng.uniform(0.1, 0.7) if overcast else rng.uniform(1.6, 2.4)
    warm = np.array([1.0, 0.93, 0.82]) if elevation > 0.6 else np.array([1.0, 0.86, 0.68])
    ambient = np.array([0.7, 0.75, 0.8]) if overcast else np.array([0.15, 0.2, 0.28])
    horizon = np.array([1.3, 1.35, 1.4]) if overcast else np.array([1.0, 1.2, 1.38])
    zenith = np.array([0.9, 0.95, 1.0]) if overcast else np.array([0.24, 0.5, 1.0])
    level = strength * np.sin(elevation) + ambient.mean()
    return Light(
        sun_direction=sun,
        sun_rgb=tuple((strength * warm).tolist()),
        ambient_rgb=tuple(ambient.tolist()),
        sky_horizon_rgb=tuple(horizon.tolist()),
        sky_zenith_rgb=tuple(zenith.tolist()),
        cloud_cover=float(rng.uniform(0.7, 1) if overcast else rng.uniform(0, 0.6)),
        fog_per_m=float(rng.choice([0.0002, 0.0006, 0.0016], p=[0.5, 0.4, 0.1])),
        exposure=float(1.35 / level * np.exp(rng.normal(0, 0.15))),
    )
