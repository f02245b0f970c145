"""Scenes whose pictures can be worked out on paper."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from depthreg.worlds.poses import camera_from_world, lidar_from_camera
from depthreg.worlds.scene import Light, Material, Scene, SceneObject

MakeScene = Callable[..., Scene]


@pytest.fixture
def make_scene() -> MakeScene:
    """Puts meshes before a level camera at the world's origin that looks along y."""

    def make(
        *meshes: trimesh.Trimesh,
        material: Material | None = None,
        sun: tuple[float, float, float] = (0.0, 0.0, 1.0),
        sun_rgb: tuple[float, float, float] = (1.0, 1.0, 1.0),
        ambient_rgb: tuple[float, float, float] = (0.2, 0.2, 0.2),
        up_m: float = 0.0,
        depth_bin_m: float | None = None,
    ) -> Scene:
        objects = [SceneObject("thing", mesh, material or Material((0.5, 0.5, 0.5))) for mesh in meshes]
        light = Light(np.array(sun) / np.linalg.norm(sun), sun_rgb, ambient_rgb)
        return Scene(objects, light, camera_from_world((0.0, 0.0, up_m)), lidar_from_camera(), depth_bin_m=depth_bin_m)

    return make


@pytest.fixture
def wall() -> Callable[[float], trimesh.Trimesh]:
    """A wall 200 m wide across the view, its front at a given distance."""
    return lambda ahead_m: trimesh.creation.box(bounds=[(-100, ahead_m, -100), (100, ahead_m + 1, 100)])


@pytest.fixture
def ground() -> trimesh.Trimesh:
    """Level ground at z = 0."""
    return trimesh.creation.box(bounds=[(-300, -50, -1), (300, 400, 0)])
