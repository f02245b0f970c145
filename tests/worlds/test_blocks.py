"""The blocks world: what its frames must hold, whatever the numbers."""

import hashlib
import subprocess
import sys

import numpy as np
import pytest

from depthreg.data.sample import Frame
from depthreg.errors import InputError
from depthreg.rendering import Camera, hdl64, render_frame
from depthreg.worlds import BlocksWorld
from depthreg.worlds.scene import Scene

CAMERA = Camera(width=125, height=37, focal_px=72.0, margin_px=3)  # KITTI's field of view


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [render_frame(BlocksWorld()(7, index), CAMERA, hdl64(), right=False) for index in range(12)]


def fingerprint(scene: Scene) -> str:
    digest = hashlib.sha256(scene.camera_from_world.tobytes() + repr(scene.light).encode())
    for thing in scene.objects:
        digest.update(thing.mesh.vertices.tobytes() + thing.mesh.faces.tobytes() + repr(thing.material).encode())
    return digest.hexdigest()


def test_every_depth_is_the_centre_of_one_of_20_bins_of_6_metres(frames: list[Frame]) -> None:
    centres_m = 6.0 * (np.arange(20) + 0.5)
    for frame in frames:
        assert np.isin(frame.depth_m, centres_m).all()
        assert np.isin(frame.lidar.depth_m, centres_m).all()


def test_bins_follow_the_configuration() -> None:
    frame = render_frame(BlocksWorld(max_depth_m=60.0, bins=8)(1, 2), CAMERA, None, right=False)
    assert np.isin(frame.depth_m, 7.5 * (np.arange(8) + 0.5)).all()


def test_a_wide_camera_sees_no_gap_either() -> None:
    wide = Camera(width=61, height=47, focal_px=30.0)
    assert (render_frame(BlocksWorld()(0, 0), wide, None, right=False).depth_m > 0).all()


def test_depths_are_spread_over_many_bins(frames: list[Frame]) -> None:
    used = [np.unique(frame.depth_m) for frame in frames]
    assert np.mean([len(bins) for bins in used]) > 8
    assert len(np.unique(np.concatenate(used))) >= 17


def test_depth_edges_lie_in_all_quarters_of_the_image(frames: list[Frame]) -> None:
    quarters = np.zeros(4)
    for frame in frames:
        steps = np.abs(np.diff(frame.depth_m, axis=1)[:36]) > 6  # across the columns: edges of things, not of bins
        quarters += [part.mean() for half in np.split(steps, 2) for part in np.split(half, 2, axis=1)]
    assert quarters.min() > 0.25 * quarters.max()


def test_the_sun_reaches_the_scene() -> None:
    for index in range(20):
        scene = BlocksWorld()(2, index)
        assert scene.light.sun_direction[1] < 0  # the wall stands at large y
        assert np.linalg.norm(scene.light.sun_direction) == pytest.approx(1.0)


def test_things_stand_on_the_floor() -> None:
    for index in range(5):
        for thing in BlocksWorld()(3, index).objects:
            if thing.name not in ("floor", "gate"):  # a gate's beam lies on its posts
                assert thing.mesh.bounds[0, 2] == 0


def test_the_same_numbers_give_the_same_scene_in_another_process() -> None:
    code = (
        "from tests.worlds.test_blocks import fingerprint; from depthreg.worlds import BlocksWorld;"
        "print(fingerprint(BlocksWorld()(5, 6)))"
    )
    root = __file__.rsplit("/tests/", 1)[0]
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert other.stdout.strip() == fingerprint(BlocksWorld()(5, 6))


def test_every_index_and_every_seed_gives_another_scene() -> None:
    prints = {fingerprint(BlocksWorld()(seed, index)) for seed in range(3) for index in range(4)}
    assert len(prints) == 12


def test_a_world_without_room_is_refused() -> None:
    with pytest.raises(InputError, match="bins=0"):
        BlocksWorld(bins=0)
