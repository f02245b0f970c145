"""Where the rays of a camera go."""

from dataclasses import dataclass

import numpy as np

from depthreg.errors import InputError


@dataclass(frozen=True)
class Camera:
    """Pinhole camera whose colour image may reach beyond the frame on all sides.

    Attributes:
        width: Columns of the frame, without margin.
        height: Rows of the frame, without margin.
        focal_px: Focal length, pixels.
        center_px: Principal point (column, row) in the frame; its middle where not given.
        margin_px: How far the colour image reaches beyond the frame on each side.
        baseline_m: Distance to the right camera of the rectified pair; the scene's where not given.

    Raises:
        InputError: A size or the focal length isn't positive, or the margin is negative.
    """

    width: int
    height: int
    focal_px: float
    center_px: tuple[float, float] | None = None
    margin_px: int = 0
    baseline_m: float | None = None

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.focal_px) <= 0 or self.margin_px < 0:
            raise InputError(f"A camera needs a positive width, height and focal_px and no negative margin_px: {self}.")

    @property
    def intrinsics(self) -> np.ndarray:
        """K of the frame without margin, (3, 3) float32."""
        u, v = self.center_px or ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.array([[self.focal_px, 0, u], [0, self.focal_px, v], [0, 0, 1]], dtype=np.float32)

    def rays(self, border_px: int = 0) -> np.ndarray:
        """Directions through the pixel centres of the frame and a border round it.

        Returns:
            (H + 2 border, W + 2 border, 3) float32 in camera coordinates; z = 1, so lengths along them are z-depths.
        """
        u, v = self.center_px or ((self.width - 1) / 2, (self.height - 1) / 2)
        x = (np.arange(-border_px, self.width + border_px) - u) / self.focal_px
        y = (np.arange(-border_px, self.height + border_px) - v) / self.focal_px
        rays = np.ones((len(y), len(x), 3), dtype=np.float32)
        rays[..., 0] = x
        rays[..., 1] = y[:, None]
        return rays
