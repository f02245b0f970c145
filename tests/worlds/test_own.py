"""A user's own scene file against closed forms: boxes of known size and place, pictures of known colours."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.transformations import translation_matrix
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from depthreg.rendering import Camera, Cycles, Renderer, render_frame
from depthreg.worlds import OwnWorld

CAMERA = Camera(width=53, height=37, focal_px=45.0, center_px=(26, 18))
AHEAD = {"camera_position": (1.0, 0.0, 1.5), "look_at": (1.0, 10.0, 1.5)}
ORANGE, TEAL = (230, 120, 20), (10, 130, 140)


@pytest.fixture
def box_path(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A box 2 m wide, its front 4 m ahead of the world's origin, its middle 1 m right of and 1.5 m above it."""
    kind, up = request.param
    box = trimesh.creation.box(extents=(2, 1, 2) if up == "z" else (2, 2, 1))
    place = (1, 4.5, 1.5) if up == "z" else (1, 1.5, -4.5)
    path = tmp_path / f"box.{kind}"
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=translation_matrix(place))
    (scene if kind in ("glb", "gltf", "obj") else scene.to_mesh()).export(path)
    return path


def assert_box_in_view(world: OwnWorld) -> None:
    """The camera of `AHEAD` sees the front of the box of `box_path`, 4 m away."""
    depth_m = render_frame(world(0, 0), CAMERA, None, right=False).depth_m
    # 1 m to each side at 4 m is 45 / 4 = 11.25 pixels.
    expected = np.zeros((37, 53))
    expected[18 - 11 : 18 + 12, 26 - 11 : 26 + 12] = 4.0
    np.testing.assert_allclose(depth_m, expected, atol=1e-4)


@pytest.mark.parametrize(
    "box_path, up", [(("glb", "y"), "z"), (("obj", "z"), "z"), (("obj", "y"), "y"), (("ply", "z"), "z"),
                     (("stl", "y"), "y")], indirect=["box_path"],
)  # fmt: skip
def test_a_box_stands_where_its_file_says(box_path: Path, up: str) -> None:
    assert_box_in_view(OwnWorld(str(box_path), up=up, **AHEAD))


@pytest.mark.parametrize("box_path", [("glb", "y")], indirect=True)
def test_cycles_finds_the_box_too(box_path: Path, blender_python: Path) -> None:
    world = OwnWorld(str(box_path), **AHEAD)
    geometry = Cycles(samples=1, denoise=False, threads=1, python=str(blender_python)).geometry(world(0, 0), CAMERA)
    expected = render_frame(world(0, 0), CAMERA, None, right=False)
    np.testing.assert_allclose(geometry.depth_m[8:29, 16:37], 4.0, atol=1e-4)
    np.testing.assert_array_equal(geometry.object_id, expected.object_id)


@pytest.mark.parametrize("box_path", [("glb", "y")], indirect=True)
def test_scale_stretches_the_world(box_path: Path) -> None:
    world = OwnWorld(str(box_path), scale=0.5, camera_position=(0.5, 0, 0.75), look_at=(0.5, 9, 0.75))
    assert render_frame(world(0, 0), CAMERA, None, right=False).depth_m[18, 26] == pytest.approx(2.0)


@pytest.mark.parametrize("box_path", [("glb", "y"), ("stl", "z")], indirect=True)
def test_a_camera_that_nobody_placed_sees_everything_near_the_middle(box_path: Path) -> None:
    camera = Camera(width=64, height=48, focal_px=52.5)
    seen = render_frame(OwnWorld(str(box_path))(0, 0), camera, None, right=False).depth_m > 0
    rows, columns = np.nonzero(seen)
    assert rows.min() > 0 and rows.max() < 47 and columns.min() > 0 and columns.max() < 63
    assert seen.mean() > 0.1
    assert abs(rows.mean() - 23.5) < 4 and abs(columns.mean() - 31.5) < 4


@pytest.mark.parametrize("box_path", [("glb", "y")], indirect=True)
def test_other_viewpoints_stand_aside_and_look_at_the_same_spot(box_path: Path) -> None:
    world = OwnWorld(str(box_path), vary=0.2, **AHEAD)
    poses = [np.linalg.inv(world(3, index).camera_from_world) for index in range(8)]
    np.testing.assert_allclose(poses[0][:3, 3], AHEAD["camera_position"])
    for pose in poses[1:]:
        assert 0 < np.abs(pose[:3, 3] - poses[0][:3, 3]).max() <= 0.2 * 10 + 1e-9
        to_spot = np.array(AHEAD["look_at"]) - pose[:3, 3]
        np.testing.assert_allclose(pose[:3, 2], to_spot / np.linalg.norm(to_spot))
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1) and pose[2, 1] < 0  # upright
    assert len({pose.tobytes() for pose in poses}) == 8


def picture_scene(path: Path) -> None:
    """A poster 4 m wide, 4 m ahead: orange left, teal right, its upper quarter black."""
    pixels = np.zeros((80, 60, 3), np.uint8)
    pixels[20:, :30], pixels[20:, 30:] = ORANGE, TEAL
    material = PBRMaterial(baseColorTexture=Image.fromarray(pixels), baseColorFactor=(255, 255, 255, 255))
    corners = [(-2, -2, -4), (2, -2, -4), (2, 2, -4), (-2, 2, -4)]
    visual = TextureVisuals(uv=[(0, 0), (1, 0), (1, 1), (0, 1)], material=material)
    trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], visual=visual, process=False).export(path)


def seen_colours(renderer: Renderer, world: OwnWorld) -> np.ndarray:
    """What the camera sees left, right and above of the poster's middle, as albedo in the picture's own terms."""
    scene = world(0, 0)
    frame = renderer(scene, CAMERA, None, right=False)
    light = scene.light
    sun = max(-light.sun_direction[1], 0)  # on what faces against y
    return frame.rgb[[22, 22, 1], [16, 36, 26]] / (
        (light.exposure * (sun * np.array(light.sun_rgb) + share_of_sky(renderer) * np.array(light.ambient_rgb)))
        ** (1 / 2.2)
    )


def share_of_sky(renderer: Renderer) -> float:
    """What an upright wall gets of the sky's light: the ray-caster's ground is darker, Cycles' scene has none."""
    return 1.0 if isinstance(renderer, Cycles) else 0.75


def test_a_picture_shows_its_colours_on_the_right_sides(tmp_path: Path) -> None:
    picture_scene(tmp_path / "poster.glb")
    world = OwnWorld(str(tmp_path / "poster.glb"), camera_position=(0, 0, 0), look_at=(0, 1, 0))
    np.testing.assert_allclose(seen_colours(render_frame, world), [ORANGE, TEAL, (0, 0, 0)], atol=3)


def test_cycles_shows_the_same_picture(tmp_path: Path, blender_python: Path) -> None:
    picture_scene(tmp_path / "poster.glb")
    world = OwnWorld(str(tmp_path / "poster.glb"), camera_position=(0, 0, 0), look_at=(0, 1, 0))
    cycles = Cycles(samples=4, denoise=False, threads=1, python=str(blender_python))
    np.testing.assert_allclose(seen_colours(cycles, world), [ORANGE, TEAL, (0, 0, 0)], atol=3)
