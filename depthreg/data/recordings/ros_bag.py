"""ROS 1 and ROS 2 bags, MCAP, and the .bag files of RealSense's viewer: ROS 1 bags with topics of their own."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from depthreg.data.recordings.poses import pose_between, pose_from_transform, static_poses
from depthreg.data.recordings.projection import reproject_depth
from depthreg.data.recordings.recording import (
    Kind,
    RecordedFrame,
    Recording,
    Rgbd,
    Settings,
    associate,
    check_frame,
)
from depthreg.data.recordings.ros_images import decode_depth_m, decode_rgb, shown_by
from depthreg.errors import InputError

MILLIMETRES = 1000.0  # REP 118's unit of depth as 16-bit integers
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
# Where several topics would do: those that match, pattern by pattern, as far as any do.
_PREFERRED = {
    "colour": (r"colou?r|rgb", r"rect", r"^(?!.*/compressed)"),
    "depth": (r"depth", r"align|regist|depth_to_(colou?r|rgb)", r"^(?!.*/compressed)", r"rect"),
}
_VIEWER = re.compile(r"(?P<sensor>/device_\d+/sensor_\d+)/\w+/image/data")  # of librealsense's own recordings


class Bag:
    """The messages of a bag, by topic and time; may be asked from several threads."""

    def __init__(self, path: Path) -> None:
        try:
            highlevel, typesys = import_module("rosbags.highlevel"), import_module("rosbags.typesys")
        except ImportError as error:
            raise InputError(
                f"{path} needs the rosbags package: install it with `pip install 'depthreg[ros]'`"
            ) from error
        self.path, self._lock = path, Lock()
        # Bags of ROS 2 before Iron don't say what their messages look like; the types used here are the same in all.
        types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with self._readable():
            self._reader = highlevel.AnyReader([path], default_typestore=types)
            self._reader.open()
        self.types = {connection.topic: connection.msgtype for connection in self._reader.connections}

    def messages(self, topic: str, recorded_ns: int | None = None) -> Iterator[tuple[int, Any]]:
        """When each message of a topic was recorded, and the message; only those of one time, if it is given."""
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        stop_ns = None if recorded_ns is None else recorded_ns + 1
        with self._readable():
            for connection, time_ns, data in self._reader.messages(connections, recorded_ns, stop_ns):
                yield time_ns, self._reader.deserialize(data, connection.msgtype)

    def first(self, topic: str, recorded_ns: int | None = None) -> Any:
        """The first message of a topic, or that of a certain time; None where there is none."""
        if topic not in self.types:
            return None
        with self._lock:
            return next((message for _, message in self.messages(topic, recorded_ns)), None)

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except (InputError, GeneratorExit):
            raise
        except Exception as error:  # the reader's own errors, SQLite's, struct's: a damaged file brings them all
            raise InputError(f"{self.path} can't be read as a bag: {error}") from error


class View(NamedTuple):
    """An image topic, and the camera behind it."""

    topic: str
    size: tuple[int, int]  # height, width
    frame_id: str
    intrinsics: np.ndarray | None  # K (3, 3) float32


def _is_bag(path: Path) -> bool:
    return path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


def _open(path: Path, settings: Settings) -> Recording:
    if not path.exists():
        raise InputError(f"{path} can't be read: no such file")
    bag = Bag(path)
    kinds = _image_topics(bag)
    rgb = _view(bag, _choose(path, kinds, "colour", settings.rgb_topic), decode_rgb)
    depth_topic = _choose(path, kinds, "depth", settings.depth_topic)
    scale = settings.depth_scale or _viewer_scale(bag, depth_topic) or MILLIMETRES
    depth = _view(bag, depth_topic, lambda message: decode_depth_m(message, scale))
    onto_rgb = _onto_rgb(path, rgb, depth, _rgb_from_depth(bag, rgb, depth))
    rgb_times, depth_times = _times(bag, rgb.topic), _times(bag, depth.topic)
    pairs = associate([time for time, _ in rgb_times], [time for time, _ in depth_times], path)
    frames = []
    for i, j in pairs:
        (time_s, rgb_ns), (_, depth_ns) = rgb_times[i], depth_times[j]
        read = _reader(bag, (rgb, rgb_ns), (depth, depth_ns), scale, onto_rgb)
        frames.append(RecordedFrame(f"{time_s:.6f}", read, time_s))
    return Recording(frames, scale, len(rgb_times) + len(depth_times) - 2 * len(pairs))


def _image_topics(bag: Bag) -> dict[str, str]:
    """What each image topic shows: `colour`, `grey`, `depth`, or an encoding that isn't known."""
    first = {topic: bag.first(topic) for topic, kind in bag.types.items() if kind in _IMAGES}
    return {topic: shown_by(message) for topic, message in first.items() if message is not None}


def _choose(path: Path, kinds: dict[str, str], kind: str, wanted: str | None) -> str:
    """The topic that the user names, or the only one that is of a kind, as far as names tell."""
    option = "--rgb-topic" if kind == "colour" else "--depth-topic"
    if wanted is not None:
        if wanted not in kinds:
            raise InputError(f"{option} {wanted} is no image topic of {path}: expected one of {', '.join(kinds)}")
        return wanted
    found = [topic for topic, shown in kinds.items() if shown == kind]
    if not found and kind == "colour":
        found = [topic for topic, shown in kinds.items() if shown == "grey"]
    for pattern in _PREFERRED[kind]:
        found = [topic for topic in found if re.search(pattern, topic, re.IGNORECASE)] or found
    if not found:
        shown = ", ".join(f"{topic} ({shown})" for topic, shown in kinds.items()) or "none"
        raise InputError(f"{path} holds no image topic of {kind}: its image topics are {shown}")
    if len(found) > 1:
        raise InputError(f"{path} holds several topics of {kind}, {', '.join(found)}: name one with {option}")
    return found[0]


def _view(bag: Bag, topic: str, decode: Callable[[Any], np.ndarray]) -> View:
    message = bag.first(topic)
    height, width = _decoded(f"{bag.path}: {topic}", decode, message).shape[:2]
    return View(topic, (height, width), message.header.frame_id, _intrinsics(bag, topic, (height, width)))


def _intrinsics(bag: Bag, topic: str, size: tuple[int, int]) -> np.ndarray | None:
    """K of a topic's camera, from the CameraInfo that belongs beside it; None where there is none of this size."""
    image = re.sub(r"/compressed(Depth)?$", "", topic)
    viewer = _VIEWER.fullmatch(topic)
    beside = [topic.replace("/image/data", "/info")] if viewer else [image.rpartition("/")[0], image]
    info = next((info for place in beside if (info := bag.first(f"{place}/camera_info")) is not None), None)
    if info is None or (info.height, info.width) != size:
        return None
    k, p = (np.asarray(getattr(info, name, getattr(info, name.upper(), None)), np.float32) for name in "kp")
    # A rectified image's camera is P's left part; whether P is filled in is up to the driver.
    intrinsics = p.reshape(3, 4)[:, :3] if "rect" in topic and p[0] > 0 else k.reshape(3, 3)
    return np.ascontiguousarray(intrinsics) if intrinsics[0, 0] > 0 else None


def _rgb_from_depth(bag: Bag, rgb: View, depth: View) -> np.ndarray | None:
    """Pose (4, 4) from the depth camera's coordinates into the colour camera's; None where the bag doesn't say."""
    if _VIEWER.fullmatch(rgb.topic) and _VIEWER.fullmatch(depth.topic):
        # Each stream's own transform leads from the device's reference into the stream.
        messages = [bag.first(view.topic.replace("/image/data", "/tf/0")) for view in (rgb, depth)]
        if None in messages:
            return None
        rgb_from_reference, depth_from_reference = (pose_from_transform(message) for message in messages)
        return rgb_from_reference @ np.linalg.inv(depth_from_reference)
    if rgb.frame_id == depth.frame_id or not (rgb.frame_id and depth.frame_id):
        return np.eye(4)
    transforms = bag.messages("/tf_static") if "/tf_static" in bag.types else ()
    return pose_between(rgb.frame_id, depth.frame_id, static_poses(transforms))


def _onto_rgb(
    path: Path, rgb: View, depth: View, rgb_from_depth: np.ndarray | None
) -> Callable[[np.ndarray], np.ndarray] | None:
    """How to bring depth onto colour's grid; None where it is there already.

    Raises:
        InputError: It isn't, and the bag doesn't say where the cameras are.
    """
    if rgb.size == depth.size and _alike(rgb.intrinsics, depth.intrinsics) and _alike(rgb_from_depth, np.eye(4)):
        return None
    if rgb.intrinsics is None or depth.intrinsics is None or rgb_from_depth is None:
        known = rgb_from_depth is not None
        missing = "CameraInfo of both of this size" if known else "the pose between them in /tf_static"
        raise InputError(
            f"{path}: {depth.topic} and {rgb.topic} are of two cameras, and depth can't be brought onto colour's grid: "
            f"{missing} was expected"
        )
    to_rgb = (depth.intrinsics, rgb_from_depth, rgb.intrinsics, rgb.size)
    return lambda depth_m: reproject_depth(depth_m, *to_rgb)


def _alike(ours: np.ndarray | None, theirs: np.ndarray | None) -> bool:
    """Whether two matrices are the same to 1 %, as far as both are known."""
    return ours is None or theirs is None or np.allclose(ours, theirs, rtol=0.01, atol=1e-6)


def _times(bag: Bag, topic: str) -> list[tuple[float, int]]:
    """When each image was taken in seconds, by its header, and when it was recorded, in nanoseconds."""
    times = []
    for recorded_ns, message in bag.messages(topic):
        stamp = message.header.stamp
        taken_s = stamp.sec + 1e-9 * stamp.nanosec
        times.append((taken_s or 1e-9 * recorded_ns, recorded_ns))  # a driver may leave its stamps at 0
    return times


def _viewer_scale(bag: Bag, topic: str) -> float | None:
    """Stored units per metre, where the RealSense's viewer recorded its option."""
    match = _VIEWER.fullmatch(topic)
    if not match:
        return None
    names = (name for name in bag.types if name.replace(" ", "_") == f"{match['sensor']}/option/Depth_Units/value")
    unit_m = next((bag.first(name).data for name in names), 0)
    return round(1 / unit_m, 3) if unit_m > 0 else None


def _reader(
    bag: Bag,
    rgb: tuple[View, int],
    depth: tuple[View, int],
    scale: float,
    onto_rgb: Callable[[np.ndarray], np.ndarray] | None,
) -> Callable[[], Rgbd]:
    def read() -> Rgbd:
        names = [f"{bag.path}: {view.topic} at {recorded_ns * 1e-9:.6f} s" for view, recorded_ns in (rgb, depth)]
        colour = _decoded(names[0], decode_rgb, bag.first(rgb[0].topic, rgb[1]))
        depth_m = _decoded(
            names[1], lambda message: decode_depth_m(message, scale), bag.first(depth[0].topic, depth[1])
        )
        return check_frame(Rgbd(colour, onto_rgb(depth_m) if onto_rgb else depth_m, rgb[0].intrinsics), *names)

    return read


def _decoded(name: str, decode: Callable[[Any], np.ndarray], message: Any) -> np.ndarray:
    """The array of a message; what is wrong with it is said with its name."""
    try:
        return decode(message)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


KIND = Kind("ROS bag, MCAP or RealSense .bag", "metadata.yaml, or a file of .mcap, .db3 or .bag", _is_bag, _open)
