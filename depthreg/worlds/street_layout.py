"""Where things stand and drive in a street: traffic, trees, posts and signs, guard rails, people."""

from collections.abc import Callable

import numpy as np

from depthreg.worlds import street_objects as things
from depthreg.worlds.scene import SceneObject
from depthreg.worlds.shapes import Part, assemble
from depthreg.worlds.street import Street, StreetStyle, stops, swept
from depthreg.worlds.street_ground import KERB_UP_M

# What stands at the kerb, and the mean distance between two, metres.
_POSTS: dict[str, tuple[Callable[[np.random.Generator], list[Part]], float]] = {
    "sign": (things.sign, 38.0),
    "bin": (things.bin_or_box, 45.0),
    "traffic light": (things.traffic_light, 110.0),
    "lamp": (things.lamp_post, 32.0),
    "pole": (things.pole, 60.0),
}


def _vehicle(
    rng: np.random.Generator, street: Street, along_m: float, right_m: float, turn_deg: float, lorries: float
) -> list[SceneObject]:
    """A car, or with the chance of `lorries` a lorry; 0 deg drives away from the camera."""
    make = things.lorry if rng.random() < lorries else things.car
    at, yaw = street.stand(along_m, right_m, 0.02)
    return assemble(make.__name__, make(rng, far=along_m > 45), at, yaw + turn_deg)


def traffic(rng: np.random.Generator, street: Street, style: StreetStyle, own_lane: int) -> list[SceneObject]:
    """Cars and lorries that drive, the one in the camera's lane far enough ahead, and those that are parked."""
    objects = []
    for lane in range(style.lanes):
        right = (lane + 0.5) * style.lane_m
        first = rng.uniform(9, 30) if lane == own_lane else rng.uniform(2, 20)
        for along in stops(rng, street, first, style.traffic_gap_m, 13.0):
            objects += _vehicle(rng, street, along, right + rng.normal(0, 0.15), rng.normal(0, 0.7), lorries=0.1)
        for along in stops(rng, street, rng.uniform(3, 25), style.traffic_gap_m, 13.0):
            objects += _vehicle(rng, street, along, -right + rng.normal(0, 0.15), 180 + rng.normal(0, 0.7), lorries=0.1)
    for side in (-1, 1) if style.parking_m else ():
        right = style.half_m - style.parking_m / 2
        for along in stops(rng, street, rng.uniform(-6, 10), rng.uniform(7, 16), 5.6):
            turn = (0 if side > 0 else 180) + rng.normal(0, 1.5)
            objects += _vehicle(rng, street, along, side * (right + rng.normal(0, 0.08)), turn, lorries=0.0)
    return objects


_Plant = Callable[[np.random.Generator, int], list[Part]]


def _planted(
    rng: np.random.Generator, plant: _Plant, at_m: tuple[float, float, float], coarse: bool
) -> list[SceneObject]:
    """A tree or bush with fewer leaves the farther it is, or nothing where the camera can't see it."""
    if abs(at_m[0]) > at_m[1] + 12:
        return []
    detail = int(np.searchsorted([-100, -42, -17], -np.hypot(at_m[0], at_m[1])))
    return assemble(plant.__name__, plant(rng, max(detail - coarse, 0)), at_m)


def greenery(rng: np.random.Generator, street: Street, style: StreetStyle, coarse: bool) -> list[SceneObject]:
    """The row of trees along the street, belts and woods behind it, and bushes; `coarse` ones have fewer leaves."""
    objects = []
    # Distances from the border between the street and the land beside it; the row stands on this side of it.
    row = style.half_m + (0.75 * style.pavement_m or 0.5 * style.verge_m) - style.border_m
    share = style.wood * street.ahead_m / 240
    for side in (-1, 1):
        in_row = stops(rng, street, -10, style.tree_gap_m, 0.5 * style.tree_gap_m)
        in_belt = stops(rng, street, 5, 6, 5) if rng.random() < style.belts else []
        in_wood = rng.uniform(0, street.ahead_m - 20, int(80 * share * rng.uniform(0.3, 1.2)))
        bushes = rng.uniform(0, min(street.ahead_m, 140), int(rng.integers(2, 8) + 30 * share))
        places: list[tuple[_Plant, float, float]] = [
            *((things.tree, along, row + rng.normal(0, 0.2)) for along in in_row),
            *((things.tree, along, 9 + rng.normal(0, 1.2)) for along in in_belt),
            *((things.tree, along, 4 + rng.exponential(16)) for along in in_wood),
            *((things.bush, along, 2 + rng.exponential(6)) for along in bushes),
        ]
        for plant, along, beside in places:
            at, _ = street.stand(along, side * (style.border_m + beside), street.land_up_m(side, beside))
            objects += _planted(rng, plant, at, coarse)
    return objects


def furniture(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Lamp posts, masts, signs, signals, bins and guard rails."""
    objects = []
    kerb = style.half_m + (0.6 if style.pavement_m else 1.2)
    for side in (-1, 1):
        for name, (make, gap) in _POSTS.items() if style.pavement_m else [("sign", _POSTS["sign"])]:
            for along in stops(rng, street, rng.uniform(4, 20), gap * rng.uniform(0.7, 2), 12.0):
                at, yaw = street.stand(along, side * (kerb + rng.uniform(0, 0.3)))
                faces_us = name == "sign" and side > 0
                objects += assemble(name, make(rng), at, yaw + (0 if faces_us or side < 0 else 180))
        if style.rails:
            objects += _rail(street, side, style.half_m + 0.7)
    if style.rails:
        objects += _rail(street, 1, 0.0)
    return objects


def _rail(street: Street, side: int, right_m: float) -> list[SceneObject]:
    """A guard rail with posts, `right_m` from the middle of the road on one side."""
    beam = [(right_m, 0.45), (right_m - 0.06, 0.52), (right_m, 0.6), (right_m - 0.06, 0.68), (right_m, 0.75)]
    objects = [swept("guard rail", street, beam, things.STEEL, side=side)]
    for along in np.arange(0, 100, 4.0):
        at, yaw = street.stand(along, side * (right_m + 0.08))
        objects += assemble("post", [Part("box", (0.1, 0.1, 0.72), (0, 0, 0), things.STEEL)], at, yaw)
    return objects


def gantries(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Sign gantries across motorways."""
    objects = []
    for along in stops(rng, street, rng.uniform(20, 150), 220, 150) if style.rails else []:
        at, yaw = street.stand(along, 0.0)
        objects += assemble("gantry", things.gantry(rng, style.half_m + 2.0), at, yaw)
    return objects


def people(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """People on the pavements, and now and then one who crosses."""
    objects = []
    for _ in range(int(rng.integers(0, style.people + 1))):
        right = rng.choice([-1, 1]) * (style.half_m + rng.uniform(0.3, 0.95) * max(style.pavement_m, 1.0))
        up, turn = KERB_UP_M, rng.choice([0, 180]) + rng.normal(0, 20)
        if rng.random() < 0.08:
            right, up, turn = rng.uniform(-1, 1) * style.half_m, 0.0, turn + 90
        at, yaw = street.stand(rng.uniform(7, 60), right, up)
        objects += assemble("person", things.person(rng), at, yaw + turn)
    return objects
