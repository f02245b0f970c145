"""Sparse points: OpenCV's corners, counts, and the errors of triangulation."""

import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.sensors import FeaturePoints, RandomPoints
from depthreg.sensors.points import disturb_inverse_depth, draw_counts, grey_of, strongest_corners

MakeFrames = Callable[..., FrameBatch]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def boxes(seed: int = 0, height: int = 97, width: int = 133) -> np.ndarray:
    """Turned boxes on grey, a little out of focus, uint8."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 90, np.uint8)
    for _ in range(14):
        box = (rng.uniform([10, 10], [width - 10, height - 10]), rng.uniform(12, 34, 2), rng.uniform(0, 90))
        cv2.fillPoly(image, [cv2.boxPoints(box).astype(np.int32)], int(rng.integers(0, 255)))
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def picture(frames: FrameBatch, images: list[np.ndarray]) -> FrameBatch:
    """The frames with a grey picture, of the same size and without a margin."""
    frames["rgb"] = torch.from_numpy(np.stack(images))[:, None].expand(-1, 3, -1, -1).contiguous()
    return frames


def ramp(batch: int = 1) -> Tensor:
    return torch.linspace(1, 5, 97 * 133).view(1, 1, 97, 133).repeat(batch, 1, 1, 1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_corners_are_those_that_opencv_finds_good_to_track(seed: int) -> None:
    image = boxes(seed)
    theirs = cv2.goodFeaturesToTrack(image, 40, 0.05, 6, blockSize=3)[:, 0]
    grey = torch.from_numpy(image)[None, None] / 255
    places, found = strongest_corners(grey, 40, 5, 0.05)
    ours = torch.stack([places % 133, places // 133], dim=-1)[0, found[0]].numpy()
    assert len(ours) > 0.7 * len(theirs)
    distance_px = np.linalg.norm(ours[:, None] - theirs[None], axis=-1).min(axis=1)
    assert np.mean(distance_px <= 2) > 0.85


def test_no_corner_lies_within_the_radius_of_another() -> None:
    noise = 1e-3 * torch.rand(1, 1, 97, 133, generator=generator())  # no two alike
    places, found = strongest_corners(torch.from_numpy(boxes())[None, None] / 255 + noise, 200, 4, 0.001)
    y, x = (places // 133)[found], (places % 133)[found]
    apart = torch.maximum((y[:, None] - y).abs(), (x[:, None] - x).abs()) + 99 * torch.eye(len(y))
    assert len(y) > 20 and apart.min() > 4


def test_brightness_weighs_colours_as_opencv_does(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=1, margin_px=9)
    rgb = frames["rgb"][0, :, 9:-9, 9:-9].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(255 * grey_of(frames)[0, 0], cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), atol=0.51)


def test_as_many_corners_are_reported_as_were_drawn(make_surface: MakeFrames) -> None:
    frames = picture(make_surface(ramp(30)), [boxes(k) for k in range(30)])
    sensor = FeaturePoints(counts=(8, 30), inverse_sigma_per_m=0.0, outlier_share=0.0)
    measured_m = sensor(frames, 1.0, generator())
    counts = (measured_m > 0).sum(dim=(1, 2, 3))
    assert counts.tolist() == draw_counts(30, (8, 30), generator()).tolist()  # the sensor's first draw
    assert counts.min() < 12 and counts.max() > 22
    kept = measured_m > 0
    torch.testing.assert_close(measured_m[kept], frames["depth_m"][kept])


def test_a_picture_without_corners_has_no_points(make_surface: MakeFrames) -> None:
    frames = picture(make_surface(ramp()), [np.full((97, 133), 128, np.uint8)])
    assert (FeaturePoints()(frames, 1.0, generator()) == 0).all()


def test_dense_pixels_thin_out_beside_the_corners(make_surface: MakeFrames) -> None:
    frames = picture(make_surface(ramp()), [boxes()])
    for difficulty in (0.2, 0.5):
        share = (FeaturePoints(counts=(10, 10))(frames, difficulty, generator()) > 0).float().mean().item()
        assert share == pytest.approx((1 - difficulty) ** 4, abs=0.02)


def test_the_error_of_depth_grows_with_its_square() -> None:
    """Khoshelham: sigma_z = z^2 sigma of the inverse depth."""
    for depth_m, expected_m in ((1.0, 0.005), (2.0, 0.02), (4.0, 0.08)):
        measured_m = disturb_inverse_depth(torch.full((20_000,), depth_m), 0.005, 0.0, 1.0, generator())
        assert measured_m.std().item() == pytest.approx(expected_m, rel=0.04)


def test_gross_errors_are_as_frequent_and_as_large_as_stated() -> None:
    measured_m = disturb_inverse_depth(torch.full((40_000,), 3.0), 0.0, 0.1, 2.0, generator())
    off = measured_m != 3.0
    assert off.float().mean().item() == pytest.approx(0.1, abs=0.006)
    octaves = (measured_m[off] / 3).log2()
    assert octaves.abs().max() <= 2 and octaves.min() < -1.9 and octaves.max() > 1.9


def test_points_that_an_error_puts_behind_the_camera_are_dropped() -> None:
    measured_m = disturb_inverse_depth(torch.full((10_000,), 100.0), 0.01, 0.0, 1.0, generator())
    share = (measured_m == 0).float().mean().item()
    assert share == pytest.approx(0.5 * math.erfc(1 / math.sqrt(2)), abs=0.012)  # one sigma below 0
    assert (disturb_inverse_depth(torch.zeros(9), 0.01, 0.5, 1.0, generator()) == 0).all()


def test_random_points_are_the_truth_in_the_number_drawn(make_surface: MakeFrames) -> None:
    frames = make_surface(ramp(40))
    frames["depth_m"][:, :, :40] = 0  # nothing to see there
    measured_m = RandomPoints(counts=(100, 1000))(frames, 1.0, generator())
    kept = measured_m > 0
    assert torch.equal(measured_m[kept], frames["depth_m"][kept])
    wanted = draw_counts(40, (100, 1000), generator())  # the sensor's first draw
    scatter = (kept.sum(dim=(1, 2, 3)) - wanted) / wanted.sqrt()
    assert scatter.abs().max() < 4 and scatter.std().item() == pytest.approx(1, abs=0.35)
    left, right = kept[..., :66].sum(), kept[..., 67:].sum()
    assert abs(left - right) < 4 * (left + right).sqrt()


def test_counts_are_drawn_evenly_over_octaves() -> None:
    octaves = (draw_counts(4000, (128, 2048), generator()) / 128).log2()
    assert octaves.min() >= 0 and octaves.max() <= 4
    assert octaves.mean().item() == pytest.approx(2, abs=0.08) and octaves.std().item() == pytest.approx(
        4 / 12**0.5, rel=0.05
    )


def test_density_falls_geometrically_with_the_difficulty(make_surface: MakeFrames) -> None:
    frames = make_surface(ramp(8))
    for difficulty in (0.25, 0.5):
        share = (RandomPoints(counts=(200, 200))(frames, difficulty, generator()) > 0).float().mean().item()
        assert share == pytest.approx((200 / (97 * 133)) ** difficulty, rel=0.05)


@pytest.mark.parametrize("sensor", [FeaturePoints, RandomPoints])
@pytest.mark.parametrize("counts", [(0, 5), (9, 5)])
def test_numbers_that_cannot_be_drawn_are_refused(sensor: type, counts: tuple[int, int]) -> None:
    with pytest.raises(InputError, match=r"sensor.counts=\["):
        sensor(counts=counts)
