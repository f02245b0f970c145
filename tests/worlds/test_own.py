"""A user's own scene file against closed forms: boxes of known size and place, pictures of known colours."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.transformations import rotation_matrix, translation_matrix
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from depthreg.cli import main
from depthreg.rendering import Camera, Cycles, Renderer, render_frame
from depthreg.worlds import OwnWorld
from depthreg.worlds.gltf_camera import gltf_camera

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


def test_an_obj_with_a_picture_shows_it_the_same_way_up(tmp_path: Path) -> None:
    picture_scene(tmp_path / "poster.obj")
    world = OwnWorld(str(tmp_path / "poster.obj"), up="y", camera_position=(0, 0, 0), look_at=(0, 1, 0))
    np.testing.assert_allclose(seen_colours(render_frame, world), [ORANGE, TEAL, (0, 0, 0)], atol=3)


def test_faces_of_their_own_colours_show_them(tmp_path: Path) -> None:
    """Also where the palette's texels are far smaller than a pixel: they must not blur."""
    strip = trimesh.Trimesh(
        [(x, 4, z) for z in (-2, 2) for x in (-2, 0, 2)], [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)], process=False
    )
    strip.visual.face_colors = [(*ORANGE, 255)] * 2 + [(*TEAL, 255)] * 2
    strip.export(tmp_path / "strip.ply")
    world = OwnWorld(str(tmp_path / "strip.ply"), camera_position=(0, 0, 0), look_at=(0, 1, 0))
    np.testing.assert_allclose(seen_colours(render_frame, world)[:2], [ORANGE, TEAL], atol=3)


def test_gltf_colours_are_linear(tmp_path: Path) -> None:
    """glTF 2.0: factors and vertex colours are linear, so 0.5 is the byte 186 of a picture."""
    for name, visual in {
        "factor": TextureVisuals(material=PBRMaterial(baseColorFactor=(127, 127, 127, 255))),
        "vertices": trimesh.visual.ColorVisuals(vertex_colors=[(127, 127, 127, 255)] * 8),
    }.items():
        box = trimesh.creation.box(bounds=[(-9, -9, -5), (9, 9, -4)])
        box.visual = visual
        box.export(tmp_path / f"{name}.glb")
        world = OwnWorld(str(tmp_path / f"{name}.glb"), camera_position=(0, 0, 0), look_at=(0, 1, 0))
        np.testing.assert_allclose(seen_colours(render_frame, world), 186, atol=3)


def test_the_files_own_camera_is_used(tmp_path: Path) -> None:
    """It hangs on a turned and moved node, 2 m ahead of where that stands."""
    node, camera = translation_matrix((3, 1, 0)) @ rotation_matrix(np.pi / 2, (0, 1, 0)), translation_matrix((0, 0, -2))
    box = trimesh.creation.box(bounds=[(-9, -9, -9), (-6, 9, 9)])  # the node looks along -x
    document = json.loads(trimesh.exchange.gltf.export_gltf(trimesh.Scene(box))["model.gltf"])
    box.export(tmp_path / "scene.glb")
    first = len(document["nodes"])
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(box))
    document["nodes"] += [
        {"matrix": node.T.ravel().tolist(), "children": [first + 1]},
        {"translation": camera[:3, 3].tolist(), "camera": 0},
    ]
    document["scenes"][0]["nodes"].append(first)
    document["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}]
    for name, content in {**files, "model.gltf": json.dumps(document).encode()}.items():
        (tmp_path / name).write_bytes(content)
    pose = np.linalg.inv(OwnWorld(str(tmp_path / "model.gltf"))(0, 0).camera_from_world)
    np.testing.assert_allclose(pose[:3, 3], (1, 0, 1), atol=1e-9)  # right 3 - 2, up 1
    np.testing.assert_allclose(pose[:3, 2], (-1, 0, 0), atol=1e-9)
    depth_m = render_frame(OwnWorld(str(tmp_path / "model.gltf"))(0, 0), CAMERA, None, right=False).depth_m
    assert depth_m[18, 26] == pytest.approx(7.0)
    assert gltf_camera(tmp_path / "scene.glb") is None


BLEND = """
import sys, bpy
bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
bpy.ops.mesh.primitive_cube_add(size=2, location=(1, 5, 1.5))
bpy.ops.object.modifier_add(type="MIRROR")
material = bpy.data.materials.new("paint")
material.use_nodes = True
material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.5, 0.5, 0.5, 1)
bpy.context.object.data.materials.append(material)
bpy.ops.mesh.primitive_cube_add(size=1, location=(1, 2, 1.5))
bpy.context.object.hide_render = True
bpy.ops.object.camera_add(location=(0, 0, 9))
bpy.ops.object.camera_add(location=(1, 0, 1.5), rotation=(1.5707963267948966, 0, 0))
bpy.context.scene.camera = bpy.context.object
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
"""


def test_a_blend_file_shows_what_blender_was_told(tmp_path: Path, blender_python: Path) -> None:
    path = tmp_path / "scene.blend"
    subprocess.run([blender_python, "-I", "-c", BLEND, path], check=True, capture_output=True)
    world = OwnWorld(str(path))
    assert_box_in_view(world)
    np.testing.assert_allclose(seen_colours(render_frame, world)[:1], 186, atol=3)
    geometry = Cycles(samples=1, denoise=False, threads=1, python=str(blender_python)).geometry(world(0, 0), CAMERA)
    np.testing.assert_allclose(geometry.depth_m[8:29, 16:37], 4.0, atol=1e-4)


def test_a_blend_files_only_camera_is_used_even_if_it_isnt_active(tmp_path: Path, blender_python: Path) -> None:
    path = tmp_path / "scene.blend"
    script = BLEND.replace("bpy.ops.object.camera_add(location=(0, 0, 9))", "").replace(
        "scene.camera =", "scene.camera = None #"
    )
    subprocess.run([blender_python, "-I", "-c", script, path], check=True, capture_output=True)
    assert_box_in_view(OwnWorld(str(path)))


def complaint(capsys: pytest.CaptureFixture[str], *overrides: str) -> str:
    """The one sentence with which the command refuses, and exits with 2."""
    assert main(["render", "world=own", *overrides]) == 2
    message = capsys.readouterr().err
    assert message.startswith("depthreg render: ") and message.count("\n") == 1
    return message


def test_a_broken_picture_is_refused_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture_scene(tmp_path / "poster.obj")
    (picture,) = tmp_path.glob("*.png")
    picture.write_bytes(picture.read_bytes()[:60])
    message = complaint(capsys, f"world.path={tmp_path / 'poster.obj'}", f"out={tmp_path / 'out'}")
    assert "poster.obj" in message and "expected a sound .obj file" in message


BAD_FILES = {
    "noise.glb": (b"\x80noise", "expected a sound .glb file"),
    "noise.gltf": (b"{", "expected a sound .gltf file"),
    "noise.ply": (b"noise", "expected a sound .ply file"),
    "noise.stl": (b"noise", "holds no triangle"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "holds no triangle"),
    "flat.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "holds no triangle"),
    "scene.fbx": (b"", "expected a scene file, .glb, .gltf, .obj, .ply, .stl or .blend"),
    "missing.glb": (None, "no such file"),
    "huge.obj": (b"v 0 0 0\nv 900 0 0\nv 0 900 0\nf 1 2 3\n", "world.scale below 1"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_file_that_cant_be_used_is_refused_in_one_sentence(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, reason = BAD_FILES[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    message = complaint(capsys, f"world.path={tmp_path / name}", f"out={tmp_path / 'out'}")
    assert str(tmp_path / name) in message and reason in message
    assert not (tmp_path / "out").exists()


def test_a_broken_blend_file_is_refused_in_one_sentence(
    tmp_path: Path, blender_python: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "noise.blend").write_bytes(b"noise")
    message = complaint(capsys, f"world.path={tmp_path / 'noise.blend'}", f"out={tmp_path / 'out'}")
    assert "expected a sound .blend file" in message


def test_a_blend_file_without_blender_is_refused_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene.blend").write_bytes(b"")
    monkeypatch.setenv("DEPTHREG_BLENDER_PYTHON", str(tmp_path / "nowhere"))
    assert "make blender" in complaint(capsys, f"world.path={tmp_path / 'scene.blend'}", f"out={tmp_path / 'out'}")


@pytest.mark.parametrize(
    "override",
    ["path=null", "path=7", "up=x", "scale=0", "scale=much", "vary=1", "view_deg=180", "camera_position=3",
     "camera_position=[1,2]", "look_at=[a,b,c]", "camera_position=[0.5,0.5,0.5]"],
)  # fmt: skip
def test_a_value_that_cant_be_meant_is_refused(
    override: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box(bounds=[(0, 0, 0), (1, 1, 1)]).export(path)
    assert f"world.{override.partition('=')[0]}" in complaint(
        capsys, f"world.path={path}", f"world.{override}", f"out={tmp_path}/o"
    )


def test_the_command_renders_a_frame_from_each_viewpoint(tmp_path: Path) -> None:
    picture_scene(tmp_path / "poster.glb")
    small = ["camera.width=53", "camera.height=37", "camera.focal_px=40", "sensor=clean", "workers=1"]
    assert main(["render", "world=own", f"world.path={tmp_path / 'poster.glb'}", *small, f"out={tmp_path}/out"]) == 0
    assert len({path.read_bytes() for path in (tmp_path / "out").glob("*/depth.png")}) == 8
