"""Fog, rain and night, against the laws that they are made of."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from depthreg.data.sample import FrameBatch, Measurement
from depthreg.errors import InputError
from depthreg.geometry import identity_affine, warp_affine
from depthreg.sensors import Clean, Lidar, SensorSimulator, Weather
from depthreg.sensors.rain import Streaks, draw_streaks, drops_per_m3, rain_extinction_per_m, random_streaks
from depthreg.sensors.reflection import view_rays
from depthreg.sensors.weather import fog_extinction_per_m, haze, lose_returns, night, overcast, range_in_view

MakeFrames = Callable[..., FrameBatch]
SIZE = (37, 53)
K = torch.tensor([[[80.0, 0, 26], [0, 80, 18], [0, 0, 1]]])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def always(kind: str) -> Weather:
    return Weather(**{"fog_share": 0.0, "rain_share": 0.0, "night_share": 0.0, f"{kind}_share": 1.0})


def measurement(batch: int, depth_m: float = 20.0) -> Measurement:
    return Measurement(
        rgb=torch.full((batch, 3, *SIZE), 0.4),
        truth_depth_m=torch.full((batch, 1, *SIZE), depth_m),
        intrinsics=K.repeat(batch, 1, 1),
        truth_affine_rgb_from_depth=identity_affine(batch),
    )


def test_at_the_visibility_a_twentieth_of_the_contrast_is_left() -> None:
    black, white = torch.zeros(1, 3, 1, 1), torch.ones(1, 3, 1, 1)
    range_m, airlight = torch.full((1, 1, 1, 1), 80.0), torch.tensor([0.6])
    extinction = torch.tensor([fog_extinction_per_m(80.0)])
    seen = [haze(image, range_m, extinction, airlight) for image in (black, white)]
    torch.testing.assert_close(seen[1] - seen[0], torch.full((1, 3, 1, 1), 0.05))
    twice = [haze(image, 2 * range_m, extinction, airlight) for image in (black, white)]
    torch.testing.assert_close(twice[1] - twice[0], torch.full((1, 3, 1, 1), 0.05**2))
    torch.testing.assert_close(haze(black, 1e4 * range_m, extinction, airlight), 0.6 * white)


def test_in_dense_fog_nothing_is_brighter_than_the_fog() -> None:
    image, airlight = torch.linspace(0, 1, 11).view(1, 1, 1, 11), torch.tensor([0.6])
    assert torch.equal(overcast(image, torch.tensor([0.0]), airlight), image)
    torch.testing.assert_close(overcast(image, torch.tensor([1.0]), airlight), image.clamp(max=0.6))
    halfway = overcast(image, torch.tensor([2.0]).log() / 100, airlight)  # half of the sunlight passes 100 m of it
    torch.testing.assert_close(halfway, image.clamp(max=0.8))


def test_range_is_the_length_of_the_ray_and_the_sky_is_far() -> None:
    depth_m = torch.full((1, 1, *SIZE), 10.0)
    depth_m[..., :9, :] = 0
    range_m = range_in_view(depth_m, identity_affine(1), K)[0, 0]
    for row, column in ((18, 26), (36, 52), (12, 0)):
        along_ray = 10 * np.sqrt(1 + ((column - 26) / 80) ** 2 + ((row - 18) / 80) ** 2)
        assert range_m[row, column].item() == pytest.approx(along_ray, rel=1e-5)
    assert (range_m[:9] >= 1000).all()


def test_the_range_moves_with_the_colour_and_goes_on_at_the_border() -> None:
    depth_m = torch.arange(5.0, 5 + SIZE[1]).expand(1, 1, *SIZE)
    shift = torch.tensor([[[1.0, 0, 7], [0, 1, 0]]])  # the colour of a point lies 7 px to the right of its depth
    z_m = (range_in_view(depth_m, shift, K) / view_rays(K, SIZE).norm(dim=1, keepdim=True))[0, 0, 5]
    torch.testing.assert_close(z_m[7:], depth_m[0, 0, 5, :-7])
    torch.testing.assert_close(z_m[:7], torch.full((7,), 5.0))


def test_fog_on_the_misaligned_picture_is_fog_on_the_aligned_one(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=4, margin_px=9)
    pale = Weather(fog_share=1.0, rain_share=0.0, night_share=0.0, min_visibility_m=30.0)
    simulator = SensorSimulator(Clean(), 80.0, weather=pale)
    misaligned = simulator(frames, 1.0, generator())
    still = SensorSimulator(Clean(), 80.0)(frames, 1.0, generator())
    assert torch.equal(misaligned["truth_affine_rgb_from_depth"], still["truth_affine_rgb_from_depth"])
    assert torch.equal(misaligned["truth_rgb"], still["truth_rgb"])
    aligned, seen = warp_affine(misaligned["rgb"], misaligned["truth_affine_rgb_from_depth"])
    foggy, clear = aligned**2.2, misaligned["truth_rgb"] ** 2.2
    range_m = frames["depth_m"] * view_rays(frames["intrinsics"], (61, 93)).norm(dim=1, keepdim=True)
    inner = seen.float()
    inner[..., :9, :] = inner[..., -9:, :] = inner[..., :9] = inner[..., -9:] = 0  # the border's depth goes on
    for i in range(4):
        # Two unknowns for each picture, the density and the airlight: fitted, then every pixel must agree.
        best = min(
            ((haze(overcast(clear[[i]], beta, air), range_m[[i]], beta, air) - foggy[i]).abs() * inner[i]).max()
            for beta in torch.linspace(0, 0.1, 101).split(1)
            for air in torch.linspace(0.35, 0.8, 46).split(1)
        )
        assert best < 0.03


def test_drops_are_as_many_as_marshall_and_palmer_counted() -> None:
    for rate in (5.0, 25.0, 100.0):
        expected, _ = quad(lambda diameter_mm: 8000 * np.exp(-4.1 * rate**-0.21 * diameter_mm), 1.5, 50)  # noqa: B023
        assert drops_per_m3(torch.tensor(rate), 1.5).item() == pytest.approx(expected, rel=1e-4)


def test_rain_dims_as_published() -> None:
    assert rain_extinction_per_m(torch.tensor(25.0)).item() * 1000 == pytest.approx(2.70, abs=0.01)


def test_streaks_have_the_size_of_falling_drops() -> None:
    rate = torch.tensor([10.0, 100.0])
    streaks = random_streaks(rate, K.repeat(2, 1, 1), SIZE, 0.004, generator())
    there = streaks.opacity_px > 0
    pyramid_m3 = 53 * 37 / 80**2 * 4.0**3 / 3  # to 4 m before the camera
    for i in range(2):
        expected = drops_per_m3(rate[i], 1.5).item() * pyramid_m3 * (1 - 1 / 4**3)  # but for the nearest metre
        assert there[i].sum().item() == pytest.approx(expected, rel=0.03)
    # Drops fall at 5 to 10 m/s (Gunn and Kinzer 1949: 5.4 m/s at 1.5 mm, 9 m/s at 5 mm).
    length_px = streaks.length_px[there]
    assert length_px.min() > 5 * 0.004 * 80 / 4 and length_px.max() < 12 * 0.004 * 80 / 1
    ratio = random_streaks(rate, K.repeat(2, 1, 1), SIZE, 0.008, generator()).length_px / streaks.length_px
    torch.testing.assert_close(ratio, torch.full_like(ratio, 2.0))


@pytest.mark.parametrize("slant", [0.0, -0.4])
def test_a_streak_covers_its_opacity_times_its_length_along_its_slant(slant: float) -> None:
    one = Streaks(*(torch.tensor([[value]]) for value in (26.3, 18.0, 12.0, 0.2)))
    cover = draw_streaks(one, torch.tensor([slant]), SIZE, 40)[0, 0].double()
    assert cover.sum().item() == pytest.approx(0.2 * 12.0, rel=1e-5)
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    mean_row, mean_column = (cover.numpy() * row).sum() / 2.4, (cover.numpy() * column).sum() / 2.4
    assert (mean_row, mean_column) == pytest.approx((18.0, 26.3), abs=0.05)
    away = (cover.numpy() * (row - mean_row) * (column - mean_column)).sum() / 2.4
    assert away == pytest.approx(slant * 12**2 / 12, abs=0.3)


@pytest.mark.parametrize("luck", [0.0, 1 - 2**-24])  # the least and the most that torch.rand draws
def test_the_rarest_draws_of_a_drop_are_drops_too(luck: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "rand", lambda *size, generator: torch.full(size, luck))
    streaks = random_streaks(torch.tensor([50.0]), K, SIZE, 0.004)
    assert all(torch.isfinite(part).all() for part in streaks)
    assert torch.isfinite(draw_streaks(streaks, torch.zeros(1), SIZE, 40)).all()


def test_streaks_beyond_the_image_leave_nothing() -> None:
    outside = Streaks(*(torch.tensor([[value] * 2]) for value in (-9.0, 18.0, 6.0, 0.5)))
    assert (draw_streaks(outside, torch.zeros(1), SIZE, 9) == 0).all()


def lit(range_m: float, daylight: float) -> Tensor:
    image = torch.full((1, 3, *SIZE), 0.5)
    at = torch.full((1, 1, *SIZE), range_m)
    return night(image, at, view_rays(K, SIZE), torch.tensor([daylight]), headlight_m=8.0)


def test_headlights_fade_with_the_square_of_the_distance() -> None:
    near, far = lit(20.0, 1e-9), lit(40.0, 1e-9)
    torch.testing.assert_close(near, 4 * far, rtol=1e-4, atol=1e-8)
    assert near[0, 0, -1, 26] > 3 * near[0, 0, 0, 26]  # low beam stays below the horizon
    assert near[0, 0, -1, 26] > 1.05 * near[0, 0, -1, 0]  # and goes ahead


def test_what_headlights_do_not_reach_is_dark_and_blue() -> None:
    far = lit(1000.0, 0.02)[0, :, 18, 26]
    assert far.max() < 0.02 and far[2] > 1.5 * far[0]
    torch.testing.assert_close(lit(20.0, 1.0), torch.full((1, 3, *SIZE), 0.5))


def test_nights_are_noisy() -> None:
    dark = always("night")(measurement(20, 1000.0), 1.0, generator())["rgb"]
    level, noise = dark.mean(dim=(1, 2, 3)), dark.diff(dim=-1).std(dim=(1, 2, 3))
    assert noise[level.argmin()] > 5 * noise[level.argmax()] > 0


@pytest.mark.parametrize("kind", ["fog", "rain", "night"])
def test_weather_gets_more_frequent_and_worse_with_difficulty(kind: str) -> None:
    clear = measurement(200)
    shares, changes = [], []
    for difficulty in (0.3, 1.0):
        mixed = Weather(0.2, 0.2, 0.2)(clear, difficulty, generator())["rgb"]
        shares.append((mixed != clear["rgb"]).flatten(1).any(dim=1).float().mean().item())
        worst = always(kind)(clear, difficulty, generator())["rgb"]
        changes.append((worst - clear["rgb"]).abs().mean(dim=(1, 2, 3)).max())
    assert shares == pytest.approx([0.3 * 0.6, 0.6], abs=0.08)
    assert changes[1] > 1.3 * changes[0] > 0


@pytest.mark.parametrize("weather", [Weather(), *map(always, ("fog", "rain", "night"))])
def test_difficulty_zero_is_a_clear_day(weather: Weather) -> None:
    clear = measurement(3)
    clear["depth_m"] = clear["truth_depth_m"]
    out = weather(clear, 0.0, generator(), scanned=True)
    assert all(torch.equal(out[key], clear[key]) for key in clear)


def test_a_sample_has_one_weather_at_most_and_clear_days_stay_as_they_are() -> None:
    clear = measurement(60)
    weather = Weather(0.2, 0.2, 0.2)
    sky = weather.draw(60, 1.0, generator())
    foggy, rainy, dark = (sky.extinction_per_m > 0) & (sky.rain_mm_h == 0), sky.rain_mm_h > 0, sky.daylight < 1
    for kind in (foggy, rainy, dark):
        assert 4 < kind.sum() < 20
    assert (foggy.int() + rainy.int() + dark.int()).max() == 1
    rgb = weather(clear, 1.0, generator())["rgb"]
    assert torch.isfinite(rgb).all() and rgb.min() >= 0 and rgb.max() <= 1
    assert torch.equal((rgb != clear["rgb"]).flatten(1).any(dim=1), foggy | rainy | dark)
    assert torch.equal(clear["rgb"], measurement(60)["rgb"])


def test_a_scanners_light_is_dimmed_on_its_way_there_and_back() -> None:
    depth_m, extinction = torch.full((1, 1, 301, 301), 10.0), torch.tensor([0.03])
    narrow = torch.tensor([[[1e5, 0, 150], [0, 1e5, 150], [0, 0, 1]]])  # so that ranges are depths
    left_m = lose_returns(depth_m, narrow, extinction, generator())
    assert set(left_m.unique().tolist()) == {0.0, 10.0}
    assert (left_m > 0).float().mean().item() == pytest.approx(np.exp(-2 * 0.03 * 10), abs=0.01)


def test_fog_swallows_a_scanners_returns_and_no_one_elses(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=8)
    for sensor, thinned in ((Lidar(), True), (Clean(), False)):
        clear = SensorSimulator(sensor)(frames, 1.0, generator())["depth_m"]
        foggy = SensorSimulator(sensor, weather=always("fog"))(frames, 1.0, generator())["depth_m"]
        lost = (clear > 0) & (foggy == 0)
        assert lost.any() == thinned
        assert torch.equal(foggy[~lost], clear[~lost])
        if thinned:
            assert clear[lost].mean() > clear[foggy > 0].mean()  # the farther, the rarer


@pytest.mark.parametrize(
    ("limits", "named"),
    [
        ({"fog_share": -0.1}, "shares"),
        ({"fog_share": 0.5, "rain_share": 0.6}, "shares"),
        ({"min_visibility_m": 0.0}, "limits"),
        ({"min_daylight": 2.0}, "min_daylight"),
        ({"airlight": (0.9, 0.2)}, "airlight"),
    ],
)
def test_weather_that_cannot_be_meant_is_refused(limits: dict[str, float], named: str) -> None:
    with pytest.raises(InputError, match=named):
        Weather(**limits)


@pytest.mark.parametrize("kind", ["fog", "rain", "night"])
def test_rooms_have_no_weather(kind: str) -> None:
    room, street = measurement(8, depth_m=3.0), measurement(8, depth_m=20.0)
    assert torch.equal(always(kind)(room, 1.0, generator())["rgb"], room["rgb"])
    assert not torch.equal(always(kind)(street, 1.0, generator())["rgb"], street["rgb"])
