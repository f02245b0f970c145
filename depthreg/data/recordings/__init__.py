"""Recordings of many formats as sequences of frames: `KINDS` lists them, `open_recording` finds out which one it is."""

from pathlib import Path

from depthreg.data.recordings import kitti_drive, realsense_folder, ros_bag, tum
from depthreg.data.recordings.file_pairs import open_pairs
from depthreg.data.recordings.recording import RecordedFrame, Recording, Rgbd, Settings
from depthreg.errors import InputError

KINDS = (  # the first that recognises a path opens it
    kitti_drive.RAW_DRIVE,
    kitti_drive.ANNOTATED_DRIVE,
    kitti_drive.DEPTH_SELECTION,
    tum.KIND,
    realsense_folder.KIND,
    ros_bag.KIND,
)

__all__ = ["KINDS", "RecordedFrame", "Recording", "Rgbd", "Settings", "open_pairs", "open_recording"]


def open_recording(path: Path, settings: Settings) -> Recording:
    """Find out what a path holds, and list its frames; they are read later, one by one.

    Raises:
        InputError: No known kind, or something that the kind needs is missing.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist: a recording was expected")
    for kind in KINDS:
        if kind.recognises(path):
            if (settings.rgb_topic or settings.depth_topic) and kind is not ros_bag.KIND:
                raise InputError(f"{path} is of the kind {kind.name}: --rgb-topic and --depth-topic are for ROS bags")
            return kind.open(path, settings)
    kinds = "; ".join(f"{kind.name}: {kind.holds}" for kind in KINDS)
    raise InputError(f"{path} is no recording of a known kind ({kinds}); for a pair of files or folders, name both")
