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
from threading import get_ident
from typing import Any

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
_ROWS = 24  # builds of Embree differ in how many numbers of instances follow; none needs more
_PACKETS = 1024  # traced at once: what fits a core's cache


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
    for query in ("Intersect", "Occluded"):
        for width in (8, 16):
            getattr(embree, f"rtc{query}{width}").restype = None
    return embree


def _reference(address: int) -> Any:
    """A pointer that ctypes passes on as it is: converting plain numbers takes half of a call's time."""
    return ctypes.byref(ctypes.c_char.from_address(address))


class _Packets:
    """Room for packets of rays, and how Embree is told of each.

    Args:
        width: Rays in a packet.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        rows = 1 + _PACKETS * _ROWS  # the first one says which lanes count: all
        memory = np.zeros(16 + rows * width, np.float32)
        start = -(memory.ctypes.data // _BYTES) % 16  # where Embree's widest instructions can load from
        room = memory[start:][: rows * width].reshape(rows, width)
        room.view(np.int32)[0] = -1
        self.numbers = room[1:].reshape(_PACKETS, _ROWS, width)
        self.whole_numbers = self.numbers.view(np.int32)
        self.whole_numbers[:, _MASK] = -1
        self.lanes = _reference(room.ctypes.data)
        self.references = [_reference(self.numbers.ctypes.data + k * self.numbers.strides[0]) for k in range(_PACKETS)]

    def fill(self, rows: slice, values: np.ndarray) -> None:
        """Write values (K, N) of N rays into K rows."""
        whole, left_over = divmod(values.shape[1], self.width)
        packed = values[:, : whole * self.width].reshape(len(values), whole, self.width)
        self.numbers[:whole, rows] = packed.transpose(1, 0, 2)
        if left_over:
            self.numbers[whole, rows, :left_over] = values[:, whole * self.width :]

    def read(self, numbers: np.ndarray, row: int, count: int) -> np.ndarray:
        """A copy of a row's values for the first rays, (N,)."""
        return numbers[: -(-count // self.width), row].flatten()[:count]


@cache
def _packets(width: int, thread: int) -> _Packets:
    """A thread's own room, used again and again."""
    return _Packets(width)


class RayTree:
    """A tree over triangles that finds what rays meet.

    Args:
        points: Corners of the triangles, (V, 3).
        corners: Which three points make each face, (F, 3).
    """

    def __init__(self, points: np.ndarray, corners: np.ndarray) -> None:
        embree = _embree()
        device = embree.rtcNewDevice(b"threads=1")  # frames are made in parallel, not parts of them
        self._scene = embree.rtcNewScene(device)
        weakref.finalize(self, _release, self._scene, device)
        # Embree reads these where they are, and four numbers for the three of a point.
        self._points = np.zeros((len(points) + 1, 3), np.float32)
        self._points[:-1] = points
        self._corners = np.ascontiguousarray(corners, np.uint32)
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
        self._width = 16 if embree.rtcGetDeviceProperty(device, _PACKETS_OF_16_ARE_NATIVE) else 8
        self._reference = _reference(self._scene)

    def first_hits(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What rays meet first; quick where neighbours in the list start and point about the same way.

        Args:
            origin: Where all rays start, (3,), or each of them, (3, N).
            directions: (3, N) float32.

        Returns:
            Faces (N,) int32, -1 = none, and how many times its direction each ray goes, (N,) float32, inf = for ever.
        """
        packets, count = _packets(self._width, get_ident()), directions.shape[1]
        faces, reaches = np.empty(count, np.int32), np.empty(count, np.float32)
        starts = np.broadcast_to(origin.reshape(3, -1), directions.shape)
        for part in self._parts(count):
            packets.fill(_ORIGIN, starts[:, part])
            packets.numbers[:, _RANGE] = np.inf
            packets.whole_numbers[:, _FACE] = packets.whole_numbers[:, _GEOMETRY] = -1
            self._trace("Intersect", packets, directions[:, part])
            size = directions[:, part].shape[1]
            faces[part] = packets.read(packets.whole_numbers, _FACE, size)
            reaches[part] = packets.read(packets.numbers, _RANGE, size)
        return faces, reaches

    def blocked(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Whether anything is in the way, bool (N,).

        Args:
            origins: Where rays start, (3, N) float32.
            directions: (3, N) float32.
            reach: How many times its direction each ray goes, (N,) float32.
        """
        packets = _packets(self._width, get_ident())
        blocked = np.empty(len(reach), bool)
        for part in self._parts(len(reach)):
            packets.fill(_ORIGIN, origins[:, part])
            packets.fill(slice(_RANGE, _RANGE + 1), reach[None, part])
            self._trace("Occluded", packets, directions[:, part])
            left = packets.read(packets.numbers, _RANGE, len(reach[part]))
            blocked[part] = left < 0  # Embree's mark is -inf
        return blocked

    def _parts(self, count: int) -> list[slice]:
        at_once = _PACKETS * self._width
        return [slice(start, start + at_once) for start in range(0, count, at_once)]

    def _trace(self, query: str, packets: _Packets, directions: np.ndarray) -> None:
        """Send rays (3, N) from where the packets say, as far as they say."""
        count = directions.shape[1]
        packets.fill(_DIRECTION, np.where(np.abs(directions) < _STRAIGHT, np.float32(0), directions))
        used = -(-count // packets.width)
        packets.numbers[used - 1, _RANGE, count - (used - 1) * packets.width :] = -1  # lanes that are left over
        trace = getattr(_embree(), f"rtc{query}{packets.width}")
        # A loop without a line of Python in it: there are some 80,000 packets in a frame.
        fixed = repeat(packets.lanes), repeat(self._reference)
        deque(map(trace, *fixed, packets.references[:used], repeat(ctypes.byref(_COHERENT))), maxlen=0)


def _release(scene: int, device: int) -> None:
    _embree().rtcReleaseScene(scene)
    _embree().rtcReleaseDevice(device)
