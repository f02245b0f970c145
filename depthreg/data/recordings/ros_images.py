"""ROS image messages as arrays: sensor_msgs/Image and CompressedImage of ROS 1 and ROS 2, without ROS.

Encodings: REP 118 for depth, `sensor_msgs/image_encodings.h` for colour, `compressed_depth_image_transport` for
compressed depth.
"""

import struct
from typing import Any

import cv2
import numpy as np

from depthreg.errors import InputError

_TO_RGB = {  # encoding -> bytes a pixel, OpenCV's conversion
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "UYVY": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "YUYV": (2, cv2.COLOR_YUV2RGB_YUY2),
}
_GREY = ("mono8", "8UC1")
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}  # librealsense calls its depth mono16
_COMPRESSED_DEPTH = "compressedDepth"
_HEADER = struct.Struct("<iff")  # of compressed depth: format, and two parameters of the quantised inverse depth


def shown_by(message: Any) -> str:
    """What an image message shows: `colour`, `grey` or `depth`; the encoding itself where it isn't known."""
    if hasattr(message, "encoding"):
        known = [("colour", _TO_RGB), ("grey", _GREY), ("depth", _DEPTH)]
        return next((kind for kind, encodings in known if message.encoding in encodings), message.encoding)
    if _COMPRESSED_DEPTH in message.format or message.format.startswith(tuple(_DEPTH)):
        return "depth"
    return "grey" if message.format.startswith(_GREY) else "colour"


def decode_rgb(message: Any) -> np.ndarray:
    """Colour of a message, (H, W, 3) uint8; grey is expanded.

    Raises:
        InputError: Not a colour image, or a damaged one.
    """
    if not hasattr(message, "encoding"):
        image = _decode(message.data, cv2.IMREAD_COLOR)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    grey = message.encoding in _GREY
    channels, conversion = (1, cv2.COLOR_GRAY2RGB) if grey else _TO_RGB.get(message.encoding, (0, None))
    if not channels:
        raise InputError(f"the encoding {message.encoding} isn't one of colour: expected {', '.join(_TO_RGB)}")
    pixels = _pixels(message, np.dtype("u1"), channels)
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)


def decode_depth_m(message: Any, scale: float) -> np.ndarray:
    """Depth of a message in metres, (H, W) float32, 0 = none.

    Args:
        message: Of 16-bit integers in stored units, or of floats, which are metres by REP 118.
        scale: Stored units per metre of integers.

    Raises:
        InputError: Not a depth image, a damaged one, or negative or infinite depths.
    """
    if hasattr(message, "encoding"):
        code = _DEPTH.get(message.encoding)
        if code is None:
            raise InputError(f"the encoding {message.encoding} isn't one of depth: expected {', '.join(_DEPTH)}")
        stored = _pixels(message, np.dtype((">" if message.is_bigendian else "<") + code), 1)
        depth_m = stored / np.float32(scale) if code == "u2" else stored
    else:
        depth_m = _decode_compressed_depth(message, scale)
    # REP 117: +-inf is what is too far or too near, NaN what is invalid.
    depth_m = np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32)
    if (depth_m < 0).any():
        raise InputError("it holds negative depths: positive depths, and 0 or NaN for none, were expected")
    return depth_m


def _pixels(message: Any, dtype: np.dtype, channels: int) -> np.ndarray:
    """The array of a raw message, (H, W) or (H, W, channels): rows may be longer than the image is wide."""
    row_bytes = message.width * channels * dtype.itemsize
    data = np.asarray(message.data, np.uint8)
    if message.step < row_bytes or data.size < message.height * message.step:
        raise InputError(f"{data.size} bytes are too few for {message.width}x{message.height} {message.encoding}")
    rows = data[: message.height * message.step].reshape(message.height, message.step)[:, :row_bytes]
    pixels = np.ascontiguousarray(rows).view(dtype).reshape(message.height, message.width, channels)
    return pixels[..., 0] if channels == 1 else pixels


def _decode(data: np.ndarray, flags: int) -> np.ndarray:
    image = cv2.imdecode(np.asarray(data, np.uint8), flags) if len(data) else None
    if image is None:
        raise InputError("a compressed image can't be decoded: an intact JPEG or PNG was expected")
    return image


def _decode_compressed_depth(message: Any, scale: float) -> np.ndarray:
    """A PNG of 16 bits, of integers or, where depth was float, of inverse depth; 12 bytes of header may precede."""
    data = np.asarray(message.data, np.uint8)
    if _COMPRESSED_DEPTH not in message.format:
        return _decode(data, cv2.IMREAD_UNCHANGED) / np.float32(scale)
    if "rvl" in message.format:
        raise InputError("depth is compressed as RVL: PNG or raw images were expected")
    if data.size <= _HEADER.size:
        raise InputError("a compressed depth image is cut off: a header and a PNG were expected")
    _, a, b = _HEADER.unpack(data[: _HEADER.size].tobytes())
    stored = _decode(data[_HEADER.size :], cv2.IMREAD_UNCHANGED)
    if not message.format.startswith("32FC1"):
        return stored / np.float32(scale)
    return np.divide(a, stored - np.float32(b), out=np.zeros(stored.shape, np.float32), where=stored > 0)
