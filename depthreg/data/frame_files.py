"""One frame as a folder of files that any viewer opens: all that a `Frame` holds, and where its cameras stood."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from depthreg.data import io
from depthreg.data.memory import MemoryFile, MemoryFolder
from depthreg.data.sample import Frame, LidarColumns, LidarReturns, OffsetView
from depthreg.errors import InputError
from depthreg.rendering.rig import Rig
from depthreg.worlds.scene import Scene

FILES = {
    "rgb.png": "left colour, 8 bits, with margin_px more on each side than depth.png",
    "depth.png": "z-depth, 16 bits, metres times depth_scale; 0 = sky",
    "rgb_right.png": "right camera of the rectified pair, without margin; absent where not rendered",
    "depth_right.png": "its depth, as depth.png; absent where not rendered",
    "object_id.png": "16 bits, number of the object plus 1; 0 = sky",
    "normal.png": "unit normal (x right, y down, z forward), 16 bits, (n + 1) * 32767; 32767 three times = sky",
    "albedo.png": "diffuse reflectivity in [0, 1], 16 bits, times 65535",
    "gloss.png": "share of the light that is mirrored, as albedo.png",
    "rgb_offset.png": "a colour camera beside the depth camera, as rgb.png; absent where not rendered",
    "lidar.ply": "returns in camera coordinates (m); their columns are those of depthreg.data.sample.LidarReturns",
    "calibration.json": "intrinsics (K of depth.png), margin_px, baseline_m, depth_scale, and rigid poses (4 x 4)",
}
_UINT16_MAX = np.iinfo(np.uint16).max
_NORMAL_SCALE = 32767
_VECTORS = {"uv_px": ("u_px", "v_px"), "ray": ("ray_x", "ray_y", "ray_z")}  # of LidarReturns, a property for each part
_LIDAR = np.dtype(
    [(name, "<f4") for name in "xyz"] + [(name, "<i2" if name == "ring" else "<f4") for name in LidarColumns._fields],
)


def write_frame(folder: Path, frame: Frame, scene: Scene, depth_scale: float) -> None:
    """Write what `FILES` lists into an existing folder.

    Args:
        folder: Where to.
        frame: What perfect instruments see.
        scene: Of what; says where the camera and the LiDAR stand.
        depth_scale: Stored value per metre: the precision is half its inverse.

    Raises:
        InputError: A depth doesn't fit into 16 bits at this scale.
    """
    _write_depth(folder / "depth.png", frame.depth_m, depth_scale)
    if frame.rgb_right.size:
        io.write_png(folder / "rgb_right.png", frame.rgb_right)
        _write_depth(folder / "depth_right.png", frame.depth_right_m, depth_scale)
    io.write_png(folder / "rgb.png", frame.rgb)
    io.write_png(folder / "object_id.png", (frame.object_id + 1).astype(np.uint16))
    io.write_png(folder / "normal.png", np.rint((frame.normal + 1) * _NORMAL_SCALE).astype(np.uint16))
    for name, share in (("albedo.png", frame.albedo), ("gloss.png", frame.gloss)):
        io.write_png(folder / name, np.rint(share.clip(0, 1) * _UINT16_MAX).astype(np.uint16))
    if frame.offset:
        io.write_png(folder / "rgb_offset.png", frame.offset.rgb)
    io.write_ply_vertices(folder / "lidar.ply", _lidar_vertices(frame.lidar, frame.intrinsics))
    io.write_json(folder / "calibration.json", _calibration(frame, scene, depth_scale))


def _write_depth(path: Path, depth_m: np.ndarray, scale: float) -> None:
    if depth_m.max(initial=0) * scale > _UINT16_MAX + 0.5:
        raise InputError(
            f"depth_scale={scale:g} ends at {_UINT16_MAX / scale:.1f} m, but a depth is {depth_m.max():.1f} m: "
            f"expected at most {_UINT16_MAX / depth_m.max():.0f}"
        )
    io.write_depth_png(path, depth_m, scale)


def _lidar_vertices(lidar: LidarReturns, intrinsics: np.ndarray) -> np.ndarray:
    vertices = np.empty(len(lidar.depth_m), _LIDAR)
    position_m = (lidar.uv_px - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]] * lidar.depth_m[:, None]
    vertices["x"], vertices["y"] = position_m.T
    vertices["z"] = lidar.depth_m
    for field in fields(LidarReturns):
        columns = getattr(lidar, field.name).T
        if field.name in _VECTORS:
            for name, column in zip(_VECTORS[field.name], columns, strict=True):
                vertices[name] = column
        else:
            vertices[field.name] = columns
    return vertices


def _calibration(frame: Frame, scene: Scene, depth_scale: float) -> dict[str, Any]:
    height, width = frame.depth_m.shape
    poses = {"camera_from_world": scene.camera_from_world, "lidar_from_camera": scene.lidar_from_camera}
    if frame.offset:
        poses["rgb_offset_from_depth"] = frame.offset.rgb_from_depth
    return {
        "width": width,
        "height": height,
        "margin_px": frame.margin_px,
        "depth_scale": depth_scale,
        "baseline_m": float(frame.baseline_m),
        "intrinsics": frame.intrinsics.tolist(),
        **{name: pose.tolist() for name, pose in poses.items()},
    }


def read_frame(folder: Path | MemoryFolder, rig: Rig | None = None) -> Frame:
    """Read what `write_frame` wrote; colours, returns and calibration are exact, the rest is to its 16 bits.

    Args:
        folder: Of one frame.
        rig: Where given, planes that it doesn't ask for are left empty, (0, 0), to save their decoding.

    Raises:
        InputError: A file is missing or damaged.
    """
    calibration = io.read_json(folder / "calibration.json")
    scale = calibration["depth_scale"]
    surfaces = rig is None or rig.surfaces or bool(rig.matchers)  # a matcher may look at everything
    right = (folder / "rgb_right.png").exists() if rig is None else rig.right or bool(rig.matchers)
    offset = "rgb_offset_from_depth" in calibration and (rig is None or rig.offset is not None)
    empty = np.zeros((0, 0), np.float32)
    return Frame(
        rgb=io.read_png(folder / "rgb.png"),
        margin_px=calibration["margin_px"],
        depth_m=_read_plane(folder / "depth.png", scale),
        object_id=io.read_png(folder / "object_id.png").astype(np.int32) - 1 if rig is None else empty.astype(np.int32),
        normal=_read_normal(folder / "normal.png") if surfaces else np.zeros((0, 0, 3), np.float32),
        albedo=_read_plane(folder / "albedo.png", _UINT16_MAX) if surfaces else empty,
        gloss=_read_plane(folder / "gloss.png", _UINT16_MAX) if surfaces else empty,
        intrinsics=np.array(calibration["intrinsics"], np.float32),
        rgb_right=io.read_png(folder / "rgb_right.png") if right else np.zeros((0, 0, 3), np.uint8),
        depth_right_m=_read_plane(folder / "depth_right.png", scale) if right else empty,
        baseline_m=calibration["baseline_m"],
        lidar=_read_lidar(folder / "lidar.ply"),
        offset=_read_offset(folder, calibration) if offset else None,
    )


def _read_plane(path: Path | MemoryFile, scale: float) -> np.ndarray:
    return (io.read_png(path) / np.float64(scale)).astype(np.float32)


def _read_normal(path: Path | MemoryFile) -> np.ndarray:
    return io.read_png(path).astype(np.float32) / _NORMAL_SCALE - 1


def _read_lidar(path: Path | MemoryFile) -> LidarReturns:
    vertices = io.read_ply_vertices(path)
    columns = {}
    for field in fields(LidarReturns):
        parts = [np.ascontiguousarray(vertices[name]) for name in _VECTORS.get(field.name, (field.name,))]
        columns[field.name] = np.stack(parts, axis=-1) if field.name in _VECTORS else parts[0]
    return LidarReturns(**columns)


def _read_offset(folder: Path | MemoryFolder, calibration: dict[str, Any]) -> OffsetView:
    return OffsetView(io.read_png(folder / "rgb_offset.png"), np.array(calibration["rgb_offset_from_depth"]))
