"""The scanner's model, against loops and closed forms."""

from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor

from depthreg.config import CONF_DIR
from depthreg.data.sample import FrameBatch, LidarColumns
from depthreg.errors import InputError
from depthreg.rendering import SCANNERS
from depthreg.sensors import Lidar
from depthreg.sensors.lidar import keep_lines, move_along_rays, rasterize, received_power, reflectivity


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


FOCAL_PX = 1e5
PERFECT = Lidar(
    min_lines=128, fading=0.0, drop_share=0.0, range_bias_m=0.0, range_noise_m=0.0, outlier_share=0.0
)  # but for what it can't detect


def returns_at(range_m: float | Tensor, count: int, **given: float | Tensor) -> FrameBatch:
    """One return a pixel, of a white wall; the camera sees nothing, so the image holds returns alone."""
    one = torch.ones(count)
    values = {name: 0 * one for name in LidarColumns._fields}
    values |= {"u_px": torch.arange(count).float(), "ring": torch.arange(count).float() % 64}
    values |= dict.fromkeys(("depth_m", "range_m", "far_range_m"), range_m * one)
    values |= dict.fromkeys(("cos_incidence", "albedo", "near_share", "ray_z"), one)
    values["ray_x"] = (values["u_px"] - count / 2) / FOCAL_PX  # the LiDAR stands where the camera does
    values |= {name: value * one for name, value in given.items()}
    return FrameBatch(
        rgb=torch.zeros(1, 3, 1, count, dtype=torch.uint8),
        depth_m=torch.zeros(1, 1, 1, count),
        intrinsics=torch.tensor([[[FOCAL_PX, 0, count / 2], [0, FOCAL_PX, 0], [0, 0, 1]]]),
        lidar=torch.stack(LidarColumns(**values), dim=-1)[None],
        baseline_m=torch.zeros(1),
        index=torch.zeros(1, dtype=torch.int64),
    )


def seen_share(sensor: Lidar, frames: FrameBatch, difficulty: float = 1.0) -> float:
    return (sensor(frames, difficulty, generator()) > 0).float().mean().item()


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


@pytest.mark.parametrize(("total", "lines"), [(64, 1), (64, 7), (128, 16), (16, 4), (64, 64)])
def test_the_lines_kept_are_as_many_as_asked_and_evenly_spread(total: int, lines: int) -> None:
    ring = torch.arange(float(total)).expand(50, total)
    for kept in keep_lines(ring, torch.full((50,), total), torch.full((50,), float(lines)), generator()):
        assert abs(int(kept.sum()) - lines) <= 1
        gaps = kept.nonzero().flatten().diff()
        assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1


def test_every_line_has_its_turn() -> None:
    ring = torch.arange(64.0).expand(400, 64)
    kept = keep_lines(ring, torch.full((400,), 64), torch.full((400,), 16.0), generator())
    assert (kept.float().mean(dim=0) - 16 / 64).abs().max() < 0.1


def test_the_number_of_lines_is_even_in_its_logarithm_down_to_the_fewest() -> None:
    sensor = replace(PERFECT, min_lines=4)
    frames = returns_at(9.0, 640)
    lines = [64 * (sensor(frames, 1.0, generator(seed)) > 0).float().mean().item() for seed in range(300)]
    assert 3 <= min(lines) < 5 and 55 < max(lines) <= 64
    assert np.median(lines) == pytest.approx(16, rel=0.2)  # halfway between 4 and 64 in the logarithm
    assert seen_share(replace(PERFECT, min_lines=128), frames) == 1  # there are no more than the scanner has


@pytest.mark.parametrize("difficulty", [0.4, 1.0])
def test_range_noise_has_the_stated_spread_along_the_ray(difficulty: float) -> None:
    measured_m = replace(PERFECT, range_noise_m=0.05)(returns_at(20.0, 20_000), difficulty, generator())
    assert measured_m.mean().item() == pytest.approx(20.0, abs=0.002)
    assert measured_m.std().item() == pytest.approx(0.05 * difficulty, rel=0.03)


def test_each_laser_has_an_offset_of_its_own_that_stays() -> None:
    measured_m = replace(PERFECT, range_bias_m=0.1)(returns_at(20.0, 6400), 1.0, generator()).reshape(100, 64)
    assert measured_m.std(dim=0).max() < 1e-5
    assert len(measured_m[0].unique()) == 64
    assert measured_m[0].std().item() == pytest.approx(0.1, rel=0.25)


@pytest.mark.parametrize(("albedo", "reach_m"), [(0.1, 50.0), (0.8, 120.0)])
def test_a_grazed_target_is_seen_as_far_as_the_data_sheet_says(albedo: float, reach_m: float) -> None:
    range_m = torch.linspace(10, 200, 20_000)
    measured_m = PERFECT(returns_at(range_m, 20_000, albedo=albedo, cos_incidence=0.0), 1.0, generator())
    assert measured_m.max().item() == pytest.approx(reach_m, rel=1e-3)
    faded = replace(PERFECT, fading=0.3)(returns_at(reach_m, 20_000, albedo=albedo, cos_incidence=0.0), 1.0)
    assert (faded > 0).float().mean().item() == pytest.approx(0.5, abs=0.02)


def test_reflectivity_is_lamberts_law_without_roughness_and_oren_nayars_with() -> None:
    cos = torch.tensor([1.0, 0.5, 0.1])
    none = torch.zeros(3)
    torch.testing.assert_close(reflectivity(none + 0.4, cos, none, 0.0), 0.4 * cos)
    # By hand: A = 1 - 0.5 * 0.25 / 0.58 and B = 0.45 * 0.25 / 0.34 for 0.5 rad.
    expected = cos + (0.330882 / 0.784483) * (1 - cos**2)
    torch.testing.assert_close(reflectivity(none + 1, cos, none, 0.5), expected, atol=1e-5, rtol=0)


def test_polish_and_darkness_swallow_returns_and_nearness_brings_them_back() -> None:
    glass = {"albedo": 0.018, "cos_incidence": 0.4, "gloss": 0.9}  # a car's window
    assert seen_share(Lidar(min_lines=64), returns_at(40.0, 5000, **glass)) < 0.01
    assert seen_share(Lidar(min_lines=64), returns_at(4.0, 5000, **glass)) > 0.95
    body = {"albedo": 0.4, "cos_incidence": 0.7, "gloss": 0.55}
    assert seen_share(Lidar(min_lines=64), returns_at(40.0, 5000, **body)) > 0.95


def test_received_power_falls_with_the_square_of_the_range_and_the_air() -> None:
    near, far = received_power(torch.ones(2), torch.tensor([10.0, 20.0]), 0.003).tolist()
    assert near / far == pytest.approx(4 * np.exp(2 * 0.003 * 10))


def test_a_beam_split_half_and_half_reports_the_middle_or_one_of_its_parts() -> None:
    def measured(far_range_m: float, near_share: float = 0.5, far_albedo: float = 1.0) -> float:
        far = {"far_range_m": far_range_m, "far_cos_incidence": 1.0, "far_albedo": far_albedo}
        frames = returns_at(10.0, 64, near_share=near_share, **far)
        depth_m = PERFECT(frames, 1.0, generator()).unique()
        assert len(depth_m) == 1
        return depth_m.item()

    weights = np.array([1 / 10**2, 1 / 10.5**2]) * np.exp(-2 * PERFECT.extinction_per_m * np.array([10, 10.5]))
    assert measured(10.5) == pytest.approx(np.average([10, 10.5], weights=weights), abs=1e-4)
    assert measured(15.0) == pytest.approx(10.0)  # apart, the stronger: as much light, but nearer
    assert measured(15.0, near_share=0.1) == pytest.approx(15.0)
    assert measured(15.0, near_share=0.1, far_albedo=0.0) == pytest.approx(10.0)  # the rest goes into the sky


def test_beams_widen_from_lines_with_the_difficulty() -> None:
    far = {"far_range_m": 10.6, "far_cos_incidence": 1.0, "far_albedo": 1.0}
    frames = returns_at(10.0, 64, near_share=0.6, **far)
    shifts_m = [PERFECT(frames, d, generator()).max().item() - 10 for d in (0.01, 0.5, 1.0)]
    assert 0 < shifts_m[0] < 0.005
    assert shifts_m == sorted(shifts_m) and shifts_m[2] == pytest.approx(2 * shifts_m[1], rel=0.05)


def test_a_return_at_another_range_lies_where_its_point_projects() -> None:
    rng = np.random.default_rng(0)
    start, ray = np.array([0.0, -0.28, -0.27]), np.array([[0.1, 0.05, 0.99], [-0.3, 0.0, 0.95]])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    range_m, by_m = np.array([8.0, 30.0]), rng.uniform(-2, 5, 2)
    intrinsics = np.array([[721.0, 0, 610], [0, 705, 172], [0, 0, 1]])
    before, after = (cv2.projectPoints(p, np.zeros(3), np.zeros(3), intrinsics, None)[0][:, 0]
                     for p in (start + range_m[:, None] * ray, start + (range_m + by_m)[:, None] * ray))  # fmt: skip
    none = torch.zeros(1, 2)
    values = dict.fromkeys(LidarColumns._fields, none)
    values |= {"u_px": before[:, 0], "v_px": before[:, 1], "depth_m": start[2] + range_m * ray[:, 2]}
    values |= dict(zip(("ray_x", "ray_y", "ray_z"), ray.T, strict=True))
    columns = LidarColumns(
        **{name: torch.as_tensor(v, dtype=torch.float64).reshape(1, 2) for name, v in values.items()}
    )
    uv_px, depth_m = move_along_rays(columns, torch.from_numpy(intrinsics)[None], torch.from_numpy(by_m)[None])
    np.testing.assert_allclose(uv_px[0].numpy(), after, atol=1e-6)
    np.testing.assert_allclose(depth_m[0].numpy(), start[2] + (range_m + by_m) * ray[:, 2])


@pytest.mark.parametrize("difficulty", [0.5, 1.0])
def test_returns_are_lost_and_go_astray_at_the_stated_rates(difficulty: float) -> None:
    frames = returns_at(20.0, 20_000)
    expected = pytest.approx(1 - 0.2 * difficulty, abs=0.015)
    assert seen_share(replace(PERFECT, drop_share=0.2), frames, difficulty) == expected
    measured_m = replace(PERFECT, outlier_share=0.1)(frames, difficulty, generator())
    stray = (measured_m - 20).abs() > 0.01
    assert stray.float().mean().item() == pytest.approx(0.1 * difficulty, abs=0.01)
    assert measured_m.min() >= 0.5 and measured_m.max() < 20.01
    assert measured_m[stray].mean().item() == pytest.approx(10.25, abs=0.5)


def test_padding_is_no_return() -> None:
    frames = returns_at(9.0, 64)
    frames["lidar"] = torch.cat([frames["lidar"], torch.zeros(1, 30, 16)], dim=1)
    frames["lidar"][0, 0, 2:4] = 0  # nothing but padding is left at pixel (0, 0)
    assert PERFECT(frames, 1.0, generator())[0, 0, 0, 0] == 0


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"scanners": ["hdl46"]}, "scanners"),
        ({"scanners": []}, "scanners"),
        ({"min_lines": 0}, "min_lines"),
        ({"min_lines": 200}, "min_lines"),
        ({"reach_80_m": 150.0}, "reach_80_m"),
        ({"reach_10_m": 0.0}, "reach_10_m"),
        ({"range_noise_m": -0.1}, "range_noise_m"),
        ({"drop_share": 0.9, "outlier_share": 0.2}, "drop_share"),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        Lidar(**wrong)


@pytest.mark.parametrize("name", [*SCANNERS, "lidars"])
def test_every_configuration_names_its_scanner_and_all_of_the_sensors_numbers(name: str) -> None:
    config = OmegaConf.load(CONF_DIR / f"sensor/{name}.yaml")
    sensor = instantiate(config)
    assert list(sensor.scanners) == (list(SCANNERS) if name == "lidars" else [name])
    assert set(config) - {"_target_"} == {field.name for field in fields(Lidar)}
