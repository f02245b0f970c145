"""Examples that anybody may have: scenes and sensors of our own, rendered when the page starts."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from depthreg.config import build, compose_config
from depthreg.data import io
from depthreg.data.sample import Measurement
from depthreg.data.synthetic import FixedCamera, SyntheticFrames, SyntheticMeasurements
from depthreg.sensors import SensorSimulator
from depthreg.viz import to_picture

DEPTH_SCALE = 256.0  # stored units per metre
_MAX_DEPTH_M = 120.0
_MAX_CORNER_SHIFT_PX = 24.0  # for an image 1242 px wide, as in training
_SEED = 20_261  # of no training: theirs are small


@dataclass(frozen=True)
class Example:
    """A pair of files as a user would have them, and what only a simulation knows."""

    title: str
    rgb: Path
    depth: Path
    intrinsics: Path
    truth_depth_m: np.ndarray  # (H, W), 0 where unknown
    truth_affine_rgb_from_depth: np.ndarray  # (2, 3) in pixels

    @classmethod
    def of(cls, title: str, measured: Measurement, folder: Path) -> "Example":
        """Write a measurement's files into a new folder."""
        folder.mkdir()
        rgb, depth, intrinsics = folder / "colour.png", folder / "depth.png", folder / "K.txt"
        io.write_png(rgb, to_picture(measured["rgb"]))
        io.write_depth_png(depth, measured["depth_m"][0].numpy(), DEPTH_SCALE)
        np.savetxt(intrinsics, measured["intrinsics"].numpy(), fmt="%.9g")
        truth_m, affine = measured["truth_depth_m"][0].numpy(), measured["truth_affine_rgb_from_depth"].numpy()
        return cls(title, rgb, depth, intrinsics, truth_m, affine)


@dataclass(frozen=True)
class Scene:
    """What to render: choices of the groups `world` and `sensor`, and which scene of the world."""

    title: str
    world: str  # its usual camera goes with it
    sensor: str
    index: int


SCENES = (
    Scene("Street, 64-line scanner", "driving", "hdl64", 1),
    Scene("Room, structured light", "household", "kinect", 4),
    Scene("Room, feature points", "household", "points", 2),
)


def render_example(scene: Scene, folder: Path) -> Example:
    """Render a scene and measure it, with colour that is off by an unknown affine.

    Args:
        scene: Which.
        folder: A new one, for its files.
    """
    choices = (f"world={scene.world}", f"camera={scene.world}", f"sensor={scene.sensor}")
    config = compose_config("render", choices)
    sensor = build(config.sensor)
    camera = FixedCamera(build(config.camera))
    frames = SyntheticFrames(build(config.world), camera, sensor.rig, _SEED, scene.index + 1, _MAX_DEPTH_M)
    simulator = SensorSimulator(sensor, _MAX_CORNER_SHIFT_PX)
    measured = SyntheticMeasurements(frames, simulator, difficulty=1.0, seed=_SEED)[scene.index]
    return Example.of(scene.title, measured, folder)
