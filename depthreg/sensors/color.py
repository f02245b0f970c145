"""What a real camera does to a picture: lens, exposure, white balance, noise, tone and JPEG.

Light adds up in linear light, so everything but JPEG happens there; the tone curve is the renderer's.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from kornia.enhance import jpeg_codec_differentiable
from kornia.filters import filter2d
from torch import Tensor

from depthreg.data.sample import Measurement
from depthreg.errors import InputError
from depthreg.sensors.misalignment import REFERENCE_WIDTH_PX
from depthreg.sensors.reflection import ray_stretch, view_rays

GAMMA = 2.2  # of the renderer's pictures

_WAVELENGTHS_UM = (0.61, 0.545, 0.465)  # where the red, green and blue pixels of a camera see best
_SECOND_RADIATION_CONSTANT = 14388.0  # um K


def temperature_gains(shift_mired: Tensor) -> Tensor:
    """Gains of red, green and blue (B, 3) that a wrong white balance leaves; green stays.

    Planck's law in Wien's approximation: between two colour temperatures, the logarithms of the gains are linear in
    the difference of their inverses.

    Args:
        shift_mired: Difference of the inverse colour temperatures, 1e6 / K, (B,); positive = too warm.
    """
    inverse_um = 1 / torch.tensor(_WAVELENGTHS_UM, device=shift_mired.device)
    exponent = _SECOND_RADIATION_CONSTANT * 1e-6 * (inverse_um[1] - inverse_um)
    return torch.exp(exponent * shift_mired[:, None])


def vignetting(directions: Tensor, strength: Tensor) -> Tensor:
    """Share of the light that reaches each pixel, (B, 1, H, W): cos^4 of the angle off the axis, to the power strength.

    Args:
        directions: Of the pixels, (B, 3, H, W), z = 1.
        strength: (B,); 1 = a simple lens, 0 = none.
    """
    return ray_stretch(directions) ** (-4 * strength[:, None, None, None])


def blur_kernels(defocus_px: Tensor, motion_px: Tensor, angle_rad: Tensor, radius_px: int) -> Tensor:
    """Blur by a lens out of focus while the camera turns: a Gaussian drawn along a line, (B, K, K) of sum 1.

    Args:
        defocus_px: The Gaussian's sigma, (B,).
        motion_px: The line's length, (B,).
        angle_rad: Its direction, (B,), from x to y.
        radius_px: K = 2 radius_px + 1.
    """
    offset = torch.arange(-radius_px, radius_px + 1, device=defocus_px.device, dtype=defocus_px.dtype)
    x, y = offset[None, None, :], offset[None, :, None]
    cos, sin = angle_rad.cos()[:, None, None], angle_rad.sin()[:, None, None]
    sigma_px = defocus_px.clamp(min=0.3)[:, None, None]  # what a pixel's own area blurs
    half_px = motion_px.clamp(min=0.1)[:, None, None] / 2
    along, across = (x * cos + y * sin) / sigma_px, (y * cos - x * sin) / sigma_px
    reach = half_px / sigma_px
    line = torch.erf((along + reach) / 2**0.5) - torch.erf((along - reach) / 2**0.5)
    kernel = line * torch.exp(-0.5 * across**2)
    return kernel / kernel.sum(dim=(1, 2), keepdim=True)


def sensor_noise(
    linear: Tensor, electrons_at_white: Tensor, read_noise_e: float, generator: torch.Generator | None = None
) -> Tensor:
    """Shot and read noise, for each pixel and colour by itself.

    Args:
        linear: (B, 3, H, W) in linear light, 1 = white.
        electrons_at_white: How many electrons a white pixel has caught, (B,): few in the dark or at a high gain.
        read_noise_e: Standard deviation of the read noise, electrons.
        generator: Source of randomness, on the CPU.
    """
    electrons = electrons_at_white[:, None, None, None]
    # Beyond a handful, Poisson's distribution is a normal one of the same mean and variance.
    sigma = (linear.clamp(min=0) / electrons + (read_noise_e / electrons) ** 2).sqrt()
    return linear + sigma * torch.randn(linear.shape, generator=generator).to(linear.device)


def change_some(images: Tensor, drawn: Tensor, change: Callable[[Tensor], Tensor]) -> Tensor:
    """Images (B, ...) of which some are changed.

    Args:
        images: Left as they are.
        drawn: (B,) on the CPU, so that no device is waited for; not 0 for those to change.
        change: Makes the changed images from their numbers (K,) in the batch, which are on the CPU too.
    """
    chosen = drawn.nonzero().flatten()
    return images.index_copy(0, chosen.to(images.device), change(chosen)) if len(chosen) else images


class ColorDraws(NamedTuple):
    """How strongly each sample has each artifact, (B,) in [-1, 1]; 0 = not at all."""

    exposure: Tensor
    temperature: Tensor
    vignetting: Tensor
    defocus: Tensor
    motion: Tensor
    noise: Tensor
    tone: Tensor
    jpeg: Tensor


@dataclass(frozen=True)
class ColorCamera:
    """A camera whose pictures have flaws: more often, and worse, as difficulty grows; at 0 they are perfect.

    Each artifact comes by itself with probability `difficulty * share`, of a strength between 0 and `difficulty` times
    the limit below. A limit of 0 (of 100 for JPEG) leaves it out.

    Args:
        share: Share of samples at difficulty 1, in [0, 1].
        max_exposure_ev: Stops too bright or too dark.
        max_temperature_mired: White balance too warm or too cold; daylight to shade is about 50.
        max_vignetting: 1 = a simple lens, whose light falls off as cos^4.
        max_defocus_px: Sigma of the blur, for an image 1242 pixels wide; it scales with the width.
        max_motion_px: Length of the motion blur, likewise.
        full_well_e: Electrons of a white pixel at base gain.
        max_gain_stops: How often the gain is doubled, and the electrons of a white pixel are halved.
        read_noise_e: Electrons.
        max_tone_stops: How often the tone curve's exponent is doubled (deep shadows) or halved (pale ones).
        min_jpeg_quality: Of the codec, 1 to 100.

    Raises:
        InputError: A value can't be meant.
    """

    share: float = 0.5
    max_exposure_ev: float = 1.5
    max_temperature_mired: float = 60.0
    max_vignetting: float = 0.7
    max_defocus_px: float = 1.5
    max_motion_px: float = 8.0
    full_well_e: float = 10_000.0
    max_gain_stops: float = 5.0
    read_noise_e: float = 4.0
    max_tone_stops: float = 0.6
    min_jpeg_quality: float = 30.0

    def __post_init__(self) -> None:
        limits = [getattr(self, field.name) for field in fields(self) if field.name.startswith("max_")]
        if not all(limit >= 0 for limit in (*limits, self.read_noise_e)) or not 0 <= self.share <= 1:
            raise InputError(f"color: expected a share from 0 to 1 and limits of at least 0, got {self}")
        if not 1 <= self.min_jpeg_quality <= 100 or not self.full_well_e > 0:
            raise InputError(f"color: expected min_jpeg_quality from 1 to 100 and full_well_e above 0, got {self}")

    def __call__(self, measurement: Measurement, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """The picture that the camera takes, (B, 3, H, W) in [0, 1].

        Args:
            measurement: With a perfect picture `rgb`, and all the truth.
            difficulty: In [0, 1].
            generator: Source of randomness, on the CPU.
        """
        rgb = measurement["rgb"]
        if difficulty == 0:
            return rgb
        drawn = torch.rand(len(ColorDraws._fields), len(rgb), generator=generator) < difficulty * self.share
        strength = difficulty * (2 * torch.rand(drawn.shape, generator=generator) - 1)
        draws = ColorDraws(*(strength * drawn))
        clear = rgb**GAMMA
        linear = self._through_lens(clear, measurement["intrinsics"], draws, generator)
        linear = self._on_sensor(linear, draws, generator)
        # A tone curve there and back is not quite the identity, which it has to be for pictures without a flaw.
        rgb = torch.where(linear == clear, rgb, linear.clamp(0, 1) ** (1 / GAMMA))
        tone = self.max_tone_stops * draws.tone
        rgb = change_some(rgb, tone, lambda i: rgb[i] ** 2 ** tone[i].to(rgb.device)[:, None, None, None])
        lost = (100 - self.min_jpeg_quality) * draws.jpeg.abs()
        return change_some(rgb, lost, lambda i: jpeg_codec_differentiable(rgb[i], 100 - lost[i]))

    def _through_lens(
        self, linear: Tensor, intrinsics: Tensor, draws: ColorDraws, generator: torch.Generator | None
    ) -> Tensor:
        """Vignetting, and blur by defocus and motion."""
        size, device = (linear.shape[-2], linear.shape[-1]), linear.device
        fall_off = self.max_vignetting * draws.vignetting.abs()
        bright = change_some(
            linear,
            fall_off,
            lambda i: linear[i] * vignetting(view_rays(intrinsics[i], size), fall_off[i].to(device)),
        )
        scale = size[1] / REFERENCE_WIDTH_PX
        defocus_px = scale * self.max_defocus_px * draws.defocus.abs()
        motion_px = scale * self.max_motion_px * draws.motion.abs()
        radius_px = math.ceil(scale * (2.5 * self.max_defocus_px + self.max_motion_px / 2))
        kernels = blur_kernels(
            defocus_px, motion_px, torch.pi * torch.rand(len(linear), generator=generator), radius_px
        )
        return change_some(
            bright, defocus_px + motion_px, lambda i: filter2d(bright[i], kernels[i].to(device), "replicate")
        )

    def _on_sensor(self, linear: Tensor, draws: ColorDraws, generator: torch.Generator | None) -> Tensor:
        """Exposure, white balance and noise."""
        gains = temperature_gains(self.max_temperature_mired * draws.temperature)
        gains = gains * 2 ** (self.max_exposure_ev * draws.exposure)[:, None]
        exposed = linear * gains.to(linear.device)[..., None, None]
        gain_stops = self.max_gain_stops * draws.noise.abs()
        electrons = (self.full_well_e / 2**gain_stops).to(linear.device)
        return change_some(
            exposed, gain_stops, lambda i: sensor_noise(exposed[i], electrons[i], self.read_noise_e, generator)
        )
