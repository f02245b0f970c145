"""Bags that the rosbags package writes, in every format, are read back to the pixel."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'depthreg[ros]'")
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from depthreg.data.recordings import Settings, open_recording
from depthreg.data.recordings.projection import reproject_depth
from depthreg.data.recordings.ros_images import decode_depth_m, decode_rgb
from depthreg.errors import InputError

HEIGHT, WIDTH = 66, 91
RGB_K = np.array([[80.0, 0, 44], [0, 82, 31], [0, 0, 1]])
DEPTH_K = np.array([[70.0, 0, 41], [0, 71, 36], [0, 0, 1]])
TURN, MOVE_M = Rotation.from_euler("xyz", [1, -2, 3], degrees=True), (0.03, -0.01, 0.02)
RGB, DEPTH = "/camera/color/image_raw", "/camera/depth/image_raw"
Message = tuple[str, float, Any]  # topic, time in seconds, message


def _rgb(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def _stored(seed: int = 0) -> np.ndarray:
    """Millimetres; a third of the pixels have none."""
    rng = np.random.default_rng(seed)
    depth = rng.integers(1000, 9000, (HEIGHT, WIDTH))
    return np.where(rng.random((HEIGHT, WIDTH)) < 0.7, depth, 0).astype(np.uint16)


class Ros:
    """Messages of ROS 2, or of ROS 1 with its other spellings."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS2_JAZZY if version == 2 else Stores.ROS1_NOETIC)

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, time_s: float, frame_id: str) -> Any:
        sec, nanosec = divmod(round(time_s * 1e9), 10**9)
        more = {} if self.version == 2 else {"seq": 0}
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **more)

    def image(self, array: np.ndarray, encoding: str, time_s: float = 0, frame_id: str = "", padding: int = 0) -> Any:
        rows = np.ascontiguousarray(array).view(np.uint8).reshape(len(array), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
        size = {"height": array.shape[0], "width": array.shape[1], "step": rows.shape[1]}
        fields = {"encoding": encoding, "is_bigendian": 0, "data": rows.ravel(), **size}
        return self.make("sensor_msgs/msg/Image", header=self.header(time_s, frame_id), **fields)

    def compressed(self, data: bytes, form: str, time_s: float = 0) -> Any:
        fields = {"format": form, "data": np.frombuffer(data, np.uint8)}
        return self.make("sensor_msgs/msg/CompressedImage", header=self.header(time_s, ""), **fields)

    def camera(self, matrix: np.ndarray, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Any:
        region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | {"do_rectify": False}
        matrices = {"d": np.zeros(5), "k": matrix.ravel(), "r": np.eye(3).ravel(), "p": np.zeros(12)}
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(0, ""),
            height=size[0],
            width=size[1],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=self.make("sensor_msgs/msg/RegionOfInterest", **region),
            **(matrices if self.version == 2 else {name.upper(): value for name, value in matrices.items()}),
        )

    def transform(self, turn: Rotation, move_m: tuple[float, ...]) -> Any:
        quaternion = dict(zip("xyzw", turn.as_quat(), strict=True))
        rotation = self.make("geometry_msgs/msg/Quaternion", **quaternion)
        translation = self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", move_m, strict=True)))
        return self.make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)

    def static(self, *poses: tuple[str, str, Rotation, tuple[float, ...]]) -> Any:
        """Of parents, children, and where the children are in them."""
        stamped = [
            self.make(
                "geometry_msgs/msg/TransformStamped",
                header=self.header(0, parent),
                child_frame_id=child,
                transform=self.transform(turn, move_m),
            )
            for parent, child, turn, move_m in poses
        ]
        return self.make("tf2_msgs/msg/TFMessage", transforms=stamped)

    def write(self, path: Path, messages: list[Message], plugin: str = "SQLITE3") -> Path:
        """A bag of messages; MCAP as the single file that it is."""
        if self.version == 2:
            writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
        else:
            writer = rosbag1.Writer(path)
        serialize = self.store.serialize_cdr if self.version == 2 else self.store.serialize_ros1
        with writer:
            topics = {topic: message.__msgtype__ for topic, _, message in messages}
            of_topic = {name: writer.add_connection(name, kind, typestore=self.store) for name, kind in topics.items()}
            for topic, time_s, message in messages:
                writer.write(of_topic[topic], round(time_s * 1e9), serialize(message, message.__msgtype__))
        return next(path.glob("*.mcap")) if plugin == "MCAP" else path


ros2, ros1 = Ros(2), Ros(1)


def _aligned(ros: Ros) -> list[Message]:
    """Two frames whose colour comes 4 ms before its depth and is recorded late, and a colour image too many."""
    messages = [(RGB.replace("image_raw", "camera_info"), 5.0, ros.camera(RGB_K))]
    for seed, time_s in enumerate((10.0, 10.1)):
        messages.append((RGB, time_s + 0.06, ros.image(_rgb(seed), "rgb8", time_s, padding=5)))
        messages.append((DEPTH, time_s + 0.01, ros.image(_stored(seed), "16UC1", time_s + 0.004)))
    return [*messages, (RGB, 10.21, ros.image(_rgb(9), "rgb8", 10.2))]


WRITERS: dict[str, Callable[[Path], Path]] = {
    "ROS 2, SQLite": lambda path: ros2.write(path / "bag", _aligned(ros2)),
    "ROS 2, MCAP": lambda path: ros2.write(path / "bag", _aligned(ros2), "MCAP"),
    "ROS 1": lambda path: ros1.write(path / "one.bag", _aligned(ros1)),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_frames_pair_by_the_time_they_were_taken_at_and_come_back_to_the_pixel(tmp_path, kind):
    recording = open_recording(WRITERS[kind](tmp_path), Settings())
    assert [frame.name for frame in recording.frames] == ["10.000000", "10.100000"]
    assert (recording.unpaired, recording.depth_scale) == (1, 1000)
    for seed in (1, 0):  # in any order
        frame = recording.frames[seed].read()
        np.testing.assert_array_equal(frame.rgb, _rgb(seed))
        np.testing.assert_array_equal(frame.depth_m, _stored(seed) / np.float32(1000))
        np.testing.assert_array_equal(frame.intrinsics, np.float32(RGB_K))


def test_compressed_colour_and_float_depth_are_read(tmp_path):
    jpeg = cv2.imencode(".jpg", _rgb())[1].tobytes()
    depth_m = np.where(_stored() > 0, _stored() / np.float32(1000), np.nan).astype(np.float32)
    depth_m[0, 0] = np.inf
    messages = [
        (RGB + "/compressed", 1, ros2.compressed(jpeg, "rgb8; jpeg compressed bgr8", 1)),
        (DEPTH, 1, ros2.image(depth_m, "32FC1", 1)),
    ]
    frame = open_recording(ros2.write(tmp_path / "bag", messages), Settings()).frames[0].read()
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(frame.rgb, decoded[..., ::-1])
    np.testing.assert_array_equal(frame.depth_m, np.where(np.isfinite(depth_m), depth_m, 0))
    assert frame.intrinsics is None


def test_compressed_depth_is_read_in_its_three_forms():
    png = cv2.imencode(".png", _stored())[1].tobytes()
    whole_m = _stored() / np.float32(1000)
    header = struct.pack("<iff", 0, 0, 0)
    for form, data in (("16UC1; compressedDepth png", header + png), ("16UC1; png compressed ", png)):
        np.testing.assert_array_equal(decode_depth_m(ros2.compressed(data, form), 1000), whole_m)
    # Floats are stored as a / depth + b: the step at 9 m is 9^2 / a.
    a, b = 2000.0, 40.0
    inverse = np.where(whole_m > 0, np.rint(a / np.maximum(whole_m, 0.1) + b), 0).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + cv2.imencode(".png", inverse)[1].tobytes()
    found = decode_depth_m(ros2.compressed(data, "32FC1; compressedDepth png"), 1000)
    np.testing.assert_array_equal(found > 0, whole_m > 0)
    assert np.abs(found - whole_m).max() < 0.5 * 9**2 / a + 1e-3
    with pytest.raises(InputError, match="RVL"):
        decode_depth_m(ros2.compressed(data, "16UC1; compressedDepth rvl"), 1000)


COLOURED = {  # pictures of one colour, (200, 100, 50) where an encoding can say so
    "bgr8": ([50, 100, 200], (200, 100, 50)),
    "rgba8": ([200, 100, 50, 9], (200, 100, 50)),
    "bgra8": ([50, 100, 200, 9], (200, 100, 50)),
    "mono8": ([77], (77, 77, 77)),
    "yuv422": ([90, 81, 240, 81], (254, 0, 0)),  # red by BT.601
    "yuv422_yuy2": ([81, 90, 81, 240], (254, 0, 0)),
}


@pytest.mark.parametrize("encoding", COLOURED)
def test_colour_encodings_mean_what_ros_says(encoding):
    pixel, expected = COLOURED[encoding]
    channels = 2 if encoding.startswith("yuv") else len(pixel)
    picture = np.tile(np.uint8(pixel), (8, 10 * channels // len(pixel))).reshape(8, 10, channels)
    found = decode_rgb(ros2.image(picture, encoding))
    assert found.shape == (8, 10, 3) and np.abs(found.astype(int) - expected).max() <= 1


def test_a_bayer_mosaic_of_one_colour_is_that_colour():
    mosaic = np.tile(np.uint8([[200, 100], [100, 50]]), (6, 6))
    np.testing.assert_array_equal(
        decode_rgb(ros2.image(mosaic, "bayer_rggb8")), np.tile(np.uint8([200, 100, 50]), (12, 12, 1))
    )


def _two_cameras(*more: Message) -> list[Message]:
    frames = {RGB: "color_frame", DEPTH: "depth_frame"}
    return [
        (RGB, 1, ros2.image(_rgb(), "rgb8", 1, frames[RGB])),
        (DEPTH, 1, ros2.image(_stored()[:60], "16UC1", 1, frames[DEPTH])),
        ("/camera/color/camera_info", 0, ros2.camera(RGB_K)),
        ("/camera/depth/camera_info", 0, ros2.camera(DEPTH_K, (60, WIDTH))),
        *more,
    ]


def test_depth_of_another_camera_is_brought_onto_colours_grid_by_tf_static(tmp_path):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN.as_matrix(), MOVE_M
    # The chain: where colour is in the body, where the mount is in the body, where depth is in the mount.
    colour_in_body = (Rotation.from_euler("y", 20, degrees=True), (0.1, 0.2, 0.3))
    body_from_colour, mount = np.eye(4), np.eye(4)
    body_from_colour[:3, :3], body_from_colour[:3, 3] = colour_in_body[0].as_matrix(), colour_in_body[1]
    mount[2, 3] = 0.5
    mount_from_depth = np.linalg.inv(mount) @ body_from_colour @ pose
    static = ros2.static(
        ("body", "color_frame", *colour_in_body),
        ("body", "mount", Rotation.identity(), (0, 0, 0.5)),
        ("mount", "depth_frame", Rotation.from_matrix(mount_from_depth[:3, :3]), tuple(mount_from_depth[:3, 3])),
    )
    bag = ros2.write(tmp_path / "bag", _two_cameras(("/tf_static", 0, static)))
    found = open_recording(bag, Settings()).frames[0].read().depth_m
    expected = reproject_depth(_stored()[:60] / np.float32(1000), DEPTH_K, pose, RGB_K, (HEIGHT, WIDTH))
    assert (found > 0).mean() > 0.05  # most of it lies behind neighbours
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_two_cameras_without_a_pose_between_them_are_refused(tmp_path):
    with pytest.raises(InputError, match="the pose between them in /tf_static was expected"):
        open_recording(ros2.write(tmp_path / "bag", _two_cameras()), Settings())
    static = ros2.static(("color_frame", "depth_frame", TURN, MOVE_M))
    without = [message for message in _two_cameras(("/tf_static", 0, static)) if "camera_info" not in message[0]]
    with pytest.raises(InputError, match="CameraInfo of both"):
        open_recording(ros2.write(tmp_path / "other", without), Settings())


def test_a_realsense_viewers_bag_knows_its_unit_and_where_its_cameras_are(tmp_path):
    depth, colour = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
    unit = ros1.make("std_msgs/msg/Float32", data=0.0001)
    messages = [  # transforms lead from the device's reference, the depth camera, into each stream
        (f"{depth}/info/camera_info", 0, ros1.camera(DEPTH_K)),
        (f"{colour}/info/camera_info", 0, ros1.camera(RGB_K)),
        (f"{depth}/tf/0", 0, ros1.transform(Rotation.identity(), (0, 0, 0))),
        (f"{colour}/tf/0", 0, ros1.transform(TURN, MOVE_M)),
        ("/device_0/sensor_0/option/Depth Units/value", 0, unit),
        (f"{depth}/image/data", 3, ros1.image(10 * (_stored() // 10), "mono16", 3, "0")),
        (f"{colour}/image/data", 3.001, ros1.image(_rgb(), "rgb8", 3.001, "0")),
        ("/device_0/sensor_0/Infrared_1/image/data", 3, ros1.image(_rgb()[..., 0], "8UC1", 3, "0")),
    ]
    recording = open_recording(ros1.write(tmp_path / "viewer.bag", messages), Settings())
    frame = recording.frames[0].read()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN.as_matrix(), MOVE_M
    expected = reproject_depth(10 * (_stored() // 10) / np.float32(10000), DEPTH_K, pose, RGB_K, (HEIGHT, WIDTH))
    assert recording.depth_scale == 10000 and (frame.depth_m > 0).mean() > 0.05
    np.testing.assert_allclose(frame.depth_m, expected, atol=1e-4)
    np.testing.assert_array_equal(frame.rgb, _rgb())


def test_aligned_depth_is_preferred_and_what_remains_unclear_is_asked_for(tmp_path):
    aligned = "/camera/aligned_depth_to_color/image_raw"
    messages = [
        (RGB, 1, ros2.image(_rgb(), "rgb8", 1)),
        ("/camera/infra1/image_rect_raw", 1, ros2.image(_rgb()[..., 0], "mono8", 1)),
        (DEPTH, 1, ros2.image(_stored(1), "16UC1", 1)),
        (aligned, 1, ros2.image(_stored(2), "16UC1", 1)),
    ]
    bag = ros2.write(tmp_path / "bag", messages)
    found = open_recording(bag, Settings()).frames[0].read()
    np.testing.assert_array_equal(found.depth_m, _stored(2) / np.float32(1000))
    picked = open_recording(bag, Settings(depth_topic=DEPTH)).frames[0].read()
    np.testing.assert_array_equal(picked.depth_m, _stored(1) / np.float32(1000))
    with pytest.raises(InputError, match=f"--depth-topic /nowhere is no image topic .*{aligned}"):
        open_recording(bag, Settings(depth_topic="/nowhere"))
    left = [("/left/" + RGB, 1, messages[0][2]), ("/right" + RGB, 1, messages[0][2]), messages[3]]
    with pytest.raises(InputError, match=r"several topics of colour, .*: name one with --rgb-topic"):
        open_recording(ros2.write(tmp_path / "two", left), Settings())
    with pytest.raises(InputError, match="no image topic of depth"):
        open_recording(ros2.write(tmp_path / "none", messages[:2]), Settings())


def test_a_damaged_bag_is_one_sentence(tmp_path):
    for name in ("a.mcap", "b.bag", "c.db3"):
        (tmp_path / name).write_bytes(b"no bag at all, but long enough to look into")
        with pytest.raises(InputError, match=f"{name} can't be read as a bag"):
            open_recording(tmp_path / name, Settings())


def test_a_damaged_image_is_named_when_it_is_read(tmp_path):
    spoilt = ros2.image(_stored(), "16UC1", 2)
    spoilt.data = spoilt.data[:100]
    messages = [*((RGB, time_s, ros2.image(_rgb(), "rgb8", time_s)) for time_s in (1, 2)), (DEPTH, 2, spoilt)]
    messages.append((DEPTH, 1, ros2.image(_stored(), "16UC1", 1)))
    first, second = open_recording(ros2.write(tmp_path / "bag", messages), Settings()).frames
    assert first.read().depth_m.any()
    with pytest.raises(InputError, match=f"{DEPTH} at 2.000000 s: 100 bytes are too few for 91x66"):
        second.read()
