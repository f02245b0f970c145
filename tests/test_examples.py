"""The examples need hardware, ROS or large packages: stand-ins give what a camera does, and keep what is shown."""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np
import pytest

import depthreg
from depthreg import Model

FOLDER = Path(__file__).resolve().parents[1] / "examples"
SIZE = (64, 70)
KINDS = ("measured", "completed")
K = np.array([[60, 0, 35], [0, 60, 32], [0, 0, 1]], np.float32)


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch, make_network) -> Callable[..., ModuleType]:
    """Imports an example, with stand-ins for the modules that it needs, and with a tiny network as the released one."""

    def load(name: str, **stand_ins: object) -> ModuleType:
        for module, stand_in in stand_ins.items():
            monkeypatch.setitem(sys.modules, module.replace("__", "."), stand_in)
        monkeypatch.setattr(depthreg, "load", lambda: Model(make_network().eval()))
        spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
        assert spec and spec.loader
        loaded = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(loaded)
        return loaded

    return load


@pytest.fixture
def rgb() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)


def seen_from(points_m: np.ndarray) -> np.ndarray:
    """The pixels (x, y) where points are seen."""
    return (points_m @ K.T)[:, :2] / points_m[:, 2:]


def test_the_ros_node_publishes_metres_and_a_cloud_in_rvizs_colours(example, rgb: np.ndarray) -> None:
    class Node:
        def __init__(self, name: str) -> None:
            self.published = MagicMock()

        def create_publisher(self, kind: object, topic: str, depth: int) -> MagicMock:
            return getattr(self.published, topic)

    names = ("message_filters", "rclpy", "rclpy__qos", "cv_bridge", "sensor_msgs", "sensor_msgs__msg", "sensor_msgs_py")
    cloud = MagicMock(create_cloud=lambda header, fields, points: points)
    stand_ins = {name: MagicMock() for name in names}
    module = example("ros2_node", **stand_ins, rclpy__node=MagicMock(Node=Node), sensor_msgs_py__point_cloud2=cloud)
    node = module.CompletionNode()
    node.bridge.imgmsg_to_cv2 = lambda message, encoding: message.image
    node.bridge.cv2_to_imgmsg = lambda image, encoding, header: image
    stored = np.repeat(np.arange(500, 500 + 50 * SIZE[0], 50, dtype=np.uint16)[:, None], SIZE[1], axis=1)  # millimetres
    node.complete(MagicMock(image=rgb), MagicMock(image=stored), MagicMock(k=K.flatten().tolist()))
    result = depthreg.load()(rgb, stored.astype(np.float32) / 1000, K=K)
    (depth_m,), _ = node.published.depth_completed.publish.call_args
    np.testing.assert_array_equal(depth_m, result.depth_m)
    (points,), _ = node.published.points.publish.call_args
    x, y = seen_from(points[:, :3].astype(np.float64)).round().astype(int).T
    blue, green, red, _ = np.ascontiguousarray(points[:, 3], np.float32).view(np.uint8).reshape(-1, 4).T
    np.testing.assert_array_equal(np.stack([red, green, blue], axis=1), result.rgb_aligned[y, x])
    assert len(points) > 100


def test_the_realsense_loop_logs_every_frame_and_ends_with_the_recording(
    example, rgb: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    realsense, rerun = MagicMock(), MagicMock()
    pipeline, frames = realsense.pipeline.return_value, MagicMock()
    frames.get_color_frame().get_data.return_value = rgb
    frames.get_depth_frame().get_data.return_value = np.full(SIZE, 2500, np.uint16)
    frames.get_timestamp.return_value = 1000.0  # milliseconds
    pipeline.try_wait_for_frames.side_effect = [(True, frames), (True, frames), (False, None)]
    profile = pipeline.start.return_value
    profile.get_device().first_depth_sensor().get_depth_scale.return_value = 0.001
    lens = profile.get_stream().as_video_stream_profile().get_intrinsics()
    lens.fx, lens.fy, lens.ppx, lens.ppy = 60, 60, 35, 32
    rerun.DepthImage = lambda depth_m, meter: depth_m
    monkeypatch.setattr(sys, "argv", ["realsense_live.py", "recording.bag"])
    example("realsense_live", pyrealsense2=realsense, rerun=rerun).main()
    logged = [call.args for call in rerun.log.call_args_list]
    measured, completed = ([value for name, value in logged if name == f"depth/{kind}"] for kind in KINDS)
    assert len(measured) == len(completed) == 2 and pipeline.stop.call_count == 1
    np.testing.assert_allclose(measured[0], 2.5, rtol=1e-6)
    np.testing.assert_allclose(completed[0], 2.5, rtol=0.3)  # of an untrained network: the unit is right
    rerun.set_time.assert_called_with("camera", duration=1.0)


def test_what_the_fusion_calls_of_depthreg_is_there(example) -> None:
    module = example("open3d_fusion", open3d=MagicMock())
    assert callable(module.main) and module.depthreg is depthreg
