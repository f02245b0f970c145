"""The scanner's model, against loops and closed forms."""

import numpy as np
import pytest
import torch

from depthreg.data.sample import FrameBatch, LidarColumns
from depthreg.sensors import Lidar
from depthreg.sensors.lidar import keep_lines, rasterize


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def returns_at(range_m: float, count: int) -> FrameBatch:
    """One return a pixel, all at one range; the camera sees nothing, so the image holds returns alone."""
    column = torch.arange(count, dtype=torch.float32)
    constant = torch.ones(count)
    at_m = range_m * constant
    none = 0 * constant
    lidar = LidarColumns(
        column, none, 0.8 * at_m, at_m, constant, constant, none, at_m, constant, column % 64,
        constant, constant, none, none, 0.6 * constant, 0.8 * constant,
    )  # fmt: skip
    return FrameBatch(
        rgb=torch.zeros(1, 3, 1, count, dtype=torch.uint8),
        depth_m=torch.zeros(1, 1, 1, count),
        intrinsics=torch.eye(3)[None],
        lidar=torch.stack(lidar, dim=-1)[None],
        index=torch.zeros(1, dtype=torch.int64),
    )


def test_returns_are_drawn_where_they_fall_and_the_nearest_wins() -> None:
    height, width = 7, 11
    uv_px = torch.rand(2, 300, 2, generator=generator()) * torch.tensor([width + 4.0, height + 4.0]) - 2
    depth_m = 1 + 9 * torch.rand(2, 300, generator=generator(1))
    depth_m[:, ::5] = 0  # lost
    expected = np.full((2, height, width), np.inf)
    for b, n in np.ndindex(2, 300):
        column, row = np.rint(uv_px[b, n].numpy()).astype(int)
        if 0 <= column < width and 0 <= row < height and depth_m[b, n] > 0:
            expected[b, row, column] = min(expected[b, row, column], depth_m[b, n].item())
    expected[np.isinf(expected)] = 0
    np.testing.assert_allclose(rasterize(uv_px, depth_m, (height, width))[:, 0].numpy(), expected)


@pytest.mark.parametrize("lines", [1, 7, 16, 33, 64])
def test_the_lines_kept_are_as_many_as_asked_and_evenly_spread(lines: int) -> None:
    ring = torch.arange(64.0).expand(50, 64)
    for kept in keep_lines(ring, torch.full((50,), float(lines)), generator()):
        assert abs(int(kept.sum()) - lines) <= 1
        gaps = kept.nonzero().flatten().diff()
        assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1


def test_every_line_has_its_turn() -> None:
    kept = keep_lines(torch.arange(64.0).expand(400, 64), torch.full((400,), 16.0), generator())
    share = kept.float().mean(dim=0)
    assert (share - 16 / 64).abs().max() < 0.1


@pytest.mark.parametrize("difficulty", [0.4, 1.0])
def test_range_noise_has_the_stated_spread_along_the_ray(difficulty: float) -> None:
    sensor = Lidar(min_lines=64, drop_share=0.0, absorption_per_m=0.0, range_noise_m=0.05)
    measured_m = sensor(returns_at(20.0, 20_000), difficulty, generator()).flatten()
    range_m = measured_m / 0.8  # z is 0.8 of the range there
    assert range_m.mean().item() == pytest.approx(20.0, abs=0.002)
    assert range_m.std().item() == pytest.approx(0.05 * difficulty, rel=0.03)


@pytest.mark.parametrize(("difficulty", "range_m"), [(1.0, 5.0), (1.0, 80.0), (0.5, 80.0)])
def test_returns_are_lost_at_the_stated_rate(difficulty: float, range_m: float) -> None:
    sensor = Lidar(min_lines=64, drop_share=0.2, absorption_per_m=0.01, range_noise_m=0.0)
    measured_m = sensor(returns_at(range_m, 20_000), difficulty, generator())
    expected = (1 - 0.2 * difficulty) * np.exp(-0.01 * difficulty * range_m)
    assert (measured_m > 0).float().mean().item() == pytest.approx(expected, abs=0.015)


def test_fewer_lines_are_kept_as_it_gets_harder() -> None:
    sensor = Lidar(min_lines=16, drop_share=0.0, absorption_per_m=0.0)
    shares = []
    for seed in range(60):
        measured_m = sensor(returns_at(9.0, 640), 1.0, generator(seed))
        shares.append((measured_m > 0).float().mean().item())
    assert min(shares) > 15 / 64 and max(shares) <= 1
    assert np.mean(shares) == pytest.approx((16 + 64) / 2 / 64, abs=0.06)  # uniform between 16 and 64 lines


def test_padding_is_no_return() -> None:
    frames = returns_at(9.0, 64)
    frames["lidar"] = torch.cat([frames["lidar"], torch.zeros(1, 30, 16)], dim=1)
    frames["lidar"][0, 0, 2:4] = 0  # nothing but padding is left at pixel (0, 0)
    sensor = Lidar(min_lines=64, drop_share=0.0, absorption_per_m=0.0)
    assert sensor(frames, 1.0, generator())[0, 0, 0, 0] == 0
