"""Turns a batch of perfect frames into what real instruments would report."""

from collections.abc import Sequence
from typing import Protocol, cast

import numpy as np
import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch, Measurement
from depthreg.geometry import compose_affines, flip_affine, flip_intrinsics, identity_affine
from depthreg.rendering import RandomOffset, Rig
from depthreg.sensors.color import ColorCamera
from depthreg.sensors.misalignment import REFERENCE_WIDTH_PX, misalign_rgb, random_affines
from depthreg.sensors.weather import Weather


class DepthSensor(Protocol):
    """Any depth sensor: difficulty 0 reports the truth, 1 is the instrument at its worst."""

    @property
    def rig(self) -> Rig:
        """What has to be rendered for it."""

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where there is no return."""


class SensorSimulator:
    """Misaligns the colour and disturbs the depth, both by one difficulty in [0, 1]; 0 is the identity.

    Args:
        depth_sensor: What becomes of the depth.
        max_corner_shift_px: Largest shift of an image corner at difficulty 1, for an image 1242 pixels wide; it scales
            with the width. 0 puts no affine on the colour.
        offset: A colour camera that stands beside the depth camera, so that its view shows parallax and occlusions;
            the affine then moves that view.
        offset_share: Share of samples that take this view at difficulty 1, in [0, 1]; the others are off by an affine.
        color: What becomes of the colour; None leaves it perfect. The truth stays clean: blur, noise and blocks belong
            to the camera's own pixels and to nothing on the depth's grid.
        weather: What the colour is seen through, and a scanner's returns with it; None for clear days.
    """

    def __init__(
        self,
        depth_sensor: DepthSensor,
        max_corner_shift_px: float = 24.0,
        offset: RandomOffset | None = None,
        offset_share: float = 0.5,
        color: ColorCamera | None = None,
        weather: Weather | None = None,
    ) -> None:
        if max_corner_shift_px < 0 or not 0 <= offset_share <= 1:
            raise ValueError(
                "expected max_corner_shift_px of at least 0 and offset_share from 0 to 1, "
                f"got {max_corner_shift_px} and {offset_share}"
            )
        self.depth_sensor = depth_sensor
        self.max_corner_shift_px = max_corner_shift_px
        self.offset, self.offset_share = offset, offset_share
        self.color, self.weather = color, weather

    @property
    def rig(self) -> Rig:
        """What has to be rendered for it."""
        return self.depth_sensor.rig | Rig(offset=self.offset)

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Measurement:
        """Simulate one measurement per frame; the generator lives on the CPU, whatever the frames' device."""
        if not 0 <= difficulty <= 1:
            raise ValueError(f"difficulty must be in [0, 1], got {difficulty}")
        truth_m = frames["depth_m"]
        batch, _, height, width = truth_m.shape
        margin_px = (frames["rgb"].shape[-1] - width) // 2
        inner = np.s_[..., margin_px : margin_px + height, margin_px : margin_px + width]
        shift_px = difficulty * self.max_corner_shift_px * width / REFERENCE_WIDTH_PX
        affine = random_affines(batch, (height, width), shift_px, generator).to(truth_m.device)
        view, view_from_depth, parallax_px = self._view(frames, difficulty, generator)
        view = view.float() / 255
        measurement = Measurement(
            rgb=misalign_rgb(view, affine, margin_px) if shift_px else view[inner],
            depth_m=self.depth_sensor(frames, difficulty, generator),
            intrinsics=frames["intrinsics"],
            truth_depth_m=truth_m,
            truth_rgb=frames["rgb"][inner].float() / 255,
            truth_affine_rgb_from_depth=compose_affines(affine, view_from_depth),
            truth_parallax_px=parallax_px,
        )
        if self.weather:
            measurement = self.weather(measurement, difficulty, generator, scanned=bool(self.rig.scans))
        if self.color:
            measurement["rgb"] = self.color(measurement, difficulty, generator)
        return measurement

    def _view(
        self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The colour with its margin, from either camera; the affine from the depth into it, and its parallax."""
        rgb = frames["rgb"]
        affine = identity_affine(len(rgb), device=rgb.device)
        parallax_px = torch.zeros(len(rgb), device=rgb.device)
        share = difficulty * self.offset_share
        if "offset_rgb" not in frames or not share:
            return rgb, affine, parallax_px
        offset = (torch.rand(len(rgb), generator=generator) < share).to(rgb.device)
        return (
            torch.where(offset[:, None, None, None], frames["offset_rgb"], rgb),
            torch.where(offset[:, None, None], frames["offset_affine_rgb_from_depth"], affine),
            torch.where(offset, frames["offset_parallax_px"], parallax_px),
        )


def simulate_each(
    simulator: SensorSimulator, frames: FrameBatch, difficulty: float, generators: Sequence[torch.Generator]
) -> Measurement:
    """Simulate every frame with a generator of its own: what it measures is independent of the batch it is in."""
    singles = []
    for i, generator in enumerate(generators):
        frame = {key: cast(Tensor, value)[i : i + 1] for key, value in frames.items()}
        frame["lidar"] = frame["lidar"][:, frame["lidar"][0, :, 3] > 0]  # padding would shift the draws
        singles.append(cast(dict[str, Tensor], simulator(cast(FrameBatch, frame), difficulty, generator)))
    return cast(Measurement, {key: torch.cat([single[key] for single in singles]) for key in singles[0]})


def frame_generators(frames: FrameBatch, *numbers: int) -> list[torch.Generator]:
    """A generator for each frame, seeded by the numbers and by the frame's index."""
    return [seeded_generator(*numbers, index) for index in frames["index"].tolist()]


def seeded_generator(*numbers: int) -> torch.Generator:
    """A CPU generator whose stream is a function of all the numbers."""
    state = np.random.SeedSequence(numbers).generate_state(2, np.uint64)
    return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))


def augment(
    measurement: Measurement,
    generators: Sequence[torch.Generator],
    brightness: float = 0.2,
    impostor_share: float = 0.0,
) -> Measurement:
    """Mirror each sample left to right with probability one half, and scale its brightness by up to +-`brightness`.

    An impostor is colour that belongs to another place: its own image, mirrored and rolled half way round. A network
    has to notice, and to complete the depth by itself.

    Args:
        measurement: A batch.
        generators: One for each sample.
        brightness: Largest relative change.
        impostor_share: Chance of an impostor.
    """
    given = cast(dict[str, Tensor], measurement)
    out = dict(given)
    width = measurement["rgb"].shape[-1]
    luck = torch.stack([torch.rand(2, generator=generator) for generator in generators]).to(measurement["rgb"].device)
    mirrored = (luck[:, 0] < 0.5)[:, None, None]
    gain = 1 + brightness * (2 * luck[:, 1, None, None, None] - 1)
    for key in ("rgb", "depth_m", "truth_depth_m", "truth_rgb"):
        out[key] = torch.where(mirrored[..., None], given[key].flip(-1), given[key])
    for key in ("rgb", "truth_rgb"):
        out[key] = (out[key] * gain).clamp(max=1)
    affine, intrinsics = measurement["truth_affine_rgb_from_depth"], measurement["intrinsics"]
    out["truth_affine_rgb_from_depth"] = torch.where(mirrored, flip_affine(affine, width), affine)
    out["intrinsics"] = torch.where(mirrored, flip_intrinsics(intrinsics, width), intrinsics)
    if impostor_share:
        lots = torch.stack([torch.rand(2, generator=generator) for generator in generators])
        impostor, turn = lots[:, 0] < impostor_share, ((0.25 + 0.5 * lots[:, 1]) * width).long().tolist()
        others = torch.stack([rgb.flip(-1).roll(by, -1) for rgb, by in zip(out["rgb"], turn, strict=True)])
        out["paired"] = ~impostor.to(others.device)
        out["rgb"] = torch.where(out["paired"][:, None, None, None], out["rgb"], others)
    return cast(Measurement, out)
