"""What a world is made of: meshes with materials, light, and where the camera stands.

World coordinates: x right, y forward, z up, metres. Camera coordinates: x right, y down, z forward.
"""

from dataclasses import dataclass, field

import numpy as np
import trimesh

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """Diffuse surface whose colour is a function of the world position (and of the face's normal)."""

    color: RGB  # linear albedo in [0, 1]; above 1 it shines by itself
    pattern: str = "plain"  # a key of textures.PATTERNS
    second_color: RGB = (0.5, 0.5, 0.5)  # joints, gaps, spots, window panes: whatever the pattern contrasts with
    scale_m: float = 1.0  # size of one repeat of the pattern
    gloss: float = 0.0  # share of the sky mirrored, [0, 1]
    seed: int = 0  # two objects of one pattern differ by their seeds
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # world position where the pattern's first repeat starts
    variation: float = 0.0  # spread of the brightness from face to face, [0, 1]: leaves


@dataclass(frozen=True)
class Picture:
    """A picture that lies on a mesh in place of a pattern; the material's colour multiplies it."""

    texels: np.ndarray  # (R, 3) uint8, as textures.picture_texels gives them; objects may share one
    uv: (
        np.ndarray
    )  # (F, 3, 2) where the corners of each face lie in the picture: (0, 0) to (1, 1) is all of it, up is up
    tiles_per_m: float  # how many pictures a metre holds; 0 where each face shows one texel, which must not blur


@dataclass(frozen=True)
class SceneObject:
    """One thing: a mesh in world coordinates with one material."""

    name: str  # its class: "car", "wall", "table"; for reading, not for looking up
    mesh: trimesh.Trimesh
    material: Material
    picture: Picture | None = None


@dataclass(frozen=True)
class Light:
    """Sun, sky and air of a scene, or the lamp of a room."""

    sun_direction: np.ndarray  # (3,) unit vector towards the sun
    sun_rgb: RGB
    ambient_rgb: RGB
    sky_horizon_rgb: RGB = (0.75, 0.82, 0.9)
    sky_zenith_rgb: RGB = (0.35, 0.55, 0.85)
    cloud_cover: float = 0.3  # [0, 1]
    fog_per_m: float = 0.0  # extinction: colour fades to the horizon's as exp(-fog_per_m * range)
    exposure: float = 1.0
    lamp_m: tuple[float, float, float] | None = None  # where set, a lamp stands here for the sun, `sun_rgb` at 2 m


@dataclass(frozen=True)
class Scene:
    """Everything a renderer needs to know of a place."""

    objects: list[SceneObject]
    light: Light
    camera_from_world: np.ndarray  # (4, 4) rigid, metres
    # (4, 4) rigid; LiDAR coordinates: x forward, y left, z up
    lidar_from_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    baseline_m: float = 0.54  # of a stereo pair (or from camera to projector) that suits the place: KITTI's
    velocity_m_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the camera and the LiDAR, world axes
    depth_bin_m: float | None = None  # where set, depth is reported at the centres of bins of this depth (stage 1)
