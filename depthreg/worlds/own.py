"""A scene of the user's own, seen from where its camera stands and from places around."""

from dataclasses import dataclass

import numpy as np

from depthreg.errors import InputError
from depthreg.worlds.own_files import SceneFile, read_scene_file
from depthreg.worlds.poses import lidar_from_camera
from depthreg.worlds.scene import Light, Scene

Vector = tuple[float, float, float]

_AXES = ("y", "z")
_FROM = np.array([0.35, -1.0, 0.45])  # where a camera stands that nobody placed: in front, a little aside and above
_BASELINE_M = 0.075  # between the infrared camera and the projector of a Kinect


@dataclass(frozen=True)
class OwnWorld:
    """A scene file: `OwnWorld("scene.glb")(seed, index)` is the same place, each time from another viewpoint.

    The camera is the one stated here, else the file's first, else one that sees the whole scene. Index 0 stands exactly
    there; others a little aside, looking at the same spot.

    Args:
        path: Of a .glb, .gltf, .obj, .ply, .stl or .blend file; the latter needs Blender, see `make blender`.
        up: Which axis of an OBJ, PLY or STL file is up, "y" or "z"; glTF's and Blender's are known.
        scale: Metres in one of the file's units.
        camera_position: Where the camera stands in the world (right, forward, up), metres.
        look_at: What it looks at; the middle of the scene where not given.
        view_deg: The angle that has to hold the scene where nobody placed the camera.
        vary: How far other viewpoints stand aside, as a share of the distance to what the camera looks at.

    Raises:
        InputError: A value can't be meant, or the file can't be used.
    """

    path: str | None = None
    up: str = "z"
    scale: float = 1.0
    camera_position: Vector | None = None
    look_at: Vector | None = None
    view_deg: float = 49.0
    vary: float = 0.1

    def __post_init__(self) -> None:
        if not self.path:
            raise InputError("world.path names no file: expected a scene (.glb, .gltf, .obj, .ply, .stl or .blend)")
        if self.up not in _AXES:
            raise InputError(f"world.up={self.up}: expected one of {', '.join(_AXES)}")
        if not 0 < self.scale < np.inf or not 0 <= self.vary < 1 or not 1 <= self.view_deg <= 170:
            raise InputError(
                "world: expected scale above 0, vary from 0 to below 1 and view_deg from 1 to 170, "
                f"got {self.scale}, {self.vary} and {self.view_deg}"
            )
        for name in ("camera_position", "look_at"):
            value = getattr(self, name)
            if value is not None and (len(value) != 3 or not np.isfinite(value).all()):
                raise InputError(f"world.{name}={value}: expected three numbers, metres to the right, forward and up")
        if self.look_at is not None and self.look_at == self.camera_position:
            raise InputError(f"world.look_at={self.look_at} is where the camera stands: expected another place")
        self._file()

    def __call__(self, seed: int, index: int) -> Scene:
        """The scene from viewpoint `index`."""
        file = self._file()
        pose, target = self._viewpoint(file)
        if index:
            rng = np.random.default_rng([seed, index])
            aside = self.vary * np.linalg.norm(target - pose[:3, 3]) * rng.uniform(-1, 1, 3)
            moved = pose[:3, 3] + pose[:3, :3] @ aside
            pose = _looking(moved, target)
        return Scene(file.objects, _LIGHT, np.linalg.inv(pose), lidar_from_camera(), baseline_m=_BASELINE_M)

    def _file(self) -> SceneFile:
        assert self.path
        return read_scene_file(self.path, self.up, self.scale)

    def _viewpoint(self, file: SceneFile) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the camera in the world (4, 4), and what it looks at (3,)."""
        corners = np.array([o.mesh.bounds for o in file.objects])
        low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
        middle, radius_m = (low + high) / 2, np.linalg.norm(high - low) / 2
        if self.camera_position is None and self.look_at is None and file.world_from_camera is not None:
            pose = file.world_from_camera
            forward = pose[:3, 2]
            ahead_m = max(float((middle - pose[:3, 3]) @ forward), 0.1 * radius_m)
            return pose, pose[:3, 3] + ahead_m * forward
        target = middle if self.look_at is None else np.array(self.look_at, float)
        if self.camera_position is None:
            away_m = 1.02 * radius_m / np.sin(np.radians(self.view_deg / 2)) + np.linalg.norm(middle - target)
            return _looking(target + away_m * _FROM / np.linalg.norm(_FROM), target), target
        return _looking(np.array(self.camera_position, float), target), target


def _looking(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pose in the world, (4, 4), of an upright camera at a place that looks at another."""
    pose = np.eye(4)
    forward = (target - position) / max(np.linalg.norm(target - position), 1e-9)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight down or up
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


# The sun over the left shoulder of a camera that looks forward, in a fair sky; white that faces it is nearly white.
_LIGHT = Light(
    sun_direction=np.array([-0.48, -0.6, 0.64]),
    sun_rgb=(1.0, 0.96, 0.88),
    ambient_rgb=(0.28, 0.32, 0.38),
    sky_horizon_rgb=(0.8, 0.87, 0.95),
    sky_zenith_rgb=(0.3, 0.5, 0.85),
    exposure=0.75,
)
