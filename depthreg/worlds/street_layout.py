"""What runs along a street and where things stand beside it: road, pavements, traffic, houses, trees, barriers."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from depthreg.worlds import street_objects as things
from depthreg.worlds.scene import Material, SceneObject
from depthreg.worlds.shapes import Part, assemble
from depthreg.worlds.street import Street

_MARKING = Material((0.55, 0.55, 0.52), "asphalt", (0.4, 0.4, 0.38), 2.0)
_KERB_UP_M = 0.12


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


def _mirrored(profile: list[tuple[float, float]], side: int) -> list[tuple[float, float]]:
    """A cross-section of the street's right side (side 1), or the same on its left (side -1)."""
    return profile if side > 0 else [(-right, up) for right, up in reversed(profile)]


def _swept(
    name: str, street: Street, profile: list[tuple[float, float]], material: Material, *, side: int = 1,
    reach_m: tuple[float, float] | None = None,
) -> SceneObject:  # fmt: skip
    """What a cross-section of the street's right (1) or left side (-1) leaves along all of it or `reach_m` of it."""
    start, stop = reach_m or (street.behind_m, street.ahead_m + 20)
    return SceneObject(name, street.sweep(_mirrored(profile, side), start, stop), material)


def _tinted(rng: np.random.Generator, color: tuple[float, float, float], spread: float = 0.2) -> tuple[float, float, float]:
    """A colour a little lighter or darker, warmer or colder."""
    scale = rng.uniform(1 - spread, 1 + spread) * rng.uniform(1 - spread / 4, 1 + spread / 4, 3)
    return tuple((np.array(color) * scale).clip(0, 1).tolist())


def roadway(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """The carriageway and its markings."""
    grey = _tinted(rng, (0.1, 0.098, 0.095), 0.3)
    asphalt = Material(grey, "asphalt", _tinted(rng, tuple(1.35 * np.array(grey)), 0.1), rng.uniform(3.5, 6))
    half = style.half_m
    objects = [_swept("road", street, [(-half, 0), (0, 0.04), (half, 0)], asphalt)]
    edge = half - style.parking_m - 0.25
    if style.pavement_m == 0 or rng.random() < 0.3:
        for side in (-1, 1):
            objects.append(
                _swept("marking", street, [(edge - 0.07, 0.012), (edge + 0.07, 0.012)], _MARKING, side=side)
            )
    length, gap = (6.0, 12.0) if style.rails else (3.0, 5.0)
    starts = np.arange(street.behind_m + rng.uniform(0, gap), street.ahead_m, length + gap)
    for lane in range(1 - style.lanes, style.lanes):
        objects.append(SceneObject("marking", street.dashes(lane * style.lane_m, 0.14, 0.055, starts, length), _MARKING))
    objects += _repairs(rng, street, style)
    return objects


def _repairs(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Patches of newer asphalt, and manhole covers."""
    dark = Material((0.055, 0.055, 0.058), "asphalt", (0.07, 0.07, 0.07), 3.0)
    iron = Material((0.05, 0.048, 0.045), "checker", (0.09, 0.085, 0.08), 0.1)
    objects = []
    for _ in range(rng.integers(0, 5)):
        at, _ = street.stand(rng.uniform(4, 60), rng.uniform(-0.8, 0.8) * style.half_m, 0.035)
        if rng.random() < 0.5:
            objects += assemble("manhole", [Part("cylinder", (0.65, 0.65, 0.012), (0, 0, 0), iron)], at)
        else:
            along, right = rng.uniform(4, 50), rng.uniform(-0.6, 0.6) * style.half_m
            patch = [(right, 0.044), (right + rng.uniform(0.5, 1.5), 0.044)]
            objects.append(_swept("patch", street, patch, dark, reach_m=(along, along + rng.uniform(1, 12))))
    return objects


def roadside(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Kerbs, pavements, verges and the land beyond, on both sides."""
    grass = Material(_tinted(rng, (0.065, 0.105, 0.022)), "grass", _tinted(rng, (0.19, 0.17, 0.06)), rng.uniform(3, 6))
    land = grass if rng.random() < 0.7 else Material((0.14, 0.1, 0.06), "gravel", (0.2, 0.16, 0.1), 5.0)
    slab = Material(_tinted(rng, (0.22, 0.21, 0.19)), "paving", (0.18, 0.17, 0.16), rng.uniform(0.25, 0.5))
    kerb = Material((0.26, 0.26, 0.25), "concrete", (0.15, 0.15, 0.14), 1.0)
    half, objects = style.half_m, []
    for side in (-1, 1):
        up, inner = 0.0, half
        if style.pavement_m:
            up, inner = _KERB_UP_M, half + style.pavement_m
            stone = [(half, 0.0), (half, up), (half + 0.16, up)]
            objects.append(_swept("kerb", street, stone, kerb, side=side))
            objects.append(_swept("pavement", street, [(half + 0.16, up), (inner, up)], slab, side=side))
        bank = rng.choice([0.0, 0.0, 0.6, 2.0, -0.8]) if not style.houses else 0.0
        edge = style.border_m
        verge = [(inner, up - 0.01), (inner + 0.3 * style.verge_m, up + 0.03), (edge, up)]
        objects.append(_swept("verge", street, verge, grass, side=side))
        field = [(edge, up), (edge + 8, up + bank), (45, up + bank + 0.3), (110, up + bank + 1)]
        objects.append(_swept("land", street, field, land, side=side))
    return objects


def backdrop(rng: np.random.Generator, street: Street) -> SceneObject:
    """A ragged line of far woods and hills behind everything."""
    angle = np.deg2rad(np.arange(-80, 80, 0.35))
    hills = np.interp(angle, np.linspace(-1.4, 1.4, 12), rng.uniform(1, 14, 12))
    ragged = np.repeat(rng.normal(0, 1.3, len(angle) // 3 + 1), 3)[: len(angle)] + rng.normal(0, 0.5, len(angle))
    top = street.xyz_m[-1, 2] + 4 + hills + ragged
    reach = 245.0
    rows = [np.stack([reach * np.sin(angle), reach * np.cos(angle), z], 1) for z in (np.full(len(angle), -25.0), top)]
    columns = np.arange(len(angle) - 1)
    lower, upper = columns, columns + len(angle)
    faces = np.concatenate([np.stack([lower, lower + 1, upper], 1), np.stack([lower + 1, upper + 1, upper], 1)])
    wood = Material(_tinted(rng, (0.05, 0.075, 0.04)), "foliage", (0.08, 0.1, 0.05), 15.0, seed=int(rng.integers(99)), variation=0.25)
    return SceneObject("hills", trimesh.Trimesh(np.concatenate(rows), faces, process=False), wood)


def _stops(rng: np.random.Generator, street: Street, start_m: float, gap_m: float, least_m: float) -> list[float]:
    """Random places along the street from `start_m` on, `least_m` or more apart and `gap_m` in the mean."""
    gaps = least_m + rng.exponential(max(gap_m - least_m, 0.1), int(2 * (street.ahead_m - start_m) / gap_m) + 2)
    along = start_m + np.cumsum(gaps) - gaps[0] * rng.uniform(0.3, 1)
    return along[along < street.ahead_m - 20].tolist()


def _vehicle(
    rng: np.random.Generator, street: Street, along_m: float, right_m: float, up_m: float, turn_deg: float
) -> list[SceneObject]:
    is_lorry = rng.random() < 0.1
    at, yaw = street.stand(along_m, right_m, up_m)
    parts = (things.lorry if is_lorry else things.car)(rng, far=along_m > 45)
    return assemble("lorry" if is_lorry else "car", parts, at, yaw + turn_deg)


def traffic(rng: np.random.Generator, street: Street, style: StreetStyle, own_lane: int) -> list[SceneObject]:
    """Cars and lorries that drive, the one in the camera's lane far enough ahead, and those that are parked."""
    objects = []
    for lane in range(style.lanes):
        right = (lane + 0.5) * style.lane_m
        first = rng.uniform(9, 30) if lane == own_lane else rng.uniform(2, 20)
        for along in _stops(rng, street, first, style.traffic_gap_m, 13.0):
            objects += _vehicle(rng, street, along, right + rng.normal(0, 0.15), 0.02, rng.normal(0, 0.7))
        for along in _stops(rng, street, rng.uniform(3, 25), style.traffic_gap_m, 13.0):
            objects += _vehicle(rng, street, along, -right + rng.normal(0, 0.15), 0.02, 180 + rng.normal(0, 0.7))
    if style.parking_m:
        for side in (-1, 1):
            right = side * (style.half_m - style.parking_m / 2)
            for along in _stops(rng, street, rng.uniform(-6, 10), rng.uniform(7, 16), 5.6):
                at, yaw = street.stand(along, right + rng.normal(0, 0.08))
                objects += assemble("car", things.car(rng, far=along > 45), at, yaw + (0 if side > 0 else 180) + rng.normal(0, 1.5))
    return objects


def _house(rng: np.random.Generator, bays: int, storeys: int, bay_m: float, corner_m: tuple[float, float, float]) -> tuple[list[Part], float, float]:
    """A house whose front is the plane x = 0 and whose middle is y = 0; its parts, width and depth in metres."""
    walls = [(0.5, 0.46, 0.36), (0.55, 0.53, 0.48), (0.42, 0.4, 0.37), (0.5, 0.38, 0.22), (0.4, 0.24, 0.16), (0.3, 0.13, 0.09), (0.36, 0.36, 0.34)]
    styles = ["windows", "shuttered_windows"] if storeys < 3 else ["windows", "windows", "wide_windows", "ribbon_windows"]
    wall = Material(
        _tinted(rng, walls[rng.integers(len(walls))]), str(rng.choice(styles)), (0.03, 0.035, 0.04), bay_m,
        gloss=0.8, seed=0, origin_m=corner_m,
    )  # fmt: skip
    tile = Material(_tinted(rng, [(0.22, 0.09, 0.06), (0.12, 0.1, 0.095), (0.07, 0.07, 0.075)][rng.integers(3)]), "roof_tiles", (0.09, 0.09, 0.07), 0.35)
    base = Material((0.2, 0.19, 0.18), "plaster", (0.12, 0.12, 0.11), 4.0)
    width, depth, tall = bays * bay_m, 3 * bay_m, storeys * bay_m
    middle = depth / 2
    parts = [
        Part("box", (depth, width, tall + 1), (middle, 0, -1), wall),
        Part("box", (depth + 0.08, width + 0.08, 0.5 + 1), (middle, 0, -1), base),
        *_doors(rng, bays, bay_m, base, shop=storeys > 2 and rng.random() < 0.5),
    ]
    if storeys > 3 and rng.random() < 0.6:
        parts.append(Part("box", (depth + 0.3, width + 0.3, 0.5), (middle, 0, tall), base))
    else:
        ridge = Part(str(rng.choice(["gable", "gable", "hip"])), (depth + 0.9, width + 0.6, rng.uniform(0.32, 0.5) * depth), (middle, 0, tall), tile)
        parts.append(ridge)
        parts.append(Part("box", (0.6, 0.8, ridge.size_m[2] + 0.6), (middle + 1.2, rng.uniform(-0.3, 0.3) * width, tall), base))
    if storeys > 2 and rng.random() < 0.3:
        for storey in range(1, storeys):
            parts.append(Part("box", (1.1, 0.8 * bay_m, 1.0), (-0.5, (rng.integers(bays) + 0.5 - bays / 2) * bay_m, storey * bay_m + 0.05), base))
    return parts, width, depth


def _doors(rng: np.random.Generator, bays: int, bay_m: float, frame: Material, shop: bool) -> list[Part]:
    """What is different on the ground floor: a door, or shop windows under a fascia."""
    door = Material(_tinted(rng, [(0.1, 0.05, 0.025), (0.03, 0.06, 0.04), (0.45, 0.44, 0.42), (0.03, 0.03, 0.035)][rng.integers(4)]), gloss=0.1)
    at = (rng.integers(bays) + 0.5 - bays / 2) * bay_m
    parts = [
        Part("box", (0.2, 1.5, 2.55), (0, at, 0), frame),
        Part("box", (0.26, 1.1, 2.2), (0, at, 0.15), door),
    ]
    if shop:
        name = Material(_tinted(rng, [(0.3, 0.03, 0.03), (0.03, 0.1, 0.25), (0.05, 0.2, 0.08), (0.5, 0.45, 0.3)][rng.integers(4)]))
        width = bays * bay_m
        parts += [Part("box", (0.1, width - 0.4, 2.45), (0, 0, 0.0), frame), Part("box", (0.3, width - 0.6, 0.5), (0, 0, 2.4), name)]
        parts += [Part("box", (0.14, 0.78 * bay_m, 1.8), (0, (n + 0.5 - bays / 2) * bay_m, 0.5), things.GLASS) for n in range(bays)]
    return parts


def houses(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Houses along both sides, with gardens and what encloses them."""
    objects = []
    for side in (-1, 1):
        along = street.behind_m + rng.uniform(0, 10)
        while style.houses and along < street.ahead_m - 30:
            front = style.border_m + rng.uniform(*style.front_m)
            if rng.random() > style.houses:
                along += rng.uniform(8, 25)
                continue
            bays, bay_m = int(rng.integers(3, 7)), float(rng.uniform(2.7, 3.2))
            width = bays * bay_m
            at, yaw = street.stand(along + width / 2, side * front, 0.1)
            turn = np.deg2rad(yaw + (0 if side > 0 else 180))
            corner = (at[0] + np.sin(turn) * width / 2, at[1] - np.cos(turn) * width / 2, at[2])
            parts, width, _ = _house(rng, bays, int(rng.integers(style.storeys[0], style.storeys[1] + 1)), bay_m, corner)
            objects += assemble("house", parts, at, yaw + (0 if side > 0 else 180))
            gap = rng.uniform(0, style.house_gap_m)
            if rng.random() < style.fence and front - style.border_m > 1.5:
                objects.append(_enclosure(rng, street, side, style.border_m + 0.3, (along - gap / 2, along + width + gap / 2)))
            along += width + gap
    return objects


def _enclosure(rng: np.random.Generator, street: Street, side: int, right_m: float, reach_m: tuple[float, float]) -> SceneObject:
    """A hedge, wall or fence along a garden."""
    kind = rng.integers(4)
    tall = float(rng.uniform(0.8, 1.9))
    if kind == 0:
        color, second = things.LEAVES[rng.integers(3)]
        surface, thick = Material(color, "foliage", second, 1.6, seed=int(rng.integers(99))), 0.7
    elif kind == 1:
        surface, thick = Material(_tinted(rng, (0.3, 0.15, 0.1)), "brick", (0.35, 0.33, 0.3), 0.24), 0.25
    elif kind == 2:
        surface, thick = Material(_tinted(rng, (0.28, 0.26, 0.23)), "stones", (0.18, 0.17, 0.15), 0.5), 0.35
    else:
        surface, thick = Material(_tinted(rng, (0.2, 0.13, 0.08)), "stripes", (0.1, 0.07, 0.045), 0.3), 0.06
    profile = [(right_m, -0.2), (right_m, tall), (right_m + thick, tall), (right_m + thick, -0.2)]
    return _swept("enclosure", street, profile, surface, side=side, reach_m=reach_m)


def _planted(
    rng: np.random.Generator, street: Street, make: Callable[..., list[Part]], along_m: float, right_m: float
) -> list[SceneObject]:
    """A tree or bush, or nothing where the camera can't see it."""
    at, _ = street.stand(along_m, right_m)
    if abs(at[0]) > at[1] + 12:
        return []
    away_m = np.hypot(at[0], at[1])
    detail = int(np.searchsorted([-100, -42, -17], -away_m))
    return assemble(make.__name__, make(rng, detail), at)


def greenery(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """The row of trees along the street, woods behind it, and bushes."""
    objects = []
    row = style.half_m + (0.75 * style.pavement_m or 0.5 * style.verge_m)
    for side in (-1, 1):
        for along in _stops(rng, street, -10, style.tree_gap_m, 0.5 * style.tree_gap_m):
            objects += _planted(rng, street, things.tree, along, side * (row + rng.normal(0, 0.2)))
        inner = style.border_m + 2
        for _ in range(int(80 * style.wood * rng.uniform(0.3, 1.2))):
            along, right = rng.uniform(0, street.ahead_m - 20), inner + 2 + rng.exponential(16)
            objects += _planted(rng, street, things.tree, along, side * right)
        for along in _stops(rng, street, 5, 6, 5) if rng.random() < style.belts else []:
            objects += _planted(rng, street, things.tree, along, side * (inner + 7 + rng.normal(0, 1.2)))
        for _ in range(int(rng.integers(2, 8) + 30 * style.wood)):
            along, right = rng.uniform(0, 140), inner + rng.exponential(6)
            objects += _planted(rng, street, things.bush, along, side * right)
    return objects


def furniture(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Lamp posts, masts, signs, signals, bins and guard rails."""
    objects = []
    kerb = style.half_m + (0.6 if style.pavement_m else 1.2)
    posts: list[tuple[str, Callable[[np.random.Generator], list[Part]], float]] = [
        ("sign", things.sign, 38.0), ("bin", things.bin_or_box, 45.0), ("traffic light", things.traffic_light, 110.0),
        ("lamp", things.lamp_post, 32.0), ("pole", things.pole, 60.0),
    ]  # fmt: skip
    for side in (-1, 1):
        for name, make, gap in posts[: 5 if style.pavement_m else 1]:
            for along in _stops(rng, street, rng.uniform(4, 20), gap * rng.uniform(0.7, 2), 12.0):
                at, yaw = street.stand(along, side * (kerb + rng.uniform(0, 0.3)))
                faces_us = name == "sign" and side > 0
                objects += assemble(name, make(rng), at, yaw + (0 if faces_us or side < 0 else 180))
        if style.rails:
            objects += _rail(street, side, style.half_m + 0.7)
    if style.rails:
        objects += _rail(street, 1, 0.0)
    return objects


def _rail(street: Street, side: int, right_m: float) -> list[SceneObject]:
    beam = [(right_m, 0.45), (right_m - 0.06, 0.52), (right_m, 0.6), (right_m - 0.06, 0.68), (right_m, 0.75)]
    objects = [_swept("guard rail", street, beam, things.STEEL, side=side)]
    for along in np.arange(0, 100, 4.0):
        at, yaw = street.stand(along, side * (right_m + 0.08))
        objects += assemble("post", [Part("box", (0.1, 0.1, 0.72), (0, 0, 0), things.STEEL)], at, yaw)
    return objects


def people(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """People on the pavements, and now and then one who crosses."""
    objects = []
    for _ in range(int(rng.integers(0, style.people + 1))):
        crossing = rng.random() < 0.08
        right = rng.uniform(-1, 1) * style.half_m if crossing else rng.choice([-1, 1]) * (style.half_m + rng.uniform(0.3, 0.95) * max(style.pavement_m, 1))
        at, yaw = street.stand(rng.uniform(7, 60), right, 0.0 if crossing else _KERB_UP_M)
        objects += assemble("person", things.person(rng), at, yaw + rng.choice([0, 180]) + (90 if crossing else rng.normal(0, 20)))
    return objects
