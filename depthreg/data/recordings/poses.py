"""Rigid poses (4, 4) out of ROS transforms. `pose_between(a, b)` leads from b's coordinates into a's."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

Poses = Mapping[str, tuple[str, np.ndarray]]  # of each child frame: its parent, and the pose into the parent


def pose_from_transform(transform: Any) -> np.ndarray:
    """A geometry_msgs/Transform as a matrix."""
    q, t = transform.rotation, transform.translation
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    pose[:3, 3] = t.x, t.y, t.z
    return pose


def static_poses(messages: Iterable[tuple[int, Any]]) -> Poses:
    """Where each frame lies in its parent, from the messages of /tf_static."""
    return {
        stamped.child_frame_id.lstrip("/"): (
            stamped.header.frame_id.lstrip("/"),
            pose_from_transform(stamped.transform),
        )
        for _, message in messages
        for stamped in message.transforms
    }


def pose_between(target: str, source: str, poses: Poses) -> np.ndarray | None:
    """The pose from `source` into `target`; None where no chain of transforms links the two."""
    from_source, from_target = (_to_ancestors(name.lstrip("/"), poses) for name in (source, target))
    common = next((name for name in from_source if name in from_target), None)
    return None if common is None else np.linalg.inv(from_target[common]) @ from_source[common]


def _to_ancestors(name: str, poses: Poses) -> dict[str, np.ndarray]:
    """The poses from a frame into itself, its parent, its parent's parent, ..."""
    chain = {name: np.eye(4)}
    while name in poses:
        parent, into_parent = poses[name]
        if parent in chain:  # a loop, in a bag that doesn't follow ROS's rules
            break
        chain[parent] = into_parent @ chain[name]
        name = parent
    return chain
