"""Rooms as a hand-held or mounted depth camera sees them: living rooms, bedrooms, kitchens, studies."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from depthreg.errors import InputError
from depthreg.worlds import cupboards, furniture, wall_things
from depthreg.worlds.floorplan import Floorplan, Pose
from depthreg.worlds.furniture import Furniture
from depthreg.worlds.interior import Palette, draw_palette, floor_material, pick, wall_material
from depthreg.worlds.poses import camera_from_world, lidar_from_camera
from depthreg.worlds.scene import RGB, Light, Material, Scene, SceneObject
from depthreg.worlds.shapes import Part, Vector, assemble
from depthreg.worlds.small_things import scatter

Maker = Callable[[np.random.Generator, Palette], Furniture]

_WALL_M = 0.12
_CAMERA_CLEARANCE_M = 0.45
_VIEWS = 8  # more would always show the room's fullest corner
_LIDAR_IN_CAMERA_M = (0.0, -0.06, -0.03)  # a small scanner on top of the camera

# What makes a room what it is, the largest first.
_ROOMS: dict[str, tuple[Maker, ...]] = {
    "living room": (furniture.lounge, cupboards.television, cupboards.bookcase, furniture.armchair),
    "bedroom": (furniture.bed, cupboards.wardrobe, cupboards.chest, cupboards.desk),
    "kitchen": (cupboards.counter, cupboards.fridge, cupboards.counter),
    "study": (cupboards.desk, cupboards.bookcase, cupboards.bookcase, cupboards.desk),
}
# What fills up the rest of the walls.
_EXTRAS: tuple[Maker, ...] = (
    cupboards.bookcase,
    cupboards.chest,
    furniture.side_table,
    furniture.armchair,
    furniture.chair,
    furniture.floor_lamp,
    furniture.plant,
    furniture.plant,
    furniture.carton,
    furniture.carton,
)


@dataclass(frozen=True)
class HouseholdWorld:
    """Furnished rooms, lit by a lamp; called as `world(seed, index)`.

    Attributes:
        min_side_m: Shortest wall.
        max_side_m: Longest wall.
    """

    min_side_m: float = 3.5
    max_side_m: float = 7.0

    def __post_init__(self) -> None:
        if not 2.5 <= self.min_side_m <= self.max_side_m:
            sides = f"min_side_m={self.min_side_m} and max_side_m={self.max_side_m}"
            raise InputError(f"{sides} make no room: 2.5 m or more, the smaller first, was expected")

    def __call__(self, seed: int, index: int) -> Scene:
        """The scene that these numbers stand for; the same on every machine."""
        rng = np.random.default_rng([seed, index])
        width, depth = rng.uniform(self.min_side_m, self.max_side_m, 2)
        height = rng.uniform(2.4, 2.9)
        kind = str(rng.choice(list(_ROOMS)))
        palette = draw_palette(rng)
        plan = Floorplan(width, depth)
        objects = _shell(rng, kind, (width, depth, height))
        objects += wall_things.openings(rng, palette, plan, height)
        pieces, landmarks = _furnish(rng, _ROOMS[kind], palette, plan)
        objects += pieces + wall_things.decorations(rng, palette, plan, height)
        lamp = (width * rng.uniform(0.35, 0.65), depth * rng.uniform(0.35, 0.65), height)
        objects += assemble("ceiling lamp", [Part("cylinder", (0.4, 0.4, 0.06), (0, 0, -0.06), palette.linen)], lamp)
        return Scene(
            objects,
            _light(rng, lamp),
            _camera(rng, plan, landmarks),
            lidar_from_camera(_LIDAR_IN_CAMERA_M),
            baseline_m=0.075,
        )


def _shell(rng: np.random.Generator, kind: str, size_m: Vector) -> list[SceneObject]:
    """Floor, ceiling, walls and skirting of a room that stands in the positive octant."""
    width, depth, height = size_m
    wall, ceiling = wall_material(rng), Material((0.95, 0.95, 0.93))
    floor = floor_material(rng, ("tiles", "planks") if kind == "kitchen" else ("planks", "planks", "carpet"))
    outer = (width + 2 * _WALL_M, depth + 2 * _WALL_M, _WALL_M)
    objects = assemble("floor", [Part("box", outer, (width / 2, depth / 2, -_WALL_M), floor)])
    objects += assemble("ceiling", [Part("box", outer, (width / 2, depth / 2, height), ceiling)])
    skirting = pick(rng, (Material((0.75, 0.74, 0.72)), Material((0.2, 0.13, 0.08))))
    for turn in range(4):
        length = (width, depth)[turn % 2]
        corner = (width * (turn in (1, 2)), depth * (turn in (2, 3)), 0.0)
        parts = [
            Part("box", (length + 2 * _WALL_M, _WALL_M, height), (length / 2, -_WALL_M / 2, 0), wall),
            Part("box", (length, 0.03, 0.08), (length / 2, 0, 0), skirting),
        ]
        objects += assemble("wall", parts, corner, yaw_deg=90.0 * turn)
    return objects


def _furnish(
    rng: np.random.Generator, makers: tuple[Maker, ...], palette: Palette, plan: Floorplan
) -> tuple[list[SceneObject], np.ndarray]:
    """Furniture with things on it, along the walls and in the open, and what to look at: x, y, z, width."""
    extras = [_EXTRAS[k] for k in rng.integers(len(_EXTRAS), size=int(rng.integers(7, 15)))]
    placed: list[tuple[Furniture, Pose | None]] = []
    for make in (*makers, *extras):
        piece = make(rng, palette)
        placed.append((piece, plan.along_wall(rng, piece.width_m, piece.depth_m, 0.0, piece.height_m)))
    center_makers = (furniture.dining_group, furniture.dining_group, furniture.armchair, furniture.carton)
    for k in rng.permutation(len(center_makers))[: rng.integers(0, 3)]:
        piece = center_makers[k](rng, palette)
        placed.append((piece, plan.in_the_open(rng, piece.width_m, piece.depth_m, clearance_m=0.5)))

    objects: list[SceneObject] = []
    landmarks = [(plan.width_m / 2, plan.depth_m / 2, 0.7, 0.0)]
    for piece, pose in placed:
        if pose is not None:
            things = [part for s in piece.surfaces for part in scatter(rng, palette, s, tries=int(rng.integers(6, 24)))]
            objects += assemble(piece.name, piece.parts, *pose) + assemble("things", things, *pose)
            (x, y, _), yaw = pose[0], np.radians(pose[1])
            half = piece.depth_m / 2
            middle = (x - half * np.sin(yaw), y + half * np.cos(yaw), 0.6 * piece.height_m)
            landmarks.append((*middle, piece.width_m))
    return objects, np.array(landmarks)


def _camera(rng: np.random.Generator, plan: Floorplan, landmarks: np.ndarray) -> np.ndarray:
    """Somebody stands where there is room and looks, slightly down, where there is most to see."""
    places = plan.standing_places(_CAMERA_CLEARANCE_M)
    most, view = -1.0, (places[0], landmarks[0])
    for _ in range(_VIEWS):
        place, target = places[rng.integers(len(places))], landmarks[rng.integers(len(landmarks))]
        away = landmarks[:, :2] - place
        distance = np.hypot(*away.T)
        ahead = away @ (target[:2] - place) / np.maximum(distance * np.hypot(*(target[:2] - place)), 1e-6)
        seen = float(((ahead > 0.85) * landmarks[:, 3] / np.maximum(distance, 1.0)).sum())
        if seen > most:
            most, view = seen, (place, target)
    place, target = view
    height = rng.uniform(0.8, 1.8)
    dx, dy = target[:2] - place
    yaw = np.degrees(np.arctan2(-dx, dy)) + rng.normal(0, 8)
    pitch = np.degrees(np.arctan2(height - target[2], np.hypot(dx, dy))) + rng.normal(0, 4)
    position = (float(place[0]), float(place[1]), height)
    return camera_from_world(position, yaw, float(np.clip(pitch, -8, 35)), rng.normal(0, 1.5))


def _light(rng: np.random.Generator, lamp_m: Vector) -> Light:
    """A ceiling lamp and what the walls throw back of it; between warm and cool white."""
    warmth, lamp, ambient = rng.uniform(0.0, 0.3), rng.uniform(0.6, 1.6), rng.uniform(0.4, 0.7)
    tint = np.array([1.0, 1.0 - 0.4 * warmth, 1.0 - warmth])
    walls: RGB = (0.4, 0.4, 0.38)  # what polished things mirror instead of a sky
    return Light(
        sun_direction=np.array([0.0, 0.0, 1.0]),
        sun_rgb=tuple(lamp * tint),
        ambient_rgb=tuple(ambient * (0.5 + 0.5 * tint)),
        sky_horizon_rgb=walls,
        sky_zenith_rgb=walls,
        cloud_cover=0.0,
        lamp_m=(lamp_m[0], lamp_m[1], lamp_m[2] - 0.1),
    )
