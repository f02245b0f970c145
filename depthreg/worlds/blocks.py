"""Stage 1's world: a few plain solids on a floor before a wall, with depth reported in bins.

Colours are flat or faintly textured and every solid differs from its neighbours, so nearly every depth
edge is a colour edge: the easiest place to learn what an alignment is.
"""

import colorsys
from dataclasses import dataclass

import numpy as np

from depthreg.errors import InputError
from depthreg.worlds.poses import camera_from_world, lidar_from_camera
from depthreg.worlds.scene import RGB, Light, Material, Scene, SceneObject
from depthreg.worlds.shapes import Part, assemble

_HALF_VIEW = 0.95  # x / y at the edge of the widest view that is filled: 43 degrees to each side
_CAMERA_HEIGHT_M = 1.65
_NEAREST_M = 5.0


@dataclass(frozen=True)
class BlocksWorld:
    """Boxes, columns, balls, ramps, gates and slanted walls; called as `world(seed, index)`.

    Attributes:
        max_depth_m: Nothing in view is farther than this.
        bins: Depth is reported at the centres of this many equal bins.
    """

    max_depth_m: float = 120.0
    bins: int = 20

    def __post_init__(self) -> None:
        if self.bins < 1 or self.max_depth_m < 40:
            given = f"max_depth_m={self.max_depth_m} and bins={self.bins}"
            raise InputError(f"{given} leave no room for blocks: at least 40 m and 1 bin were expected")

    def __call__(self, seed: int, index: int) -> Scene:
        """The scene that these numbers stand for; the same on every machine."""
        rng = np.random.default_rng([seed, index])
        floor = Part("box", (600.0, 600.0, 1.0), (0.0, 0.0, -1.0), _material(rng, saturation=0.15))
        wall_y = rng.uniform(0.6, 0.94) * self.max_depth_m
        objects = assemble("floor", [floor]) + _backdrop(rng, wall_y)
        spots = _spots(rng, count=int(rng.integers(14, 40)), farthest_m=0.55 * wall_y)
        for x, y, radius, height in spots:
            objects += _solid(rng, x, y, radius, height)
        pose = camera_from_world(
            (0.0, 0.0, _CAMERA_HEIGHT_M), pitch_deg=rng.uniform(-1.5, 2.5), roll_deg=rng.uniform(-1.5, 1.5)
        )
        return Scene(objects, _light(rng), pose, lidar_from_camera(), depth_bin_m=self.max_depth_m / self.bins)


def _light(rng: np.random.Generator) -> Light:
    # From the camera's side: the wall at the back would put everything in its shadow.
    azimuth, elevation = -rng.uniform(0.1, np.pi - 0.1), np.radians(rng.uniform(25, 70))
    direction = (np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation))
    sun, ambient = rng.uniform(0.6, 1.2), rng.uniform(0.4, 0.6)
    return Light(np.array(direction), (sun, 0.95 * sun, 0.87 * sun), (0.93 * ambient, 0.97 * ambient, ambient))


def _color(rng: np.random.Generator, saturation: float) -> RGB:
    return colorsys.hsv_to_rgb(rng.random(), saturation * rng.random(), rng.uniform(0.12, 0.6))


def _material(rng: np.random.Generator, saturation: float = 0.6) -> Material:
    color = _color(rng, saturation)
    shade = rng.uniform(0.75, 1.25)  # a second colour this near keeps a pattern from hiding the depth edges
    second = (min(shade * color[0], 1.0), min(shade * color[1], 1.0), min(shade * color[2], 1.0))
    pattern = str(rng.choice(["plain", "plain", "noise"]))
    return Material(color, pattern, second, scale_m=rng.uniform(0.5, 3.0), seed=int(rng.integers(2**31)))


def _backdrop(rng: np.random.Generator, wall_y: float) -> list[SceneObject]:
    """A wall across the view and slabs before it, so that the upper half of the image has edges too."""
    half_width = _HALF_VIEW * wall_y + 10.0
    objects = assemble("wall", [Part("box", (800.0, 1.0, 300.0), (0.0, wall_y + 0.5, 0.0), _material(rng, 0.25))])
    x = -half_width
    while x < half_width:
        width = wall_y * rng.uniform(0.08, 0.4)
        y = wall_y * rng.uniform(0.72, 0.97)
        height = y * rng.uniform(0.05, 0.3)
        size_m = (width, rng.uniform(1.0, 8.0), height)
        objects += assemble("slab", [Part("box", size_m, (x + width / 2, y, 0.0), _material(rng, 0.35))])
        x += width * rng.uniform(0.9, 1.6)
    return objects


def _spots(rng: np.random.Generator, count: int, farthest_m: float) -> np.ndarray:
    """Places that don't overlap on the floor: x, y, radius and height of each, (N, 4), N <= count.

    Angles across the view, sizes as seen from the camera and log-distances are uniform, so near and far, left
    and right get edges alike.
    """
    distance = np.exp(rng.uniform(np.log(_NEAREST_M), np.log(farthest_m), count))
    radius = np.clip(distance * rng.uniform(0.02, 0.12, count), 0.3, 7.0)
    distance += radius
    x = distance * rng.uniform(-_HALF_VIEW, _HALF_VIEW, count)
    top = _CAMERA_HEIGHT_M + distance * rng.uniform(-0.2, 0.24, count)
    height = np.clip(top, 0.3, 20.0)
    kept: list[np.ndarray] = []
    for spot in np.stack([x, distance, radius, height], axis=1):
        if all(np.hypot(*(spot[:2] - other[:2])) > spot[2] + other[2] for other in kept):
            kept.append(spot)
    return np.array(kept)


def _solid(rng: np.random.Generator, x: float, y: float, radius: float, height: float) -> list[SceneObject]:
    """A random solid within a circle on the floor."""
    kind = str(rng.choice(["box", "box", "cylinder", "sphere", "cone", "wedge", "panel", "gate"]))
    material, side, depth_share = _material(rng), 1.4 * radius, rng.uniform(0.4, 1.0)
    if kind == "sphere":
        parts = [Part("sphere", (2 * radius, 2 * radius, 2 * radius), (0, 0, 0), material)]
    elif kind == "panel":
        parts = [Part("box", (1.9 * radius, 0.2, height), (0, 0, 0), material)]
    elif kind == "gate":
        post = 0.35 * radius
        parts = [
            Part("box", (post, post, height), (place, 0, 0), material) for place in (-0.75 * radius, 0.75 * radius)
        ]
        parts.append(Part("box", (1.5 * radius + post, post, post), (0, 0, height), _material(rng)))
    else:
        parts = [Part(kind, (side, side * depth_share, height), (0, 0, 0), material)]
    return assemble(kind, parts, (x, y, 0.0), yaw_deg=rng.uniform(0, 360))
