"""Runs inside Blender's own Python, which has bpy and NumPy and nothing of ours: does the jobs that arrive on stdin.

A job is a line of JSON, and so is its answer on stdout: {"cpu_s": ...} or {"error": "..."}. The process ends with its
stdin. It has to be started isolated (python -I), or our cycles.py would stand before Blender's package of that name.
"""

import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from queue import SimpleQueue
from typing import Any, NamedTuple

import bpy
import numpy as np
from mathutils import Matrix

Job = dict[str, Any]
_SUN_RAD = 0.0093  # how large it looks from here
_LAMP_RADIUS_M = 0.04
_POINT_M = 1e-3  # radius of a lamp whose pattern has to stay sharp
_SENSOR_MM = 100.0  # any width does
_SHARP = 1e-7  # filter width in pixels: rays go through the pixels' centres
_ROUGHNESS = 0.2  # gives the sun's reflection the width that it has in the ray-caster
_MOST_LIGHT = 6.0  # of one indirect sample, against speckle


class _Nodes(NamedTuple):
    """A node tree with short ways to add to it."""

    tree: Any

    def add(self, kind: str, inputs: dict[Any, Any] | None = None, **settings: Any) -> Any:
        """A new node; inputs, by name or number, get a value or the output to link them to."""
        node = self.tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def math(self, operation: str, first: Any, second: Any) -> Any:
        """A number computed of two."""
        return self.add("ShaderNodeMath", {0: first, 1: second}, operation=operation).outputs[0]

    def vector(self, operation: str, first: Any, second: Any) -> Any:
        """A colour computed of two."""
        return self.add("ShaderNodeVectorMath", {0: first, 1: second}, operation=operation).outputs[0]

    def mix(self, share: Any, first: Any, second: Any) -> Any:
        """A colour between two."""
        node = self.add("ShaderNodeMix", {0: share, 6: first, 7: second}, data_type="RGBA", clamp_factor=False)
        return node.outputs[2]

    def attribute(self, name: str, output: str = "Fac") -> Any:
        """One of the mesh's attributes: a number, or its "Color"."""
        return self.add("ShaderNodeAttribute", attribute_name=name).outputs[output]


def _image(name: str, pixels: np.ndarray) -> Any:
    """Pixels (H, W, 3), uint8 or float32, the lowest row first, as an image whose values shaders get as they are."""
    height, width = pixels.shape[:2]
    is_float = pixels.dtype != np.uint8
    image = bpy.data.images.new(name, width, height, float_buffer=is_float)
    image.colorspace_settings.name = "Non-Color"
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = pixels if is_float else pixels.astype(np.float32) / 255
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    return image


def _new_nodes(owner: Any) -> _Nodes:
    owner.use_nodes = True
    owner.node_tree.nodes.clear()
    return _Nodes(owner.node_tree)


def _material(name: str, pixels: np.ndarray, is_pattern: bool) -> Any:
    """The look of all faces that share a tile of a pattern (mix, shade, gloss), or a picture (colours to the 1/2.2)."""
    material = bpy.data.materials.new(name)
    material.cycles.emission_sampling = "NONE"  # or every face would be asked for light
    nodes = _new_nodes(material)
    texel = nodes.add("ShaderNodeTexImage", image=_image(name, pixels), extension="REPEAT").outputs["Color"]
    first, gloss, brightness = (
        nodes.attribute("first", "Color"),
        nodes.attribute("gloss"),
        nodes.attribute("brightness"),
    )
    if is_pattern:
        mix, shade, polish = nodes.add("ShaderNodeSeparateColor", {0: texel}).outputs
        color = nodes.mix(mix, first, nodes.attribute("second", "Color"))
        brightness = nodes.math("MULTIPLY", nodes.math("MULTIPLY", shade, 2.0), brightness)
        gloss = nodes.math("MULTIPLY", gloss, polish)
    else:
        color = nodes.vector("MULTIPLY", first, nodes.add("ShaderNodeGamma", {0: texel, 1: 2.2}).outputs[0])
    scaled = nodes.add("ShaderNodeVectorMath", {0: color, "Scale": brightness}, operation="SCALE").outputs[0]
    nodes.add("ShaderNodeOutputMaterial", {"Surface": _surface(nodes, scaled, gloss)})
    nodes.add("ShaderNodeOutputAOV", {"Value": nodes.attribute("face")}, aov_name="face")
    return material


def _surface(nodes: _Nodes, color: Any, gloss: Any) -> Any:
    """A diffuse shader with polish on it; what is brighter than white shines by itself."""
    white = nodes.vector("MINIMUM", color, (1.0, 1.0, 1.0))
    # Schlick's approximation: polish mirrors little head-on and everything at a grazing angle.
    facing = nodes.add("ShaderNodeLayerWeight", {"Blend": 0.5}).outputs["Facing"]  # 1 - cosine of the incidence
    grazing = nodes.math("MULTIPLY", nodes.math("POWER", facing, 5.0), 0.92)
    share = nodes.math("MULTIPLY", nodes.math("ADD", grazing, 0.08), gloss)
    diffuse = nodes.add("ShaderNodeBsdfDiffuse", {"Color": white}).outputs[0]
    mirror = nodes.add("ShaderNodeBsdfAnisotropic", {"Roughness": _ROUGHNESS}, distribution="GGX").outputs[0]
    polished = nodes.add("ShaderNodeMixShader", {0: share, 1: diffuse, 2: mirror}).outputs[0]
    shining = nodes.add("ShaderNodeEmission", {"Color": nodes.vector("SUBTRACT", color, white)}).outputs[0]
    return nodes.add("ShaderNodeAddShader", {0: polished, 1: shining}).outputs[0]


def _mesh(arrays: dict[str, np.ndarray], materials: list[Any]) -> None:
    """One flat-shaded object of all faces, with everything that its materials read as attributes."""
    mesh = bpy.data.meshes.new("scene")
    faces = arrays["faces"]
    mesh.vertices.add(len(arrays["vertices"]))
    mesh.vertices.foreach_set("co", arrays["vertices"].ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    for material in materials:
        mesh.materials.append(material)
    mesh.polygons.foreach_set("material_index", arrays["image"])
    mesh.update(calc_edges=True)
    mesh.shade_flat()
    mesh.uv_layers.new(name="uv").data.foreach_set("uv", arrays["uv"].ravel())
    for name in ("first", "second"):
        mesh.attributes.new(name, "FLOAT_VECTOR", "FACE").data.foreach_set("vector", arrays[name].ravel())
    arrays["face"] = np.arange(len(faces), dtype=np.float32)
    for name in ("gloss", "brightness", "face"):
        mesh.attributes.new(name, "FLOAT", "FACE").data.foreach_set("value", arrays[name])
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("scene", mesh))


def _place(thing: Any, rotation: np.ndarray, position: np.ndarray) -> Any:
    """Put an object into the scene at a pose that isn't rounded by way of angles."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    thing.parent = bpy.data.objects.new("pose", None)
    bpy.context.scene.collection.objects.link(thing.parent)
    bpy.context.scene.collection.objects.link(thing)
    thing.matrix_parent_inverse = Matrix(pose)
    return thing


def _frame_with_z(direction: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) whose third axis is a unit direction: lights shine against theirs."""
    side = np.cross(direction, [1.0, 0, 0] if abs(direction[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(direction, side), direction], axis=1)


def _lights(light: Job, sky: np.ndarray) -> None:
    """The sun or the lamp, the sky that the camera sees, and the light that reaches what they don't."""
    strongest = max(*light["sun_rgb"], 1e-9)
    lamp_m = light["lamp_m"]
    data = bpy.data.lights.new("sun", "POINT" if lamp_m else "SUN")
    data.color = [value / strongest for value in light["sun_rgb"]]
    if lamp_m:
        data.shadow_soft_size = _LAMP_RADIUS_M
        # Watts for an irradiance of pi at lamp_at_m: a white surface there sends back 1.
        data.energy = strongest * np.pi * 4 * np.pi * light["lamp_at_m"] ** 2
    else:
        data.angle = _SUN_RAD
        data.energy = strongest * np.pi
    lamp = bpy.data.objects.new("sun", data)
    lamp.visible_camera = False
    _place(lamp, _frame_with_z(np.array(light["sun_direction"])), np.array(lamp_m or (0, 0, 0)))
    world = bpy.data.worlds.new("sky")
    world.cycles.sampling_method = "NONE"  # an even light, which any direction finds
    bpy.context.scene.world = world
    nodes = _new_nodes(world)
    seen = nodes.add("ShaderNodeTexEnvironment", image=_image("sky", sky)).outputs[0]
    is_diffuse = nodes.add("ShaderNodeLightPath").outputs["Is Diffuse Ray"]
    color = nodes.mix(is_diffuse, seen, (*light["ambient_rgb"], 1.0))
    background = nodes.add("ShaderNodeBackground", {"Color": color}).outputs[0]
    nodes.add("ShaderNodeOutputWorld", {"Surface": background})


def _own_lamp(lamp: Job, pattern: np.ndarray | None) -> None:
    """Nothing but a lamp that the instrument brings along: a flash, or a projector of a pattern (N, N)."""
    data = bpy.data.lights.new("lamp", "POINT")
    data.shadow_soft_size = _POINT_M
    data.energy = np.pi * 4 * np.pi  # watts for an irradiance of pi at 1 m: a white surface there sends back 1
    if pattern is not None:
        nodes = _new_nodes(data)
        direction = nodes.add("ShaderNodeTexCoord").outputs["Normal"]  # of a lamp: where the light goes, in its axes
        x, y, z = nodes.add("ShaderNodeSeparateXYZ", {0: direction}).outputs
        reach = nodes.math("MULTIPLY", z, lamp["pattern_width"])
        place = nodes.add(
            "ShaderNodeCombineXYZ", {0: nodes.math("DIVIDE", x, reach), 1: nodes.math("DIVIDE", y, reach)}
        )
        image = _image("pattern", np.repeat(pattern[..., None], 3, axis=-1).astype(np.float32))
        light = nodes.add("ShaderNodeTexImage", {0: place.outputs[0]}, image=image, extension="REPEAT").outputs["Color"]
        # Blender spreads a lamp's power over all directions, and an emission node's strength is in units of that.
        emission = nodes.add("ShaderNodeEmission", {"Color": light, "Strength": 1.0}).outputs[0]
        nodes.add("ShaderNodeOutputLight", {"Surface": emission})
    thing = bpy.data.objects.new("lamp", data)
    thing.visible_camera = False
    _place(thing, np.array(lamp["rotation"]) * [1, -1, -1], np.array(lamp["position"]))
    bpy.context.scene.world = bpy.data.worlds.new("dark")
    nodes = _new_nodes(bpy.context.scene.world)
    nodes.add("ShaderNodeOutputWorld", {"Surface": nodes.add("ShaderNodeBackground", {"Strength": 0.0}).outputs[0]})


def _camera() -> Any:
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", _SENSOR_MM
    data.clip_start, data.clip_end = 0.05, 1e3
    camera = bpy.data.objects.new("camera", data)
    bpy.context.scene.camera = camera
    return _place(camera, np.eye(3), np.zeros(3))


def _aim(camera: Any, view: Job) -> None:
    """Give the camera a view's pose and lens; Blender's cameras look along -z with y up."""
    width, height = view["width"], view["height"]
    # Cycles looks its filter up in a table of 1024 entries, half an entry to the right and above: the colours get by.
    aside_px = 0.5 / 1024 if view["exact"] else 0.0
    u, v = view["center_px"][0] + aside_px, view["center_px"][1] - aside_px
    camera.data.lens = _SENSOR_MM * view["focal_px"] / width
    camera.data.shift_x = ((width - 1) / 2 - u) / width
    camera.data.shift_y = (v - (height - 1) / 2) / width
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(view["rotation"]) * [1, -1, -1], view["position"]
    camera.matrix_parent_inverse = Matrix(pose)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100


def _settings(job: Job, view: Job) -> None:
    """How to render a view: the colours, or (`exact`) what the rays through the pixels' centres hit."""
    scene, exact = bpy.context.scene, view["exact"]
    scene.render.engine = "CYCLES"
    scene.render.use_persistent_data = True  # the next view of a scene finds its tree ready
    scene.render.threads_mode, scene.render.threads = ("FIXED", job["threads"]) if job["threads"] else ("AUTO", 1)
    settings = scene.cycles
    settings.seed = job["seed"]
    settings.samples, settings.use_adaptive_sampling = (1 if exact else job["samples"]), False
    settings.use_denoising, settings.denoiser = job["denoise"] and not exact, "OPENIMAGEDENOISE"
    settings.pixel_filter_type = "BOX"
    settings["filter_width"] = _SHARP if exact else 1.0  # set by key: the attribute stops at 0.01
    settings.max_bounces, settings.diffuse_bounces, settings.glossy_bounces = (0, 0, 0) if exact else (4, 3, 2)
    settings.caustics_reflective = settings.caustics_refractive = False
    settings.sample_clamp_indirect = _MOST_LIGHT
    layer = bpy.context.view_layer
    layer.use_pass_z, layer.use_pass_normal = True, exact
    output = scene.render.image_settings
    output.file_format, output.color_depth, output.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"


def render(job: Job) -> None:
    """Render views of a scene into one EXR file each."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with np.load(job["scene"]) as file:
        arrays = dict(file)
    patterns = job["is_pattern"]
    materials = [_material(f"image{i}", arrays[f"image{i}"], patterns[i]) for i in range(len(patterns))]
    _mesh(arrays, materials)
    if lamp := job.get("lamp"):
        _own_lamp(lamp, np.load(lamp["pattern"]) if lamp["pattern"] else None)
    else:
        _lights(job["light"], arrays["sky"])
    camera = _camera()
    bpy.context.view_layer.aovs.add().name = "face"
    bpy.context.view_layer.aovs["face"].type = "VALUE"
    for view in job["views"]:
        _aim(camera, view)
        _settings(job, view)
        bpy.context.scene.render.filepath = view["out"]
        bpy.ops.render.render(write_still=True)


def export(job: Job) -> None:
    """Turn what a .blend file would render into glTF: modifiers applied, none of its scripts run."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.open_mainfile(filepath=job["blend"], load_ui=False, use_scripts=False)
    scene = bpy.context.scene
    for thing in scene.objects:
        if thing.type == "CAMERA":  # readers take the first: that has to be the active one, where one is
            thing.hide_render = scene.camera not in (None, thing)
    what = {"use_renderable": True, "use_active_scene": True, "export_cameras": True, "export_apply": True}
    bpy.ops.export_scene.gltf(filepath=job["out"], export_format="GLB", **what)


TASKS: dict[str, Callable[[Job], None]] = {"render": render, "export": export}


def _jobs() -> Iterator[Job]:
    """Jobs from stdin. A thread waits for its end, so that no render outlives the process that asked for it."""
    lines: SimpleQueue[str] = SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            lines.put(line)
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        yield json.loads(lines.get())


def main() -> None:
    """Answer jobs until stdin ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Blender chats there
    for job in _jobs():
        start_s = time.process_time()
        try:
            TASKS[job["task"]](job)
            answer: Job = {"cpu_s": time.process_time() - start_s}
        except Exception as error:
            traceback.print_exc()
            answer = {"error": str(error) or type(error).__name__}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
