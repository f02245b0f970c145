"""Sensors put together: one of several for each sample, or one after the other."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Protocol, cast

import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.rendering import Rig


class Sensor(Protocol):
    """A depth sensor, as the simulator calls it; `max_range_m` is infinite where it has none."""

    @property
    def rig(self) -> Rig:
        """What has to be rendered for it."""

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where there is no return."""


def take(frames: FrameBatch, index: Tensor) -> FrameBatch:
    """Some samples of a batch, by their numbers in it, (n,) int64."""
    given = cast(dict[str, Tensor], frames)
    return cast(FrameBatch, {key: value[index.to(value.device)] for key, value in given.items()})


def max_range_m(sensor: Sensor) -> float:
    """Median depth of a scene beyond which a sensor isn't meant to be used, metres; infinite where it doesn't say."""
    return getattr(sensor, "max_range_m", math.inf)


def median_depth_m(depth_m: Tensor) -> Tensor:
    """Median over the known pixels among every fourth row and column, (B,); 0 where there is none."""
    some = depth_m[..., ::4, ::4].flatten(1)
    return torch.where(some > 0, some, torch.nan).nanmedian(dim=1).values.nan_to_num(0)


@dataclass(frozen=True)
class Mix:
    """One of several sensors for each sample, drawn among those that reach the scene.

    A sensor reaches a scene if the median of its true depth is within the sensor's `max_range_m`; a scene that none
    reaches gets one of those with the longest range. Each sensor works on the samples that drew it and no others.

    Args:
        sensors: By name.
        shares: How often each is drawn, by the same names; any positive numbers.
    """

    sensors: Mapping[str, Sensor]
    shares: Mapping[str, float]

    def __post_init__(self) -> None:
        if not self.sensors or self.sensors.keys() != self.shares.keys() or min(self.shares.values()) <= 0:
            raise InputError(
                f"sensor.shares must name a positive share of each of {sorted(self.sensors)}, got {dict(self.shares)}"
            )

    @property
    def rig(self) -> Rig:
        """What any of them needs."""
        return reduce(or_, (sensor.rig for sensor in self.sensors.values()))

    @property
    def max_range_m(self) -> float:
        """The longest among them."""
        return max(max_range_m(sensor) for sensor in self.sensors.values())

    def draw(self, median_m: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Which sensor each sample gets, (B,) int64, a number in the order of `sensors`; on the CPU, as `median_m`."""
        reach_m = torch.tensor([max_range_m(sensor) for sensor in self.sensors.values()])
        share = torch.tensor([float(self.shares[name]) for name in self.sensors])
        reached = torch.minimum(median_m, reach_m.max())[:, None] <= reach_m
        edges = (reached * share).cumsum(dim=1)
        luck = torch.rand(len(median_m), 1, generator=generator) * edges[:, -1:]
        return torch.searchsorted(edges, luck, right=True)[:, 0].clamp(max=len(share) - 1)

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where there is no return."""
        truth_m = frames["depth_m"]
        if difficulty == 0:
            return truth_m
        drawn = self.draw(median_depth_m(truth_m).cpu(), generator)
        measured_m = torch.zeros_like(truth_m)
        for number, sensor in enumerate(self.sensors.values()):
            index = (drawn == number).nonzero()[:, 0]
            if len(index) == len(drawn):  # nested ones mostly; a batch is large to copy
                return sensor(frames, difficulty, generator)
            if len(index):
                measured_m[index.to(truth_m.device)] = sensor(take(frames, index), difficulty, generator)
        return measured_m


@dataclass(frozen=True)
class Chain:
    """Sensors one after the other, each on the last one's depth: holes in what a time-of-flight camera reports.

    Args:
        sensors: By name, the instrument first; those that follow see its depth in place of the truth.
    """

    sensors: Mapping[str, Sensor]

    def __post_init__(self) -> None:
        if not self.sensors:
            raise InputError("sensor.sensors={}: a chain needs at least one sensor")

    @property
    def rig(self) -> Rig:
        """What any of them needs."""
        return reduce(or_, (sensor.rig for sensor in self.sensors.values()))

    @property
    def max_range_m(self) -> float:
        """The first one's."""
        return max_range_m(next(iter(self.sensors.values())))

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        """z-depth in metres, (B, 1, H, W); 0 where there is no return."""
        for sensor in self.sensors.values():
            frames = cast(FrameBatch, {**frames, "depth_m": sensor(frames, difficulty, generator)})
        return frames["depth_m"]
