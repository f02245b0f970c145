"""A perfect depth sensor."""

from dataclasses import dataclass

import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.rendering import Rig


@dataclass(frozen=True)
class Clean:
    """Reports the true depth at every difficulty: what stage 1 of the curriculum uses, where only the offset grows."""

    rig = Rig()

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 in the sky."""
        return frames["depth_m"]
