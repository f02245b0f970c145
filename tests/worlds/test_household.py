"""Rooms: nothing floats, collides or swallows the camera, whatever the numbers."""

import subprocess
import sys
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from depthreg.data.sample import Frame
from depthreg.errors import InputError
from depthreg.rendering import Camera, render_frame
from depthreg.worlds import HouseholdWorld, cupboards, furniture, household, small_things, wall_things
from depthreg.worlds.floorplan import Floorplan, Pose
from depthreg.worlds.furniture import Surface
from depthreg.worlds.interior import draw_palette
from depthreg.worlds.poses import camera_from_world
from depthreg.worlds.scene import Light, Material, Scene, SceneObject
from depthreg.worlds.shapes import Part, assemble, join
from tests.worlds.test_blocks import fingerprint

CAMERA = Camera(width=97, height=73, focal_px=80.0, margin_px=2)
INDICES = range(12)
SHELL = ("floor", "wall", "ceiling")
MAKERS = [
    *(furniture.table, furniture.chair, furniture.sofa, furniture.armchair, furniture.lounge, furniture.bed),
    *(furniture.side_table, furniture.carton, furniture.floor_lamp, furniture.plant, furniture.dining_group),
    *(cupboards.bookcase, cupboards.chest, cupboards.wardrobe, cupboards.fridge, cupboards.counter),
    *(cupboards.desk, cupboards.television),
]


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [HouseholdWorld()(11, index) for index in INDICES]


@pytest.fixture(scope="module")
def frames(scenes: list[Scene]) -> list[Frame]:
    return [render_frame(scene, CAMERA, None, right=False) for scene in scenes]


def _room(scene: Scene) -> np.ndarray:
    """Inner size of a room, from its outer walls of 12 cm and its floor."""
    floor, ceiling = (next(o.mesh for o in scene.objects if o.name == name) for name in ("floor", "ceiling"))
    width, depth = floor.bounds[1, :2] - 0.12
    return np.array([width, depth, ceiling.bounds[0, 2]])


def test_every_pixel_sees_something_in_the_room(scenes: list[Scene], frames: list[Frame]) -> None:
    for scene, frame in zip(scenes, frames, strict=True):
        assert frame.depth_m.min() > 0.2
        assert frame.depth_m.max() < np.linalg.norm(_room(scene))


def _boxes(parts: list[Part]) -> np.ndarray:
    """Least and largest coordinates of the boxes that aren't turned, (N, 2, 3)."""
    upright = [part for part in parts if part.shape == "box" and part.yaw_deg % 180 == 0]
    return np.array([np.multiply(p.size_m, [(-0.5, -0.5, 0), (0.5, 0.5, 1)]) + p.at_m for p in upright]).reshape(
        -1, 2, 3
    )


def _share_a_plane(boxes: np.ndarray, side: int, axis: int) -> bool:
    """Whether the sides of two boxes overlap in one plane where no other box covers them."""
    others = [k for k in range(3) if k != axis]
    for first, second in combinations(boxes, 2):
        low, high = np.maximum(first[0], second[0]), np.minimum(first[1], second[1])
        if abs(first[side, axis] - second[side, axis]) < 1e-6 and (high - low)[others].min() > 1e-4:
            before = (low + high) / 2
            before[axis] = first[side, axis] + (1e-4 if side else -1e-4)
            if not ((boxes[:, 0] < before) & (before < boxes[:, 1])).all(axis=1).any():
                return True
    return False


def test_faces_in_view_do_not_lie_in_one_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which of them is in front would be chance, and path tracers draw them black."""
    things = []

    def record(name: str, parts: list[Part], *where: Any, **turned: Any) -> list[SceneObject]:
        things.append((name, _boxes(parts)))
        return assemble(name, parts, *where, **turned)

    for module in (household, wall_things):
        monkeypatch.setattr(module, "assemble", record)
    for index in INDICES:
        HouseholdWorld()(11, index)
    visible = [(0, 0), (1, 0), (1, 1), (1, 2)]  # left, right, front, top; backs are at the wall
    assert len(things) > 100
    assert not {name for name, boxes in things for side, axis in visible if _share_a_plane(boxes, side, axis)}


def test_depths_are_those_of_a_room(frames: list[Frame]) -> None:
    medians = [np.median(frame.depth_m) for frame in frames]
    assert 1.0 < np.median(medians) < 5.0
    assert np.median([len(np.unique(frame.object_id)) for frame in frames]) > 12


def test_the_camera_is_in_the_room_and_in_no_object(scenes: list[Scene]) -> None:
    for scene in scenes:
        eye = np.linalg.inv(scene.camera_from_world)[:3, 3]
        assert (eye > 0.3).all()
        assert (eye < _room(scene) - 0.3).all()
        assert 0.8 <= eye[2] <= 1.8
        for thing in (o for o in scene.objects if o.name not in SHELL):
            low, high = thing.mesh.bounds
            assert ((eye < low) | (eye > high)).any(), thing.name


def test_everything_is_inside_the_room(scenes: list[Scene]) -> None:
    for scene in scenes:
        for thing in (o for o in scene.objects if o.name not in SHELL):
            low, high = thing.mesh.bounds
            assert (low > -0.02).all(), thing.name  # skirting and handles may enter the plaster
            assert (high < _room(scene) + 0.02).all(), thing.name


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_furniture_stands_on_the_floor_within_the_box_that_it_claims(make: furniture) -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        piece = make(rng, draw_palette(rng))
        low, high = join(piece.parts).bounds
        assert low[2] == 0
        assert high[2] <= piece.height_m + 0.01
        slack = 0.02 if piece.name != "lounge" else 0.5  # a rug may lie under its neighbours
        assert max(-low[0], high[0]) <= piece.width_m / 2 + slack
        assert low[1] >= -slack
        assert high[1] <= piece.depth_m + slack


def test_small_things_stand_on_their_surface_and_do_not_stick_out() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        parts = small_things.scatter(rng, draw_palette(rng), Surface((1.0, 2.0, 0.7), 0.9, 0.6), tries=10)
        low, high = join(parts).bounds
        assert low[2] == pytest.approx(0.7)
        assert (low[:2] > [0.5, 1.65]).all()
        assert (high[:2] < [1.5, 2.35]).all()


def _footprint(width: float, depth: float, pose: Pose) -> np.ndarray:
    (thing,) = assemble("piece", [Part("box", (width, depth, 1.0), (0, depth / 2, 0), Material((1, 1, 1)))], *pose)
    return thing.mesh.bounds[:, :2]


def test_footprints_on_a_floorplan_never_overlap_and_stay_in_the_room() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        plan, prints = Floorplan(4.1, 5.3), []
        for _ in range(15):
            width, depth = rng.uniform(0.3, 1.5, 2)
            pose = plan.along_wall(rng, width, depth, 0.0, 1.0)
            prints += [] if pose is None else [_footprint(width, depth, pose)]
        pose = plan.in_the_open(rng, 0.5, 0.4, clearance_m=0.2)
        prints += [] if pose is None else [_footprint(0.5, 0.4, pose)]
        assert len(prints) > 4
        for low, high in prints:
            assert (low > -1e-9).all()
            assert (high < np.array([4.1, 5.3]) + 1e-9).all()
        for (low, high), (other_low, other_high) in combinations(prints, 2):
            assert (low >= other_high).any() or (other_low >= high).any()


def test_hung_things_leave_the_floor_free_but_not_the_wall() -> None:
    plan, rng = Floorplan(3.0, 3.0), np.random.default_rng(0)
    hung = [plan.along_wall(rng, 2.9, 0.3, 1.0, 2.0) for _ in range(20)]
    assert sum(pose is not None for pose in hung) == 4  # one on each wall
    standing = [plan.along_wall(rng, 1.0, 0.3, 0.0, 0.9) for _ in range(20)]
    assert any(standing)
    assert not any(plan.along_wall(rng, 1.0, 0.3, 0.0, 1.1) for _ in range(20))


def test_standing_places_keep_their_distance() -> None:
    plan, rng = Floorplan(4.0, 4.0), np.random.default_rng(3)
    pose = plan.in_the_open(rng, 1.0, 1.0, clearance_m=0.0)
    assert pose is not None
    low, high = _footprint(1.0, 1.0, pose)
    places = plan.standing_places(0.5)
    nearest = np.clip(places, low, high)
    assert np.linalg.norm(places - nearest, axis=1).min() >= 0.5
    assert (places >= 0.5 - 1e-9).all() and (places <= 3.5 + 1e-9).all()


def test_a_full_room_still_has_a_standing_place() -> None:
    plan = Floorplan(2.0, 2.0)
    assert plan.in_the_open(np.random.default_rng(0), 1.0, 1.0, clearance_m=0.0) is not None
    assert len(plan.standing_places(0.9)) >= 1


def _lamp_scene(*things: Part) -> Scene:
    """A grey floor 2 m below a lamp, seen from straight above the lamp."""
    objects = [o for part in things for o in assemble("thing", [part])]
    objects += assemble("floor", [Part("box", (20, 20, 1), (0, 0, -1), Material((0.5, 0.5, 0.5)))])
    light = Light(np.array([0.0, 0.0, 1.0]), (1.0, 0.8, 0.6), (0.0, 0.0, 0.0), lamp_m=(0.0, 0.0, 2.0))
    return Scene(objects, light, camera_from_world((0.0, 0.0, 4.0), pitch_deg=90.0))


def test_a_floor_two_metres_below_the_lamp_reflects_its_stated_light() -> None:
    frame = render_frame(_lamp_scene(), Camera(21, 15, 80.0), None, right=False)
    expected = 255 * (0.5 * np.array([1.0, 0.8, 0.6])) ** (1 / 2.2)
    np.testing.assert_allclose(frame.rgb[7, 10], expected, atol=1.5)


def test_a_lamp_throws_shadows_as_similar_triangles_say() -> None:
    # A plate 1 m square, half way up to the lamp, shades a square of 2 m on the floor.
    plate = Part("box", (1.0, 1.0, 0.01), (0, 0, 1.0), Material((0.0, 0.0, 0.0)))
    frame = render_frame(_lamp_scene(plate), Camera(121, 121, 80.0), None, right=False)
    on_floor_m = (np.arange(121) - 60) / 80 * 4
    lit = frame.rgb[60, :, 0] > 20
    clear = np.abs(np.abs(on_floor_m) - 1.0) > 0.1  # the shadow's edge falls within a pixel or two
    np.testing.assert_array_equal(lit[clear], (np.abs(on_floor_m) > 1.0)[clear])


def test_the_same_numbers_give_the_same_scene_in_another_process() -> None:
    code = (
        "from tests.worlds.test_blocks import fingerprint; from depthreg.worlds import HouseholdWorld;"
        "print(fingerprint(HouseholdWorld()(5, 6)))"
    )
    root = __file__.rsplit("/tests/", 1)[0]
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert other.stdout.strip() == fingerprint(HouseholdWorld()(5, 6))


def test_every_index_and_every_seed_gives_another_scene() -> None:
    assert len({fingerprint(HouseholdWorld()(seed, index)) for seed in range(2) for index in range(3)}) == 6


def test_a_room_too_small_to_stand_in_is_refused() -> None:
    with pytest.raises(InputError, match="min_side_m=1"):
        HouseholdWorld(min_side_m=1.0)
