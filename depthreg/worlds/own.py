"""A scene of the user's own, seen from where its camera stands and from places around."""

from dataclasses import dataclass

import numpy as np
import trimesh

from depthreg.errors import InputError
from depthreg.worlds.own_files import SceneFile, read_scene_file
from depthreg.worlds.poses import lidar_from_camera
from depthreg.worlds.scene import Light, Scene

Vector = tuple[float, float, float]

_AXES = ("y", "z")
_FROM = np.array([0.35, -1.0, 0.45])  # where a camera stands that nobody placed: in front, a little aside and above
_ROOM = 1.05  # a little space round what has to be in view
_NEAR = 0.1  # a file's camera looks at something at least that share of the scene's size away
_FARTHEST_M = 200.0  # from 250 m on, depth counts as none
_RANGES = {"scale": (1e-6, 1e6), "view_deg": (1, 170), "vary": (0, 0.9)}
_BASELINE_M = 0.075  # between the infrared camera and the projector of a Kinect

# The sun over the left shoulder of a camera that looks forward, in a fair sky; white that faces it is nearly white.
_LIGHT = Light(
    sun_direction=np.array([-0.48, -0.6, 0.64]),
    sun_rgb=(1.0, 0.96, 0.88),
    ambient_rgb=(0.28, 0.32, 0.38),
    sky_horizon_rgb=(0.8, 0.87, 0.95),
    sky_zenith_rgb=(0.3, 0.5, 0.85),
    exposure=0.75,
)


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
        if not isinstance(self.path, str) or not self.path:
            raise InputError(f"world.path={self.path}: expected a scene file (.glb, .gltf, .obj, .ply, .stl or .blend)")
        if self.up not in _AXES:
            raise InputError(f"world.up={self.up}: expected one of {', '.join(_AXES)}")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not _is_number(value) or not low <= value <= high:
                raise InputError(f"world.{name}={value}: expected a number from {low:g} to {high:g}")
        for name in ("camera_position", "look_at"):
            value = getattr(self, name)
            if value is not None and not (
                isinstance(value, list | tuple) and [_is_number(v) for v in value] == [True] * 3
            ):
                raise InputError(f"world.{name}={value}: expected three numbers, metres to the right, forward and up")
        pose, target = self._viewpoint(self._file())
        if not np.linalg.norm(target - pose[:3, 3]):
            raise InputError(
                f"world.camera_position={self.camera_position} is what the camera looks at: expected another"
            )

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
        corners = np.array([trimesh.bounds.corners(o.mesh.bounds) for o in file.objects]).reshape(-1, 3)
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle = (low + high) / 2
        if self.camera_position is not None or self.look_at is not None or file.world_from_camera is None:
            target = middle if self.look_at is None else np.array(self.look_at, float)
            position = self._overlook(corners, target) if self.camera_position is None else self.camera_position
            return _looking(np.array(position, float), target), target
        pose = file.world_from_camera
        ahead_m = (middle - pose[:3, 3]) @ pose[:3, 2]
        return pose, pose[:3, 3] + max(ahead_m, _NEAR * np.linalg.norm(high - low)) * pose[:3, 2]

    def _overlook(self, points: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Where to stand to have all points (N, 3) in view round a target.

        Raises:
            InputError: That is too far away to measure.
        """
        axes = _looking(target + _FROM, target)[:3, :3]
        right, down, ahead = axes.T @ (points - target).T
        aside = np.maximum(np.abs(right), np.abs(down))
        away_m = _ROOM * (aside / np.tan(np.radians(self.view_deg / 2)) - ahead).max()
        if away_m > _FARTHEST_M:
            raise InputError(
                f"world.path={self.path} is seen whole from {away_m:.0f} m away, where nothing is measured: "
                f"expected a world.scale below {self.scale:g}, or a world.camera_position"
            )
        return target - away_m * axes[:, 2]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


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
