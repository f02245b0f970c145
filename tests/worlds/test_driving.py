import hashlib
import pickle
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from depthreg.errors import InputError
from depthreg.rendering import Camera, hdl64, render_frame
from depthreg.worlds import DrivingWorld
from depthreg.worlds.driving import STYLES
from depthreg.worlds.scene import Scene
from depthreg.worlds.street import Street

CAMERA = Camera(width=97, height=31, focal_px=56.0, margin_px=3)
_DIGEST = """
import hashlib
from depthreg.rendering import Camera, hdl64, render_frame
from depthreg.worlds import DrivingWorld
frame = render_frame(DrivingWorld()(7, 3), Camera(97, 31, 56.0, margin_px=3), hdl64())
parts = (frame.rgb, frame.rgb_right, frame.depth_m, frame.object_id, frame.normal, *vars(frame.lidar).values())
print(hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest())
"""


def _of(scene: Scene, name: str) -> list[np.ndarray]:
    return [np.asarray(o.mesh.vertices) for o in scene.objects if o.name == name]


def test_the_same_numbers_give_the_same_frame_in_another_process() -> None:
    render_frame(DrivingWorld()(1, 1), CAMERA, hdl64())  # what was drawn before must not matter
    frame = render_frame(pickle.loads(pickle.dumps(DrivingWorld()))(7, 3), CAMERA, hdl64())
    parts = (frame.rgb, frame.rgb_right, frame.depth_m, frame.object_id, frame.normal, *vars(frame.lidar).values())
    digest = hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()
    other = subprocess.run([sys.executable, "-c", _DIGEST], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == digest


def test_seed_and_index_both_change_the_scene() -> None:
    poses = {DrivingWorld()(seed, index).camera_from_world.tobytes() for seed in range(3) for index in range(3)}
    assert len(poses) == 9


@pytest.mark.parametrize("style", sorted(STYLES))
def test_the_camera_rides_in_its_lane_at_its_height(style: str) -> None:
    for index in range(4):
        scene = DrivingWorld(styles=(style,))(0, index)
        position = np.linalg.inv(scene.camera_from_world)[:3, 3]
        assert position[2] == pytest.approx(1.65, abs=0.25)
        assert 0 < position[0] < STYLES[style].lanes * STYLES[style].lane_m
        lidar = np.linalg.inv(scene.lidar_from_camera)[:3, 3]
        np.testing.assert_allclose(lidar, [0.056, -0.075, -0.272])  # KITTI's calibration of its left colour camera
        turned = Rotation.from_matrix(scene.lidar_from_camera[:3, :3] @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
        assert 0.1 < np.rad2deg(turned.magnitude()) < 1.5  # it says 0.6 to 0.9 degrees


@pytest.mark.parametrize("style", sorted(STYLES))
def test_nothing_blocks_the_lens(style: str) -> None:
    for index in range(4):
        frame = render_frame(DrivingWorld(styles=(style,))(1, index), CAMERA, None, right=False)
        seen = frame.depth_m[frame.depth_m > 0]
        assert seen.min() > 1.5
        assert (seen < 6).mean() < 0.6
        assert 0.4 < (frame.depth_m > 0).mean() <= 1


def test_streets_hold_what_streets_hold() -> None:
    names = {o.name for style in STYLES for i in range(3) for o in DrivingWorld(styles=(style,))(0, i).objects}
    expected = {"road", "marking", "kerb", "pavement", "verge", "house", "car", "lorry", "person"}
    expected |= {"tree", "bush", "lamp", "pole", "sign", "enclosure", "guard rail"}
    assert expected <= names


def test_cars_have_the_size_of_cars_and_stand_on_the_road() -> None:
    scene = DrivingWorld(styles=("city",))(0, 1)
    position = np.linalg.inv(scene.camera_from_world)[:3, 3]
    frame_objects = [o for o in scene.objects if o.name == "car" and o.material.color[0] == 0.012]  # tyres
    assert len(frame_objects) > 10
    for tyres in frame_objects:
        low, high = tyres.mesh.bounds
        wheelbase = np.hypot(*(high - low)[:2])
        assert 2.5 < wheelbase < 5.0
        if abs(low[1] - position[1]) < 20:  # the road is about level here
            assert low[2] == pytest.approx(0, abs=0.3)


def test_the_road_lies_under_the_camera_and_things_stand_beside_it() -> None:
    scene = DrivingWorld(styles=("suburb",))(2, 0)
    half = STYLES["suburb"].half_m
    for house in _of(scene, "house"):
        near = house[np.abs(house[:, 1]) < 15]
        assert (np.abs(near[:, 0]) > half).all()


def test_pictures_have_the_tones_of_photographs() -> None:
    frames = [render_frame(DrivingWorld()(5, i), CAMERA, None, right=False) for i in range(8)]
    for frame in frames:
        grey = frame.rgb.astype(float).mean(-1)
        assert 40 < grey.mean() < 215
        assert grey.std() > 20
    colours = np.concatenate([f.rgb[3:-3, 3:-3][f.object_id >= 0] for f in frames]).astype(float)
    assert (colours.max(1) - colours.min(1)).mean() < 60  # muted: no confetti


def test_a_straight_level_street_runs_along_y() -> None:
    street = Street.winding(curvature_per_m=0.0, bend_m=50.0, slope=0.0, behind_m=-20.0, ahead_m=100.0)
    np.testing.assert_allclose(
        street.points(np.array([0.0, 60.5]), np.array([0.0, 3.0]), 0.5), [[0, 0, 0.5], [3, 60.5, 0.5]]
    )


def test_a_bend_has_the_curvature_asked_for() -> None:
    street = Street.winding(curvature_per_m=1 / 200, bend_m=1e6, slope=0.0, behind_m=-20.0, ahead_m=100.0)
    at, yaw_deg = street.stand(50.0, 0.0)
    assert yaw_deg == pytest.approx(np.rad2deg(50 / 200), abs=0.01)
    np.testing.assert_allclose(at[:2], [-200 * (1 - np.cos(0.25)), 200 * np.sin(0.25)], atol=0.3)
    forward = Rotation.from_euler("z", yaw_deg, degrees=True).apply([0, 1, 0])
    ahead = np.array(street.stand(50.5, 0.0)[0]) - np.array(street.stand(49.5, 0.0)[0])
    np.testing.assert_allclose(ahead, forward, atol=0.02)


def test_a_swept_strip_has_the_area_of_a_ring_sector() -> None:
    street = Street.winding(curvature_per_m=1 / 200, bend_m=1e6, slope=0.0, behind_m=-20.0, ahead_m=100.0)
    strip = street.sweep([(2.0, 0.0), (5.0, 0.0)], 0.0, 80.0)
    assert strip.area == pytest.approx(0.5 * (205**2 - 202**2) * 80 / 200, rel=0.01)
    assert (strip.face_normals[:, 2] > 0.999).all()


def test_trees_stand_on_the_land_whatever_its_bank() -> None:
    street = Street.winding(0.0, 50.0, 0.0, behind_m=-20.0, ahead_m=100.0, banks_m=(-1.0, 2.0))
    assert street.land_up_m(1, 0.0) == street.land_up_m(-1, 0.0) == 0.0
    assert street.land_up_m(1, 4.0) == pytest.approx(1.0)  # half way up the bank
    assert street.land_up_m(-1, 8.0) == pytest.approx(-1.0)
    scene = DrivingWorld(styles=("motorway",))(0, 2)
    land = trimesh.util.concatenate([o.mesh for o in scene.objects if o.name in ("land", "verge")])
    trunks = [o.mesh for o in scene.objects if o.name == "tree" and o.material.pattern == "bark"]
    feet = np.array([[*mesh.bounds.mean(axis=0)[:2], mesh.bounds[0, 2]] for mesh in trunks])
    above, ray, _ = land.ray.intersects_location(
        feet + np.array([0, 0, 50]), np.tile([0.0, 0, -1], (len(feet), 1)), False
    )
    assert len(ray) > 0.9 * len(feet)
    np.testing.assert_allclose(above[:, 2] - feet[ray, 2], 0.5, atol=0.25)  # trunks reach half a metre down


def test_coarse_leaves_and_a_short_street_leave_less_to_build() -> None:
    full, small = DrivingWorld(styles=("motorway",)), DrivingWorld(("motorway",), ahead_m=120.0, coarse_leaves=True)
    faces = [sum(len(o.mesh.faces) for o in world(0, 1).objects) for world in (full, small)]
    assert faces[1] < 0.6 * faces[0]
    # Both are the same kind of place: road to the horizon, trees beside it.
    frame = render_frame(small(0, 1), CAMERA, None, right=False)
    assert frame.depth_m.max() > 150
    assert {"tree", "road", "car"} <= {o.name for o in small(0, 1).objects}


def test_unknown_streets_and_lengths_are_refused() -> None:
    with pytest.raises(InputError, match=r"world\.styles.*village"):
        DrivingWorld(styles=("city", "village"))
    with pytest.raises(InputError, match=r"world\.ahead_m"):
        DrivingWorld(ahead_m=1000.0)
