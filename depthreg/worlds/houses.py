"""Houses along a street, and what encloses their gardens."""

from dataclasses import dataclass

import numpy as np

from depthreg.worlds.scene import RGB, Material, SceneObject
from depthreg.worlds.shapes import Part, Vector, assemble
from depthreg.worlds.street import Street, StreetStyle, swept
from depthreg.worlds.street_objects import GLASS, LEAVES, pick, tinted

_WALLS: tuple[RGB, ...] = (
    (0.5, 0.46, 0.36), (0.55, 0.53, 0.48), (0.42, 0.4, 0.37), (0.5, 0.38, 0.22), (0.4, 0.24, 0.16), (0.3, 0.13, 0.09),
    (0.36, 0.36, 0.34),
)  # fmt: skip
_ROOFS: tuple[RGB, ...] = ((0.22, 0.09, 0.06), (0.12, 0.1, 0.095), (0.07, 0.07, 0.075))
_DOORS: tuple[RGB, ...] = ((0.1, 0.05, 0.025), (0.03, 0.06, 0.04), (0.45, 0.44, 0.42), (0.03, 0.03, 0.035))
_FASCIAS: tuple[RGB, ...] = ((0.3, 0.03, 0.03), (0.03, 0.1, 0.25), (0.05, 0.2, 0.08), (0.5, 0.45, 0.3))
_STONE = Material((0.2, 0.19, 0.18), "plaster", (0.12, 0.12, 0.11), 4.0)


@dataclass(frozen=True)
class _Plan:
    """Size of a house in bays of windows; its front is the plane x = 0 and its middle is y = 0."""

    bays: int
    storeys: int
    bay_m: float  # a bay is as high as it is wide

    @property
    def width_m(self) -> float:
        return self.bays * self.bay_m

    @property
    def depth_m(self) -> float:
        return 3 * self.bay_m

    @property
    def height_m(self) -> float:
        return self.storeys * self.bay_m

    def bay_at_m(self, number: int) -> float:
        """Where the middle of a bay is along the front."""
        return (number + 0.5 - self.bays / 2) * self.bay_m


def _house(rng: np.random.Generator, plan: _Plan, corner_m: Vector) -> list[Part]:
    """A house; windows are counted from `corner_m`, one of its corners in the world."""
    fronts = ["windows", "shuttered_windows"] if plan.storeys < 3 else ["windows", "wide_windows", "ribbon_windows"]
    front = fronts[rng.choice(len(fronts), p=[0.5, 0.5] if len(fronts) == 2 else [0.5, 0.3, 0.2])]
    wall = Material(
        tinted(rng, pick(rng, _WALLS)), front, (0.03, 0.035, 0.04), plan.bay_m, gloss=0.8, origin_m=corner_m
    )
    middle = plan.depth_m / 2
    return [
        Part("box", (plan.depth_m, plan.width_m, plan.height_m + 1), (middle, 0, -1), wall),
        Part("box", (plan.depth_m + 0.08, plan.width_m + 0.08, 1.5), (middle, 0, -1), _STONE),
        *_roof(rng, plan),
        *_ground_floor(rng, plan),
        *(_balconies(rng, plan) if plan.storeys > 2 and rng.random() < 0.3 else []),
    ]


def _roof(rng: np.random.Generator, plan: _Plan) -> list[Part]:
    """A flat roof's parapet, or tiles and a chimney."""
    middle, top = plan.depth_m / 2, plan.height_m
    if plan.storeys > 3 and rng.random() < 0.6:
        return [Part("box", (plan.depth_m + 0.3, plan.width_m + 0.3, 0.5), (middle, 0, top), _STONE)]
    tiles = Material(tinted(rng, pick(rng, _ROOFS)), "roof_tiles", (0.09, 0.09, 0.07), 0.35)
    rise = rng.uniform(0.32, 0.5) * plan.depth_m
    shape = "gable" if rng.random() < 0.7 else "hip"
    chimney_at = (middle + 1.2, rng.uniform(-0.3, 0.3) * plan.width_m, top)
    return [
        Part(shape, (plan.depth_m + 0.9, plan.width_m + 0.6, rise), (middle, 0, top), tiles),
        Part("box", (0.6, 0.8, rise + 0.6), chimney_at, _STONE),
    ]


def _ground_floor(rng: np.random.Generator, plan: _Plan) -> list[Part]:
    """A door, and in higher houses perhaps a shop: wide panes under a fascia."""
    wood = Material(tinted(rng, pick(rng, _DOORS)), gloss=0.1)
    at = plan.bay_at_m(int(rng.integers(plan.bays)))
    parts = [Part("box", (0.2, 1.5, 2.55), (0, at, 0), _STONE), Part("box", (0.26, 1.1, 2.2), (0, at, 0.15), wood)]
    if plan.storeys > 2 and rng.random() < 0.5:
        fascia = Material(tinted(rng, pick(rng, _FASCIAS)))
        parts.append(Part("box", (0.1, plan.width_m - 0.4, 2.45), (0, 0, 0), _STONE))
        parts.append(Part("box", (0.3, plan.width_m - 0.6, 0.5), (0, 0, 2.4), fascia))
        for bay in range(plan.bays):
            parts.append(Part("box", (0.14, 0.78 * plan.bay_m, 1.8), (0, plan.bay_at_m(bay), 0.5), GLASS))
    return parts


def _balconies(rng: np.random.Generator, plan: _Plan) -> list[Part]:
    """One balcony on each upper storey, above each other or not."""
    bays = rng.integers(plan.bays, size=plan.storeys)
    return [
        Part("box", (1.1, 0.8 * plan.bay_m, 1.0), (-0.5, plan.bay_at_m(bays[n]), n * plan.bay_m + 0.05), _STONE)
        for n in range(1, plan.storeys)
    ]


def houses(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Houses along both sides, with gardens and what encloses them."""
    objects: list[SceneObject] = []
    for side in (-1, 1):
        along = street.behind_m + rng.uniform(0, 10)
        while style.houses and along < street.ahead_m - 30:
            if rng.random() > style.houses:
                along += rng.uniform(8, 25)
                continue
            storeys = int(rng.integers(style.storeys[0], style.storeys[1] + 1))
            plan = _Plan(int(rng.integers(3, 7)), storeys, float(rng.uniform(2.7, 3.2)))
            front, gap = style.border_m + rng.uniform(*style.front_m), rng.uniform(0, style.house_gap_m)
            up = 0.1 + street.land_up_m(side, front - style.border_m)
            at, yaw = street.stand(along + plan.width_m / 2, side * front, up)
            yaw += 0 if side > 0 else 180
            turn = np.deg2rad(yaw)
            half = plan.width_m / 2
            corner = (at[0] + np.sin(turn) * half, at[1] - np.cos(turn) * half, at[2])
            objects += assemble("house", _house(rng, plan, corner), at, yaw)
            if rng.random() < style.fence and front - style.border_m > 1.5:
                reach = (along - gap / 2, along + plan.width_m + gap / 2)
                objects.append(_enclosure(rng, street, side, style.border_m + 0.3, reach))
            along += plan.width_m + gap
    return objects


def _enclosure(
    rng: np.random.Generator, street: Street, side: int, right_m: float, reach_m: tuple[float, float]
) -> SceneObject:
    """A hedge, wall or fence along a garden."""
    leaf, second_leaf = LEAVES[rng.integers(3)]
    surface, thick = [
        (Material(leaf, "foliage", second_leaf, 1.6, seed=int(rng.integers(99))), 0.7),
        (Material(tinted(rng, (0.3, 0.15, 0.1)), "brick", (0.35, 0.33, 0.3), 0.24), 0.25),
        (Material(tinted(rng, (0.28, 0.26, 0.23)), "stones", (0.18, 0.17, 0.15), 0.5), 0.35),
        (Material(tinted(rng, (0.2, 0.13, 0.08)), "stripes", (0.1, 0.07, 0.045), 0.3), 0.06),
    ][rng.integers(4)]
    tall = float(rng.uniform(0.8, 1.9))
    profile = [(right_m, -0.2), (right_m, tall), (right_m + thick, tall), (right_m + thick, -0.2)]
    return swept("enclosure", street, profile, surface, side=side, reach_m=reach_m)
