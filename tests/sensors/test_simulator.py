"""The simulator: identity at difficulty 0, harder from there, the same for every batch."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.geometry import identity_affine, warp_affine
from depthreg.metrics import masked_ssim
from depthreg.rendering import RandomOffset
from depthreg.sensors import (
    Chain,
    Clean,
    ColorCamera,
    FeaturePoints,
    Holes,
    Lidar,
    Mix,
    RandomPoints,
    SensorSimulator,
    Stereo,
    StructuredLight,
    Tof,
    Weather,
)
from depthreg.sensors.simulator import DepthSensor, augment, frame_generators, seeded_generator, simulate_each

MakeFrames = Callable[..., FrameBatch]
MIX = Mix(
    {"lidar": Lidar(), "points": RandomPoints(), "tof": Tof(max_range_m=99.0)}, {"lidar": 1, "points": 1, "tof": 1}
)
SENSORS = [
    *(Clean(), Holes(), Lidar(), Stereo(), Tof(), StructuredLight(), FeaturePoints(), RandomPoints(), MIX),
    Chain({"mix": MIX, "holes": Holes(missing_share=0.0)}),
]
MAX_SHIFT_PX = 80.0  # for 1242 px of width, so about 6 px here


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def with_offset_view(frames: FrameBatch, margin_px: int = 9) -> FrameBatch:
    """Frames of fine texture with a second colour camera, whose view OpenCV draws."""
    noise = np.random.default_rng(0).random((*frames["rgb"].shape[2:], 3 * len(frames["rgb"])), np.float32)
    texture = (127.5 + 800 * (cv2.GaussianBlur(noise, (0, 0), 2.5) - 0.5)).clip(0, 255)
    rgb = torch.from_numpy(texture).round().to(torch.uint8).permute(2, 0, 1).unflatten(0, (-1, 3))
    affine = np.array([[0.86, -0.07, 8.0], [0.09, 1.12, -7.0]])
    wide = affine.copy()  # of the images with their margins
    wide[:, 2] += margin_px - margin_px * affine[:, :2].sum(axis=1)
    size = (frames["rgb"].shape[3], frames["rgb"].shape[2])
    views = [cv2.warpAffine(image.permute(1, 2, 0).numpy(), wide, size, borderMode=cv2.BORDER_REFLECT) for image in rgb]
    batch = len(views)
    return FrameBatch(
        **{**frames, "rgb": rgb},
        offset_rgb=torch.from_numpy(np.stack(views)).permute(0, 3, 1, 2),
        offset_affine_rgb_from_depth=torch.from_numpy(affine).float().repeat(batch, 1, 1),
        offset_parallax_px=0.5 + torch.arange(batch),
    )


def density(depth_m: Tensor) -> float:
    return (depth_m > 0).float().mean().item()


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: type(sensor).__name__)
def test_difficulty_zero_is_the_identity(sensor: DepthSensor, make_frames: MakeFrames) -> None:
    frames = make_frames(margin_px=9)
    measurement = SensorSimulator(sensor, MAX_SHIFT_PX)(frames, 0.0, generator())
    inner = frames["rgb"][..., 9:-9, 9:-9].float() / 255
    assert torch.equal(measurement["rgb"], inner) and torch.equal(measurement["truth_rgb"], inner)
    assert torch.equal(measurement["depth_m"], frames["depth_m"])
    assert torch.equal(measurement["truth_depth_m"], frames["depth_m"])
    assert torch.equal(measurement["truth_affine_rgb_from_depth"], identity_affine(2))
    assert torch.equal(measurement["intrinsics"], frames["intrinsics"])


@pytest.mark.parametrize("sensor", [Holes(), Lidar()], ids=lambda sensor: type(sensor).__name__)
def test_depth_thins_out_as_it_gets_harder(sensor: DepthSensor, make_frames: MakeFrames) -> None:
    frames = make_frames(batch=6)
    densities = [density(sensor(frames, difficulty, generator())) for difficulty in (0, 0.25, 0.5, 0.75, 1)]
    assert densities == sorted(densities, reverse=True)
    assert densities[0] == 1 and densities[-1] < 0.3


@pytest.mark.parametrize("difficulty", [0.2, 1.0])
def test_the_true_affine_brings_the_colour_onto_the_depths_grid(difficulty: float, make_frames: MakeFrames) -> None:
    frames = make_frames(batch=6)
    measurement = SensorSimulator(Clean(), MAX_SHIFT_PX)(frames, difficulty, generator())
    aligned, seen = warp_affine(measurement["rgb"], measurement["truth_affine_rgb_from_depth"])
    errors = ((aligned - measurement["truth_rgb"]).abs() * seen).amax(dim=(1, 2, 3))
    untouched = ((measurement["rgb"] - measurement["truth_rgb"]).abs() * seen).amax(dim=(1, 2, 3))
    assert errors.max() < 0.02
    assert untouched.max() > 4 * errors.max()


def test_the_shift_scales_with_difficulty_and_width(make_frames: MakeFrames) -> None:
    simulator = SensorSimulator(Clean(), 124.2)
    for difficulty in (0.3, 1.0):
        measurement = simulator(make_frames(batch=200), difficulty, generator())
        x = torch.tensor([[0, 0, 1.0], [92, 0, 1], [0, 60, 1], [92, 60, 1]]).T
        moved = measurement["truth_affine_rgb_from_depth"] @ x - x[:2]  # (B, 2, 4)
        worst_px = moved.norm(dim=1).amax()
        limit_px = 124.2 * difficulty * 93 / 1242
        assert 0.9 * limit_px < worst_px <= limit_px * 1.001


def test_without_a_shift_the_colour_stays_aligned(make_frames: MakeFrames) -> None:
    measurement = SensorSimulator(Holes(), 0.0)(make_frames(), 1.0, generator())
    assert torch.equal(measurement["rgb"], measurement["truth_rgb"])
    assert torch.equal(measurement["truth_affine_rgb_from_depth"], identity_affine(2))


@pytest.mark.parametrize(("difficulty", "max_shift_px"), [(1.0, 0.0), (1.0, MAX_SHIFT_PX), (0.5, MAX_SHIFT_PX)])
def test_the_true_affine_holds_for_either_colour_camera(
    difficulty: float, max_shift_px: float, make_frames: MakeFrames
) -> None:
    frames = with_offset_view(make_frames(batch=40))
    measurement = SensorSimulator(Clean(), max_shift_px, offset_share=0.6)(frames, difficulty, generator())
    aligned, seen = warp_affine(measurement["rgb"], measurement["truth_affine_rgb_from_depth"])
    error = ((aligned - measurement["truth_rgb"]).abs() * seen).amax(dim=(1, 2, 3))
    assert error.max() < 0.035  # two bilinear interpolations of fine texture
    offset = measurement["truth_parallax_px"] > 0
    assert torch.equal(measurement["truth_parallax_px"][offset], frames["offset_parallax_px"][offset])
    assert offset.float().mean().item() == pytest.approx(0.6 * difficulty, abs=0.15)
    truth = frames["rgb"][..., 9:-9, 9:-9].float() / 255
    assert torch.equal(measurement["truth_rgb"], truth)


def test_with_an_offset_camera_difficulty_zero_is_the_identity(make_frames: MakeFrames) -> None:
    frames = with_offset_view(make_frames())
    measurement = SensorSimulator(Clean(), MAX_SHIFT_PX, offset_share=1.0)(frames, 0.0, generator())
    assert torch.equal(measurement["rgb"], measurement["truth_rgb"])
    assert torch.equal(measurement["truth_affine_rgb_from_depth"], identity_affine(2))
    assert (measurement["truth_parallax_px"] == 0).all()


def test_the_cameras_flaws_leave_all_but_its_picture_alone(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=6)
    perfect = SensorSimulator(Lidar(), MAX_SHIFT_PX)(frames, 1.0, generator())
    flawed_simulator = SensorSimulator(Lidar(), MAX_SHIFT_PX, color=ColorCamera(share=1.0))
    flawed = flawed_simulator(frames, 1.0, generator())
    assert all(torch.equal(flawed[key], perfect[key]) for key in perfect.keys() - {"rgb"})
    assert (flawed["rgb"] != perfect["rgb"]).flatten(1).any(dim=1).all()
    still = flawed_simulator(frames, 0.0, generator())
    assert torch.equal(still["rgb"], still["truth_rgb"])


def test_the_structure_of_flawed_pictures_still_says_which_affine_is_true(make_frames: MakeFrames) -> None:
    frames = with_offset_view(make_frames(batch=16))
    simulator = SensorSimulator(
        Clean(), MAX_SHIFT_PX, offset_share=0.0, color=ColorCamera(), weather=Weather(0.25, 0.25, 0.25)
    )
    measurement = simulator(frames, 1.0, generator())
    truth, off = measurement["truth_affine_rgb_from_depth"], torch.tensor([[0.0, 0, 1.5], [0, 0, 0]])
    for i in range(16):
        one = slice(i, i + 1)
        views = [warp_affine(measurement["rgb"][one], affine[one]) for affine in (truth, truth + off, truth - off)]
        score, *others = (masked_ssim(rgb, measurement["truth_rgb"][one], seen) for rgb, seen in views)
        assert score > max(others)


def test_an_offset_camera_joins_what_the_depth_sensor_needs() -> None:
    offset = RandomOffset(0.05, 0.5)
    rig = SensorSimulator(Lidar(), offset=offset).rig
    assert rig.offset == offset and rig.scans == Lidar().rig.scans
    assert SensorSimulator(Lidar()).rig == Lidar().rig


@pytest.mark.parametrize(("max_shift_px", "share"), [(-1.0, 0.5), (24.0, -0.1), (24.0, 1.1)])
def test_a_simulator_that_cannot_be_meant_is_refused(max_shift_px: float, share: float) -> None:
    with pytest.raises(ValueError, match=f"got {max_shift_px} and {share}"):
        SensorSimulator(Clean(), max_shift_px, offset_share=share)


@pytest.mark.parametrize("difficulty", [-0.1, 1.01, float("nan")])
def test_a_difficulty_that_cannot_be_is_refused(difficulty: float, make_frames: MakeFrames) -> None:
    with pytest.raises(ValueError, match="difficulty must be in"):
        SensorSimulator(Clean())(make_frames(), difficulty, generator())


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: type(sensor).__name__)
def test_the_seed_decides_and_frames_are_left_as_they_were(sensor: DepthSensor, make_frames: MakeFrames) -> None:
    frames, untouched = make_frames(), make_frames()
    simulator = SensorSimulator(sensor, MAX_SHIFT_PX)
    first, again, other = (simulator(frames, 0.7, generator(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert not torch.equal(first["rgb"], other["rgb"])
    assert all(torch.equal(frames[key], untouched[key]) for key in frames)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: type(sensor).__name__)
def test_a_validation_draw_belongs_to_its_frame_and_not_to_its_batch(
    sensor: DepthSensor, make_frames: MakeFrames
) -> None:
    frames = with_offset_view(make_frames(batch=3))
    weather = Weather(0.3, 0.3, 0.3)
    simulator = SensorSimulator(sensor, MAX_SHIFT_PX, color=ColorCamera(share=0.7), weather=weather)
    together = simulate_each(simulator, frames, 0.8, frame_generators(frames, 4))
    order = torch.tensor([2, 0])
    some = FrameBatch(**{key: value[order] for key, value in frames.items()})
    reordered = simulate_each(simulator, some, 0.8, frame_generators(some, 4))
    assert all(torch.equal(together[key][order], reordered[key]) for key in together)


def test_validation_does_not_depend_on_how_far_returns_are_padded(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=2)
    padding = torch.zeros(2, 100, 16)  # as where a batch holds a frame with more returns
    padded = FrameBatch(**{**frames, "lidar": torch.cat([frames["lidar"], padding], dim=1)})
    simulator = SensorSimulator(Lidar(), MAX_SHIFT_PX)
    depths_m = [
        simulate_each(simulator, batch, 0.8, frame_generators(batch, 4))["depth_m"] for batch in (frames, padded)
    ]
    assert torch.equal(*depths_m)


def test_validation_frames_differ_from_each_other_and_between_seeds(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=2)
    simulator = SensorSimulator(Clean(), MAX_SHIFT_PX)
    first, second = (
        simulate_each(simulator, frames, 1.0, frame_generators(frames, seed))["truth_affine_rgb_from_depth"]
        for seed in (0, 1)
    )
    assert not torch.equal(first[0], first[1]) and not torch.equal(first, second)


def test_a_seed_is_all_of_its_numbers_in_their_order() -> None:
    draws = [torch.rand(3, generator=seeded_generator(*numbers)).tolist() for numbers in ((1, 2), (2, 1), (1,), (1, 2))]
    assert draws[0] == draws[3]
    assert draws[0] != draws[1] and draws[0] != draws[2]


def test_augmentation_keeps_colour_depth_and_affine_together(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=12)
    measurement = SensorSimulator(Clean(), MAX_SHIFT_PX)(frames, 1.0, generator())
    out = augment(measurement, frame_generators(frames, 3))
    mirrored = (out["depth_m"] != measurement["depth_m"]).flatten(1).any(dim=1)
    assert mirrored.any() and not mirrored.all()
    aligned, seen = warp_affine(out["rgb"], out["truth_affine_rgb_from_depth"])
    assert ((aligned - out["truth_rgb"]).abs() * seen).max() < 0.025
    for key in ("depth_m", "truth_depth_m"):
        assert torch.equal(out[key][mirrored], measurement[key][mirrored].flip(-1))
        assert torch.equal(out[key][~mirrored], measurement[key][~mirrored])
    center = torch.where(mirrored, 93 - 1 - 44.0, 44.0)
    torch.testing.assert_close(out["intrinsics"][:, 0, 2], center)


def test_brightness_changes_both_colours_alike_within_its_limit(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=40)
    measurement = SensorSimulator(Clean(), 0.0)(frames, 1.0, generator())
    measurement["rgb"] = measurement["truth_rgb"] = torch.full((40, 3, 61, 93), 0.5)
    out = augment(measurement, frame_generators(frames, 1), brightness=0.2)
    gain = out["rgb"][:, 0, 0, 0] / 0.5
    assert 0.8 <= gain.min() < 0.85 and 1.15 < gain.max() <= 1.2
    assert torch.equal(out["rgb"], out["truth_rgb"]) and out["rgb"].max() <= 1
    assert (measurement["rgb"] == 0.5).all()


def test_brightness_never_leaves_the_unit_range(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=20)
    measurement = SensorSimulator(Clean(), 0.0)(frames, 1.0, generator())
    measurement["rgb"] = torch.ones_like(measurement["rgb"])
    assert augment(measurement, frame_generators(frames, 0))["rgb"].max() <= 1


def test_an_impostor_is_told_from_a_pair_and_has_the_same_colours_elsewhere(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=40)
    measurement = SensorSimulator(Clean(), 0.0)(frames, 1.0, generator())
    measurement["rgb"] = 0.8 * torch.rand(40, 3, 61, 93, generator=generator(1))
    plain = augment(measurement, frame_generators(frames, 1))
    out = augment(measurement, frame_generators(frames, 1), impostor_share=0.5)
    paired = out["paired"]
    assert 0.2 < paired.float().mean() < 0.8
    assert torch.equal(out["rgb"][paired], plain["rgb"][paired])
    assert torch.equal(out["depth_m"], plain["depth_m"]) and torch.equal(out["truth_rgb"], plain["truth_rgb"])
    assert (out["rgb"][~paired] != plain["rgb"][~paired]).float().mean() > 0.98  # one column of 93 may stay
    ours, theirs = (colour[~paired].sort(dim=-1).values for colour in (out["rgb"], plain["rgb"]))
    assert torch.equal(ours, theirs)  # a row holds what it held, in another order
    assert augment(measurement, frame_generators(frames, 1), impostor_share=1.0)["paired"].sum() == 0
