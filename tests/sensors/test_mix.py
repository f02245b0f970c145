"""Mixes and chains of sensors, tried with sensors that report what they were given."""

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from depthreg.config import CONF_DIR, build, compose_config
from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.rendering import SCANNERS, Rig
from depthreg.sensors import Chain, Clean, Holes, Lidar, Mix, StructuredLight, Tof
from depthreg.sensors.mix import median_depth_m, take

MakeFrames = Callable[..., FrameBatch]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def walls(*depths_m: float) -> Tensor:
    return torch.tensor(depths_m)[:, None, None, None].expand(-1, 1, 5, 7).clone()


@dataclass(frozen=True)
class Adds:
    """Adds metres, and writes down which samples it saw."""

    metres: float
    max_range_m: float = float("inf")
    seen: list[int] = field(default_factory=list)
    rig = Rig()

    def __call__(self, frames: FrameBatch, difficulty: float, generator: torch.Generator | None = None) -> Tensor:
        self.seen.extend(frames["index"].tolist())
        return frames["depth_m"] + self.metres


def test_sensors_are_drawn_as_often_as_their_shares_say(make_surface: MakeFrames) -> None:
    mix = Mix({"a": Adds(10), "b": Adds(20), "c": Adds(30)}, {"a": 1, "b": 2, "c": 5})
    added_m = (mix(make_surface(walls(*[1.0] * 2000)), 1.0, generator()) - 1)[:, 0, 0, 0]
    for metres, share in ((10, 1 / 8), (20, 2 / 8), (30, 5 / 8)):
        assert (added_m == metres).float().mean().item() == pytest.approx(share, abs=0.03)


def test_each_sensor_sees_its_own_samples_once_and_no_others(make_surface: MakeFrames) -> None:
    first, second = Adds(10), Adds(20)
    frames = make_surface(walls(*range(1, 31)))
    measured_m = Mix({"first": first, "second": second}, {"first": 1, "second": 1})(frames, 0.5, generator())
    assert sorted(first.seen + second.seen) == list(range(30)) and first.seen and second.seen
    for sensor in (first, second):
        assert torch.equal(measured_m[sensor.seen], frames["depth_m"][sensor.seen] + sensor.metres)


def test_a_sensor_is_not_drawn_for_scenes_beyond_its_reach(make_surface: MakeFrames) -> None:
    mix = Mix({"near": Adds(100, 4.5), "far": Adds(200, 80.0)}, {"near": 3, "far": 1})
    added_m = mix(make_surface(walls(*[4.4] * 300, *[4.6] * 300, *[90.0] * 50)), 1.0, generator())[:, 0, 0, 0]
    near = added_m < 200
    assert near[:300].float().mean().item() == pytest.approx(0.75, abs=0.08)
    assert not near[300:].any()  # beyond every sensor's reach, the farthest one stands in
    assert mix.max_range_m == 80


def test_the_median_leaves_the_sky_out() -> None:
    depth_m = walls(3.0, 0.0)
    depth_m[0, 0, :, 4:] = 0
    depth_m[0, 0, 0, 0] = 2.0
    assert median_depth_m(depth_m).tolist() == [2.0, 0.0]  # of every fourth pixel: 2, 3 and the sky's two


def test_sensors_without_a_reach_are_drawn_everywhere(make_surface: MakeFrames) -> None:
    mix = Mix({"clean": Clean(), "near": Adds(1, 4.5)}, {"clean": 1, "near": 1})
    frames = make_surface(walls(*[300.0] * 20))
    assert torch.equal(mix(frames, 1.0, generator()), frames["depth_m"])


def test_some_samples_are_taken_of_every_tensor(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=4)
    some = take(frames, torch.tensor([3, 1]))
    assert some.keys() == frames.keys()
    assert all(torch.equal(some[key], torch.stack([frames[key][3], frames[key][1]])) for key in frames)


def test_a_chain_hands_each_sensor_the_last_ones_depth(make_surface: MakeFrames) -> None:
    frames = make_surface(walls(1.0, 2.0))
    chain = Chain({"first": Adds(10, 7.0), "second": Adds(5)})
    assert torch.equal(chain(frames, 1.0, generator()), frames["depth_m"] + 15)
    assert torch.equal(frames["depth_m"], walls(1.0, 2.0)) and chain.max_range_m == 7


def test_holes_are_knocked_into_what_an_instrument_reports(make_surface: MakeFrames) -> None:
    frames = make_surface(torch.full((4, 1, 37, 53), 2.0), albedo=0.8)
    instrument = StructuredLight(min_agreeing_share=0.0)
    alone_m = instrument(frames, 1.0, generator())
    chained_m = Chain({"kinect": instrument, "holes": Holes(patches=3, missing_share=0.0)})(frames, 1.0, generator())
    assert torch.equal(chained_m[chained_m > 0], alone_m[chained_m > 0])
    assert 0.02 < (chained_m == 0).float().mean() - (alone_m == 0).float().mean() < 0.9


def test_what_any_of_the_sensors_needs_is_rendered() -> None:
    mix = Mix({"tof": Tof(), "lidar": Lidar()}, {"tof": 1, "lidar": 1})
    assert mix.rig == Rig(scans=(SCANNERS["hdl64"],), surfaces=True) == Chain({"mix": mix, "holes": Holes()}).rig


def test_mixes_that_cannot_be_drawn_are_refused() -> None:
    for sensors, shares in (({}, {}), ({"a": Clean()}, {}), ({"a": Clean()}, {"b": 1}), ({"a": Clean()}, {"a": 0})):
        with pytest.raises(InputError, match="positive share of each"):
            Mix(sensors, shares)
    with pytest.raises(InputError, match="at least one sensor"):
        Chain({})


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF_DIR / "sensor").glob("*.yaml")))
def test_every_configured_sensor_can_be_built_and_is_the_identity_at_first(name: str, make_frames: MakeFrames) -> None:
    sensor = build(compose_config("train", [f"sensor@stages.full.sensor={name}"]).stages.full.sensor)
    assert isinstance(sensor.rig, Rig)
    frames = make_frames()
    assert sensor(frames, 0.0, generator()) is frames["depth_m"]


def test_the_union_holds_what_streets_and_rooms_have() -> None:
    union = build(compose_config("train", ["sensor@stages.full.sensor=all"]).stages.full.sensor)
    for name in ("indoor", "street"):
        part = build(compose_config("train", [f"sensor@stages.full.sensor={name}"]).stages.full.sensor)
        assert union.sensors[name] == part
        assert list(part.sensors) == ["instrument", "afterwards"]  # holes come last
    rig = union.rig
    assert rig.surfaces and len(rig.matchers) == 2  # with a projector and without
    assert len(set(rig.scans)) == len(rig.scans) == 6  # HDL-64E is in the mix twice, but scans once
