"""Embree through its C interface, because neighbouring rays in packets take a quarter of the time of single ones.

embreex ships the library, but its own interface casts single rays. Structures and constants are those of
`rtcore_ray.h` and `rtcore_common.h` of Embree 4, https://github.com/RenderKit/embree.
"""

import ctypes
import sys
import weakref
from collections import deque
from functools import cache
from itertools import repeat
from pathlib import Path

import numpy as np
from embreex import rtcore_scene

_POINTER, _INT, _UINT, _SIZE = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint, ctypes.c_size_t
_SIGNATURES = {  # result, arguments
    "rtcNewDevice": (_POINTER, ctypes.c_char_p),
    "rtcReleaseDevice": (None, _POINTER),
    "rtcGetDeviceError": (_INT, _POINTER),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, _POINTER, _INT),
    "rtcNewScene": (_POINTER, _POINTER),
    "rtcSetSceneFlags": (None, _POINTER, _INT),
    "rtcCommitScene": (None, _POINTER),
    "rtcReleaseScene": (None, _POINTER),
    "rtcNewGeometry": (_POINTER, _POINTER, _INT),
    "rtcSetSharedGeometryBuffer": (None, _POINTER, _INT, _UINT, _INT, _POINTER, _SIZE, _SIZE, _SIZE),
    "rtcCommitGeometry": (None, _POINTER),
    "rtcAttachGeometry": (_UINT, _POINTER, _POINTER),
    "rtcReleaseGeometry": (None, _POINTER),
    **{
        f"rtc{query}{width}": (None, _POINTER, _POINTER, _POINTER, _POINTER)
        for query in ("Intersect", "Occluded")
        for width in (8, 16)
    },
}
_WATERTIGHT = 1 << 2  # "robust": no ray slips through where two faces meet
_TRIANGLES = 0
_INDEX_BUFFER, _VERTEX_BUFFER = 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_PACKETS_OF_16_ARE_NATIVE = 34
_STRAIGHT = 1e-15  # below 1e-18 Embree takes the sign of a direction's part for positive, and a packet of both misses
_BYTES = 4  # of all that a packet holds

# Rows of a packet; each holds one number for each of its rays.
_ORIGIN, _DIRECTION, _RANGE, _MASK, _FACE, _GEOMETRY = slice(0, 3), slice(4, 7), 8, 9, 17, 18
_RAY_ROWS = 12
_HIT_ROWS = 24  # builds of Embree differ in how many numbers of instances follow; none needs more


class _Arguments(ctypes.Structure):
    """RTCIntersectArguments, and RTCOccludedArguments likewise."""

    _fields_ = (
        ("flags", _INT),
        ("features", _UINT),
        ("context", _POINTER),
        ("filter", _POINTER),
        ("callback", _POINTER),
    )


_COHERENT = _Arguments(flags=1 << 16, features=0xFFFFFFFF)


@cache
def _embree() -> ctypes.PyDLL:
    """The Embree that embreex has loaded: looking a function up in a library also looks into what that one needs."""
    library = Path(rtcore_scene.__file__)
    if sys.platform == "win32":  # where it doesn't
        library = next(library.parents[1].glob("embreex*/embree4*.dll"))
    embree = ctypes.PyDLL(str(library))  # keeps the interpreter's lock: giving it up costs more than tracing a packet
    for name, (result, *arguments) in _SIGNATURES.items():
        function = getattr(embree, name)
        function.restype, function.argtypes = result, arguments
    return embree


def _aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros, float32, that start where Embree's widest instructions can load from."""
    size, align = int(np.prod(shape)), 64 // _BYTES
    room = np.zeros(size + align, np.float32)
    start = -(room.ctypes.data // _BYTES) % align
    return room[start : start + size].reshape(shape)


class RayTree:
    """A tree over triangles that finds what rays meet.

    Args:
        points: Corners of the triangles, (V, 3).
        corners: Which three points make each face, (F, 3).
    """

    def __init__(self, points: np.ndarray, corners: np.ndarray) -> None:
        embree = self._embree = _embree()
        device = embree.rtcNewDevice(b"threads=1")  # frames are made in parallel, not parts of them
        self._scene = embree.rtcNewScene(device)
        weakref.finalize(self, _release, self._scene, device)
        self._width = 16 if embree.rtcGetDeviceProperty(device, _PACKETS_OF_16_ARE_NATIVE) else 8
        # Embree reads these where they are, and four numbers for the three of a point.
        self._points = np.zeros((len(points) + 1, 3), np.float32)
        self._points[:-1] = points
        self._corners = np.ascontiguousarray(corners, np.uint32)
        self._valid = _aligned((self._width,)).view(np.int32)
        self._valid[:] = -1
        geometry = embree.rtcNewGeometry(device, _TRIANGLES)
        for kind, form, table, count in (
            (_VERTEX_BUFFER, _FLOAT3, self._points, len(points)),
            (_INDEX_BUFFER, _UINT3, self._corners, len(corners)),
        ):
            embree.rtcSetSharedGeometryBuffer(geometry, kind, 0, form, table.ctypes.data, 0, 3 * _BYTES, count)
        embree.rtcCommitGeometry(geometry)
        embree.rtcAttachGeometry(self._scene, geometry)
        embree.rtcReleaseGeometry(geometry)
        embree.rtcSetSceneFlags(self._scene, _WATERTIGHT)
        embree.rtcCommitScene(self._scene)
        error = embree.rtcGetDeviceError(device)
        if error:
            raise RuntimeError(f"Embree could not build a tree over {len(corners)} faces: its error {error}")

    def first_hits(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What rays meet first; quick where neighbours in the list start and point about the same way.

        Args:
            origin: Where all rays start, (3,), or each of them, (3, N).
            directions: (3, N) float32.

        Returns:
            Faces (N,) int32, -1 = none, and how many times its direction each ray goes, (N,) float32, inf = for ever.
        """
        count = directions.shape[1]
        packets = self._packets(directions, np.inf, _HIT_ROWS)
        if origin.ndim == 1:
            packets[:, _ORIGIN] = origin[:, None]
        else:
            self._fill(packets[:, _ORIGIN], origin)
        numbers = packets.view(np.int32)
        numbers[:, _FACE] = numbers[:, _GEOMETRY] = -1
        self._trace("Intersect", packets)
        return numbers[:, _FACE].reshape(-1)[:count], packets[:, _RANGE].reshape(-1)[:count]

    def blocked(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray | float) -> np.ndarray:
        """Whether anything is in the way, bool (N,).

        Args:
            origins: Where rays start, (3, N) float32.
            directions: (3, N) float32.
            reach: How many times its direction each ray goes, (N,) float32 or one for all.
        """
        packets = self._packets(directions, reach, _RAY_ROWS)
        self._fill(packets[:, _ORIGIN], origins)
        self._trace("Occluded", packets)
        return packets[:, _RANGE].reshape(-1)[: origins.shape[1]] < 0  # Embree's mark is -inf

    def _packets(self, directions: np.ndarray, reach: np.ndarray | float, rows: int) -> np.ndarray:
        """Rays (3, N) in packets, (P, rows, width) float32; lanes left over in the last one go nowhere."""
        count = directions.shape[1]
        packets = _aligned((-(-count // self._width), rows, self._width))
        self._fill(packets[:, _DIRECTION], np.where(np.abs(directions) < _STRAIGHT, np.float32(0), directions))
        reaches = np.broadcast_to(np.asarray(reach, np.float32), count)
        self._fill(packets[:, _RANGE : _RANGE + 1], reaches[None])
        packets[-1:, _RANGE, count - self._width * (len(packets) - 1) :] = -1
        packets.view(np.int32)[:, _MASK] = -1
        return packets

    def _fill(self, rows: np.ndarray, values: np.ndarray) -> None:
        """Write values (K, N) into rows (P, K, width) of packets."""
        whole = values.shape[1] // self._width
        rows[:whole] = values[:, : whole * self._width].reshape(len(values), whole, self._width).transpose(1, 0, 2)
        rest = values[:, whole * self._width :]
        rows[whole:, :, : rest.shape[1]] = rest

    def _trace(self, query: str, packets: np.ndarray) -> None:
        function = getattr(self._embree, f"rtc{query}{self._width}")
        fixed = (repeat(ctypes.c_void_p(pointer)) for pointer in (self._valid.ctypes.data, self._scene))
        start, size = packets.ctypes.data, packets[:1].nbytes
        places = range(start, start + packets.nbytes, size or 1)
        # A loop without a line of Python in it: there are some 80,000 packets in a frame.
        deque(map(function, *fixed, places, repeat(ctypes.addressof(_COHERENT))), maxlen=0)


def _release(scene: int, device: int) -> None:
    _embree().rtcReleaseScene(scene)
    _embree().rtcReleaseDevice(device)
