"""The ground of a street: road and markings, kerbs, pavements, verges, the land beyond, and the horizon."""

import numpy as np
import trimesh

from depthreg.worlds.scene import Material, SceneObject
from depthreg.worlds.shapes import Part, assemble
from depthreg.worlds.street import HORIZON_M, Street, StreetStyle, grid_faces, swept
from depthreg.worlds.street_objects import tinted

KERB_UP_M = 0.12
_BACKDROP_M = 245.0  # just within what counts as depth
_MARKING = Material((0.55, 0.55, 0.52), "asphalt", (0.4, 0.4, 0.38), 2.0)


def roadway(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """The carriageway and its markings."""
    grey = tinted(rng, (0.1, 0.098, 0.095), 0.3)
    asphalt = Material(grey, "asphalt", tinted(rng, (0.135, 0.132, 0.128), 0.3), rng.uniform(3.5, 6))
    half = style.half_m
    objects = [swept("road", street, [(-half, 0), (0, 0.04), (half, 0)], asphalt)]
    edge = half - style.parking_m - 0.25
    line = [(edge - 0.07, 0.012), (edge + 0.07, 0.012)]
    if style.pavement_m == 0 or rng.random() < 0.3:
        objects += [swept("marking", street, line, _MARKING, side=side) for side in (-1, 1)]
    length, gap = (6.0, 12.0) if style.rails else (3.0, 5.0)
    starts = np.arange(street.behind_m + rng.uniform(0, gap), HORIZON_M - length, length + gap)
    for lane in range(1 - style.lanes, style.lanes):
        dashes = street.dashes(lane * style.lane_m, 0.14, 0.055, starts, length)
        objects.append(SceneObject("marking", dashes, _MARKING))
    return objects + _repairs(rng, street, style)


def _repairs(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Patches of newer asphalt, and manhole covers."""
    dark = Material((0.055, 0.055, 0.058), "asphalt", (0.07, 0.07, 0.07), 3.0)
    iron = Material((0.05, 0.048, 0.045), "checker", (0.09, 0.085, 0.08), 0.1)
    objects: list[SceneObject] = []
    for _ in range(rng.integers(0, 5)):
        at, _ = street.stand(rng.uniform(4, 60), rng.uniform(-0.8, 0.8) * style.half_m, 0.035)
        if rng.random() < 0.5:
            objects += assemble("manhole", [Part("cylinder", (0.65, 0.65, 0.012), (0, 0, 0), iron)], at)
        else:
            along, right = rng.uniform(4, 50), rng.uniform(-0.6, 0.6) * style.half_m
            patch = [(right, 0.044), (right + rng.uniform(0.5, 1.5), 0.044)]
            objects.append(swept("patch", street, patch, dark, reach_m=(along, along + rng.uniform(1, 12))))
    return objects


def roadside(rng: np.random.Generator, street: Street, style: StreetStyle) -> list[SceneObject]:
    """Kerbs, pavements, verges and the land beyond, on both sides."""
    grass = Material(tinted(rng, (0.065, 0.105, 0.022)), "grass", tinted(rng, (0.19, 0.17, 0.06)), rng.uniform(3, 6))
    land = grass if rng.random() < 0.7 else Material((0.14, 0.1, 0.06), "gravel", (0.2, 0.16, 0.1), 5.0)
    slab = Material(tinted(rng, (0.22, 0.21, 0.19)), "paving", (0.18, 0.17, 0.16), rng.uniform(0.25, 0.5))
    kerb = Material((0.26, 0.26, 0.25), "concrete", (0.15, 0.15, 0.14), 1.0)
    half, objects = style.half_m, []
    for side in (-1, 1):
        up, inner = 0.0, half
        if style.pavement_m:
            up, inner = KERB_UP_M, half + style.pavement_m
            stone = [(half, 0.0), (half, up), (half + 0.16, up)]
            objects.append(swept("kerb", street, stone, kerb, side=side))
            objects.append(swept("pavement", street, [(half + 0.16, up), (inner, up)], slab, side=side))
        edge = style.border_m
        verge = [(inner, up - 0.01), (inner + 0.3 * style.verge_m, up + 0.03), (edge, up)]
        objects.append(swept("verge", street, verge, grass, side=side))
        field = [(edge + beside, up + street.land_up_m(side, beside)) for beside in (0.0, 8.0, 35.0, 100.0)]
        objects.append(swept("land", street, field, land, side=side))
    return objects


def backdrop(rng: np.random.Generator, street: Street) -> SceneObject:
    """A ragged line of far woods and hills behind everything."""
    angle = np.deg2rad(np.arange(-80, 80, 0.35))
    hills = np.interp(angle, np.linspace(-1.4, 1.4, 12), rng.uniform(1, 14, 12))
    ragged = np.repeat(rng.normal(0, 1.3, len(angle) // 3 + 1), 3)[: len(angle)] + rng.normal(0, 0.5, len(angle))
    top = street.xyz_m[-1, 2] + 4 + hills + ragged
    x, y = _BACKDROP_M * np.sin(angle), _BACKDROP_M * np.cos(angle)
    vertices = np.concatenate([np.stack([x, y, z], axis=1) for z in (np.full(len(angle), -25.0), top)])
    green = tinted(rng, (0.05, 0.075, 0.04))
    wood = Material(green, "foliage", (0.08, 0.1, 0.05), 15.0, seed=int(rng.integers(99)), variation=0.25)
    return SceneObject("hills", trimesh.Trimesh(vertices, grid_faces(2, len(angle)), process=False), wood)
