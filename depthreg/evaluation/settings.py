"""Frames with colour that lines up, and with colour that is off by a known affine."""

import numpy as np
import torch

from depthreg.data.sample import Measurement
from depthreg.errors import InputError
from depthreg.sensors.misalignment import (
    REFERENCE_WIDTH_PX,
    margin_for,
    misalign_rgb,
    random_affines,
    with_corner_shift,
)

MIN_SIDE_PX = 64  # of the smallest image that a network takes


def can_misalign(frame: Measurement, max_corner_shift_px: float) -> bool:
    """Whether `misalign` leaves a crop of the frame that a network takes."""
    height, width = frame["rgb"].shape[-2:]
    return min(height, width) - 2 * margin_for(max_corner_shift_px * width / REFERENCE_WIDTH_PX) >= MIN_SIDE_PX


def misalign(
    frame: Measurement,
    max_corner_shift_px: float,
    generator: torch.Generator,
    corner_shift_px: float | None = None,
) -> Measurement:
    """Put a known misalignment on a frame whose colour and depth line up.

    The result is a crop: its rim serves as the margin, since black borders would give the answer away.

    Args:
        frame: A batch of any size.
        max_corner_shift_px: Largest shift of an image corner for an image 1242 pixels wide; it scales with
            the width.
        generator: Source of randomness, on the CPU.
        corner_shift_px: Shift of the worst corner, for an image 1242 pixels wide, at most the largest; random where
            not given. The crop is the same for all of them.

    Raises:
        InputError: The crop would be smaller than what a network takes.
    """
    batch, _, height, width = frame["rgb"].shape
    shift_px = max_corner_shift_px * width / REFERENCE_WIDTH_PX
    margin_px = margin_for(shift_px)
    if not can_misalign(frame, max_corner_shift_px):
        least = MIN_SIDE_PX + 2 * margin_px
        raise InputError(
            f"{frame.get('name', ['a frame'])[0]} is {width}x{height}: at least {least}x{least} was expected"
        )
    inner = np.s_[..., margin_px : height - margin_px, margin_px : width - margin_px]
    truth_rgb = frame["rgb"][inner]
    size = (truth_rgb.shape[-2], truth_rgb.shape[-1])
    affine = random_affines(batch, size, shift_px, generator)
    if corner_shift_px is not None:
        affine = with_corner_shift(affine, torch.full((batch,), corner_shift_px * width / REFERENCE_WIDTH_PX), size)
    out = Measurement(**frame)
    out["rgb"], out["truth_rgb"] = misalign_rgb(frame["rgb"], affine, margin_px), truth_rgb
    out["truth_affine_rgb_from_depth"] = affine
    out["depth_m"] = frame["depth_m"][inner]
    if "truth_depth_m" in frame:
        out["truth_depth_m"] = frame["truth_depth_m"][inner]
    if "intrinsics" in frame:
        out["intrinsics"] = frame["intrinsics"] - margin_px * torch.tensor([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    return out


def both_settings(
    frame: Measurement, max_corner_shift_px: float, generator: torch.Generator
) -> tuple[Measurement, Measurement]:
    """The frame with aligned colour, and with colour that is off by a known affine.

    A simulated frame brings its own misalignment and truth; a real one is taken as aligned, then misaligned.
    """
    if "truth_affine_rgb_from_depth" not in frame:
        return frame, misalign(frame, max_corner_shift_px, generator)
    aligned = Measurement(**frame)
    aligned["rgb"] = frame["truth_rgb"]
    return aligned, frame
