"""Where the camera of a glTF file stands; trimesh reads all else of it, but not a camera that hangs on something."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

_BINARY_MARK = b"glTF"  # GLB: a header of 12 bytes, then the length and the kind of the JSON chunk, then that


def gltf_camera(path: Path) -> np.ndarray | None:
    """Pose of the first camera of a .glb or .gltf file in the file's axes, (4, 4); None where there is none.

    The camera looks along its -z, its y is up; the pose may be scaled. Source: glTF 2.0, sections 3.5, 3.10 and 4.4.
    """
    if path.suffix.lower() not in (".glb", ".gltf"):
        return None
    content = path.read_bytes()
    if content.startswith(_BINARY_MARK):
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    document = json.loads(content)
    scenes = document.get("scenes", [])
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else []
    return next(_cameras(document.get("nodes", []), roots, np.eye(4)), None)


def _cameras(nodes: list[dict[str, Any]], numbers: list[int], parent: np.ndarray) -> Iterator[np.ndarray]:
    """Poses of the cameras among some nodes and what hangs on them."""
    for number in numbers:
        pose = parent @ _local(nodes[number])
        if "camera" in nodes[number]:
            yield pose
        yield from _cameras(nodes, nodes[number].get("children", []), pose)


def _local(node: dict[str, Any]) -> np.ndarray:
    """A node's pose in its parent, (4, 4)."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T  # by columns
    pose = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    pose[:3, :3] = turn * node.get("scale", [1, 1, 1])
    pose[:3, 3] = node.get("translation", [0, 0, 0])
    return pose
