"""Time of flight against complex arithmetic, loops and closed forms."""

import cmath
import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.sensors import Tof
from depthreg.sensors.multipath import indirect_light, patch_transport
from depthreg.sensors.reflection import infrared_albedo, matte_return, view_rays
from depthreg.sensors.tof import range_sigma_m, unambiguous_range_m, unwrap
from depthreg.sensors.windows import average_returns

MakeFrames = Callable[..., FrameBatch]
C_M_PER_S = 299_792_458.0
PERFECT = {
    "sigma_at_1m": 0.0, "ambient": 0.0, "mixing": 0.0, "wiggle_m": 0.0, "multipath": 0.0, "min_amplitude": 0.0,
    "max_amplitude": math.inf, "max_step_m": math.inf, "wrap_share": 1.0,
}  # fmt: skip


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def walls(*depths_m: float, height: int = 37, width: int = 53) -> Tensor:
    return torch.tensor(depths_m, dtype=torch.float32)[:, None, None, None].expand(-1, 1, height, width).clone()


def corner(make_surface: MakeFrames, opening: int) -> FrameBatch:
    """Two walls at right angles that meet in an upright edge 2 m away: concave (opening 1) or convex (-1)."""
    frames = make_surface(walls(2.0), albedo=0.8, focal_px=50.0)
    x = view_rays(frames["intrinsics"], (37, 53))[:, :1]
    frames["depth_m"] = 2 / (1 + opening * x.abs())  # points satisfy z + opening |X| = 2
    side = torch.where(x > 0, 1.0, -1.0) * opening
    frames["normal"] = torch.cat([-side, 0 * x, -torch.ones_like(x)], dim=1) / math.sqrt(2)
    return frames


@pytest.mark.parametrize(("depth_m", "ambient"), [(1.0, 0.0), (2.0, 0.0), (2.0, 0.75)])
def test_noise_on_a_white_wall_is_photon_noise(depth_m: float, ambient: float, make_surface: MakeFrames) -> None:
    """Amplitude is 1 / z^2, so sigma is 1 mm * z in the dark, and 1 mm * z^2 * sqrt(1 / z^2 + ambient) in the light."""
    sensor = Tof(**{**PERFECT, "frequencies_mhz": [30], "sigma_at_1m": 0.001, "ambient": ambient})
    error_mm = 1e3 * (sensor(make_surface(walls(depth_m)), 1.0, generator()) - depth_m)
    expected_mm = depth_m**2 * math.sqrt(1 / depth_m**2 + ambient)
    assert error_mm.std().item() == pytest.approx(expected_mm, rel=0.06)
    assert abs(error_mm.mean().item()) < 0.1 * expected_mm


def test_noise_goes_with_one_over_the_root_of_the_amplitude_in_the_dark() -> None:
    amplitude = torch.tensor([1.0, 0.25, 0.01])
    torch.testing.assert_close(range_sigma_m(amplitude, 0.002, 0.0), torch.tensor([0.002, 0.004, 0.02]))


@pytest.mark.parametrize(("frequencies_mhz", "reach_m"), [([30], 4.99654), ([100], 1.49896), ([80, 100], 7.49481)])
def test_things_beyond_the_unambiguous_range_come_back_too_near(
    frequencies_mhz: list[int], reach_m: float, make_surface: MakeFrames
) -> None:
    assert unambiguous_range_m(frequencies_mhz) == pytest.approx(reach_m, rel=1e-5)
    sensor = Tof(**{**PERFECT, "frequencies_mhz": frequencies_mhz})
    frames = make_surface(walls(0.7, reach_m - 0.2, reach_m + 0.3, 2 * reach_m + 1))
    measured_m = sensor(frames, 1.0, generator())[:, 0, 5, 5]
    np.testing.assert_allclose(measured_m, [0.7, reach_m - 0.2, 0.3, 1.0], atol=1e-3)


def test_wrapping_befalls_the_stated_share_of_samples(make_surface: MakeFrames) -> None:
    sensor = Tof(**{**PERFECT, "frequencies_mhz": [30], "wrap_share": 0.6})
    frames = make_surface(walls(*[6.0] * 400, height=2, width=2))
    for difficulty in (0.5, 1.0):
        wrapped = sensor(frames, difficulty, generator())[:, 0, 0, 0] < 2
        assert wrapped.float().mean().item() == pytest.approx(0.6 * difficulty, abs=0.08)


def test_two_phases_give_the_range_that_complex_numbers_agree_on() -> None:
    ranges_m = np.arange(0.01, 7.49, 0.013)
    phases = [np.angle(np.exp(4j * np.pi * f * 1e6 * ranges_m / C_M_PER_S)) % (2 * np.pi) for f in (80, 100)]
    found_m = unwrap([torch.tensor(phase) for phase in phases], [80, 100])
    np.testing.assert_allclose(found_m, ranges_m, atol=1e-6)


def test_a_pixel_at_an_edge_reports_the_angle_of_the_sum_of_both_phasors(make_surface: MakeFrames) -> None:
    depth_m = walls(1.0)
    depth_m[..., 26:] = 1.9
    sensor = Tof(**{**PERFECT, "frequencies_mhz": [60], "mixing": 0.3})
    measured_m = sensor(make_surface(depth_m), 1.0, generator())[0, 0, 18]
    turn = 4 * math.pi * 60e6 / C_M_PER_S
    near, far = cmath.rect(1, turn * 1.0), cmath.rect(1 / 1.9**2, turn * 1.9)
    sums = (0.7 * near + 0.3 * far, 0.3 * near + 0.7 * far)
    expected_m = [(cmath.phase(light) % (2 * math.pi)) / turn for light in sums]
    np.testing.assert_allclose(measured_m[25:27], expected_m, atol=1e-4)
    assert 1.01 < measured_m[25] < measured_m[26] < 1.89  # flying: at neither of both
    np.testing.assert_allclose(measured_m[[3, 24, 27, 50]], [1, 1, 1.9, 1.9], atol=1e-4)


def test_wiggling_repeats_with_a_quarter_of_the_unambiguous_range(make_surface: MakeFrames) -> None:
    """c / (8 f) = 0.9368 m at 40 MHz."""
    ranges_m = 1 + np.arange(37 * 53) * 1e-3
    depth_m = torch.tensor(ranges_m, dtype=torch.float32).view(1, 1, 37, 53)
    sensor = Tof(**{**PERFECT, "frequencies_mhz": [40], "wiggle_m": 0.02})
    for difficulty in (0.5, 1.0):
        error_m = (sensor(make_surface(depth_m), difficulty, generator()) - depth_m).flatten().numpy()
        period = round(C_M_PER_S / (8 * 40e6) / 1e-3)
        np.testing.assert_allclose(error_m[period:], error_m[:-period], atol=2e-4)
        np.testing.assert_allclose(error_m[period // 2 :][:900], -error_m[:900], atol=2e-4)
        assert np.abs(error_m).max() == pytest.approx(0.02 * difficulty, rel=0.01)


def test_light_between_patches_is_what_a_loop_over_lamberts_law_gives() -> None:
    rng = np.random.default_rng(5)
    points, normals = rng.normal(loc=[0, 0, 4], size=(6, 3)), rng.normal(size=(6, 3))
    normals *= -np.sign((normals * points).sum(axis=1, keepdims=True))  # all face the camera
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo, solid_angle = rng.uniform(0.2, 1, 6), np.full(6, 1e-7)
    light, detour_m = patch_transport(
        *(torch.tensor(values, dtype=torch.float64)[None] for values in (points, normals, albedo, solid_angle))
    )
    lit = 0
    for i, j in np.ndindex(6, 6):
        if i == j:
            continue
        way = points[j] - points[i]
        distance = np.linalg.norm(way)
        cos_i, cos_j = normals[i] @ way / distance, -normals[j] @ way / distance
        range_j = np.linalg.norm(points[j])
        cos_lamp = -normals[j] @ points[j] / range_j
        area = solid_angle[j] * range_j**2 / cos_lamp
        radiance = albedo[j] / np.pi * cos_lamp / range_j**2  # of a patch lit by a lamp of unit strength
        expected = radiance * area * cos_i * cos_j / distance**2 if min(cos_i, cos_j) > 0 else 0
        assert light[0, i, j].item() == pytest.approx(expected, rel=1e-4)
        assert detour_m[0, i, j].item() == pytest.approx((range_j + distance - np.linalg.norm(points[i])) / 2)
        lit += expected > 0
    assert lit >= 4


def test_a_flat_wall_and_a_convex_corner_get_no_second_light(make_surface: MakeFrames) -> None:
    wall = make_surface(walls(2.0), focal_px=50.0)
    for frames in (wall, corner(make_surface, -1)):
        points_m = view_rays(frames["intrinsics"], (37, 53)) * frames["depth_m"]
        light = indirect_light(points_m, frames["normal"], frames["albedo"], torch.tensor([50.0]), [30], 150)
        assert light.abs().max() < 1e-6


def bias_of_one_bounce_m(frames: FrameBatch, row: int, column: int, frequency_mhz: float) -> float:
    """The sum over all pixels' areas, in double precision: lamp, pixel, this pixel, camera."""
    intrinsics = frames["intrinsics"][0].double().numpy()
    depth_m, normal = (frames[key][0].double().numpy() for key in ("depth_m", "normal"))
    v, u = np.mgrid[:37, :53]
    rays = np.stack([(u - intrinsics[0, 2]) / 50, (v - intrinsics[1, 2]) / 50, np.ones_like(depth_m[0])])
    points, lengths = rays * depth_m, np.linalg.norm(rays, axis=0)
    range_m = lengths * depth_m[0]
    cos_lamp = -(normal * rays).sum(axis=0) / lengths
    area = depth_m[0] ** 2 / 50**2 / lengths / cos_lamp  # of a pixel on the surface
    here, facing = points[:, row, column], normal[:, row, column]
    way = points - here[:, None, None]
    distance = np.linalg.norm(way, axis=0)
    distance[row, column] = np.inf
    cos_here = np.einsum("k,kyx->yx", facing, way) / distance
    cos_there = -(normal * way).sum(axis=0) / distance
    arriving = 0.8 / np.pi * cos_lamp / range_m**2 * area * cos_here.clip(0) * cos_there.clip(0) / distance**2
    detour = (range_m + distance - range_m[row, column]) / 2
    detour[row, column] = 0
    turn = 4 * np.pi * frequency_mhz * 1e6 / C_M_PER_S
    cos = cos_lamp[row, column]
    direct = cos * (1 - (1 - cos) ** 5) / range_m[row, column] ** 2
    return np.angle(direct + (arriving * np.exp(1j * turn * detour)).sum()) / turn / lengths[row, column]


def test_a_concave_corner_is_seen_too_far_by_what_one_bounce_adds(make_surface: MakeFrames) -> None:
    frames = corner(make_surface, 1)
    frames["albedo"] = torch.ones_like(frames["albedo"])  # the only one that infrared leaves as it is
    changes = {"frequencies_mhz": [20], "multipath": 0.8, "min_albedo": 0.0}  # as an albedo of 0.8 at the second wall
    for patches, tolerance in ((1961, 0.1), (400, 0.25)):
        measured_m = Tof(**{**PERFECT, **changes, "patches": patches})(frames, 1.0, generator())
        error_m = (measured_m - frames["depth_m"])[0, 0]
        assert (error_m > -1e-4).all()
        for column in (4, 12, 20, 34, 47):
            expected_m = bias_of_one_bounce_m(frames, 18, column, 20)
            assert expected_m > 0.01
            assert error_m[18, column].item() == pytest.approx(expected_m, rel=tolerance)


@pytest.mark.parametrize(
    ("changes", "depth_m", "albedo", "gloss", "seen"),
    [
        ({"min_amplitude": 0.02}, 2.0, 1.0, 0.0, True),  # 1 / 4
        ({"min_amplitude": 0.02}, 8.0, 1.0, 0.0, False),  # 1 / 64
        ({"min_amplitude": 0.02, "frequencies_mhz": [10]}, 7.0, 1.0, 0.0, True),  # 1 / 49 = 0.0204
        ({"max_amplitude": 3.9}, 0.5, 1.0, 0.0, False),  # 4
        ({"max_amplitude": 4.1}, 0.5, 1.0, 0.0, True),
        ({"max_amplitude": 4.1}, 1.0, 1.0, 0.2, False),  # a highlight of 0.2 * 101
        ({"min_albedo": 0.06}, 1.0, 0.003, 0.0, False),  # even its root is below
        ({"min_albedo": 0.06}, 1.0, 0.07, 0.0, True),
    ],
)
def test_weak_and_blinding_light_give_no_return(
    changes: dict[str, float], depth_m: float, albedo: float, gloss: float, seen: bool, make_surface: MakeFrames
) -> None:
    sensor = Tof(**{**PERFECT, "frequencies_mhz": [15], **changes})
    measured_m = sensor(make_surface(walls(depth_m), albedo, gloss), 1.0, generator())
    assert ((measured_m > 0) == seen).all()


def test_a_large_step_leaves_a_hole_on_both_sides_and_a_small_one_none(make_surface: MakeFrames) -> None:
    depth_m = walls(2.0, 2.0)
    depth_m[0, ..., 26:], depth_m[1, ..., 26:] = 2.81, 2.79
    measured_m = Tof(**{**PERFECT, "max_step_m": 0.8})(make_surface(depth_m), 1.0, generator())
    assert [column for column in range(53) if (measured_m[0, ..., column] == 0).all()] == [25, 26]
    assert (measured_m[1] > 0).all()


def test_fewer_pixels_are_drawn_as_blocks_of_the_same_grid(make_surface: MakeFrames) -> None:
    depth_m = 1 + torch.rand(1, 1, 40, 60, generator=generator())
    measured_m = Tof(**{**PERFECT, "resolution_share": 0.25})(make_surface(depth_m), 1.0, generator())[0, 0]
    blocks = measured_m.unflatten(1, (15, 4)).unflatten(0, (10, 4)).transpose(1, 2)  # (10, 15, 4, 4)
    assert (blocks == blocks[..., :1, :1]).all()
    assert len(blocks[..., 0, 0].unique()) > 140


def test_the_instruments_filter_is_opencvs_box_where_all_is_seen_and_never_mixes_holes_in() -> None:
    depth_m = 1 + torch.rand(1, 1, 37, 53, generator=generator())
    expected = cv2.blur(depth_m[0, 0].numpy(), (3, 3), borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(average_returns(depth_m, 1 / 3)[0, 0], expected, atol=1e-5)
    flat_m = 2.0 * (torch.rand(1, 1, 37, 53, generator=generator()) < 0.5)
    torch.testing.assert_close(average_returns(flat_m, 1 / 3), flat_m)


def test_depth_is_along_the_axis_though_light_travels_along_rays(make_surface: MakeFrames) -> None:
    frames = make_surface(walls(2.0), focal_px=30.0)
    torch.testing.assert_close(Tof(**PERFECT)(frames, 1.0, generator()), frames["depth_m"], atol=1e-3, rtol=0)


def test_the_sky_stays_empty(make_surface: MakeFrames) -> None:
    depth_m = walls(2.0)
    depth_m[..., :20] = 0
    measured_m = Tof(min_amplitude=0.0)(make_surface(depth_m), 0.3, generator())
    assert (measured_m[..., :20] == 0).all() and (measured_m[..., 22:] > 0).all()


def test_light_that_comes_back_follows_lamberts_law_and_the_inverse_square() -> None:
    white, matte, head_on = torch.tensor(1.0), torch.tensor(0.0), torch.tensor(1.0)
    assert matte_return(white, matte, head_on, torch.tensor(1.0)) == 1
    assert matte_return(0.5 * white, matte, head_on, torch.tensor(2.0)) == 0.125
    assert matte_return(white, matte, 0.5 * head_on, torch.tensor(1.0)).item() == pytest.approx(0.5 * (1 - 0.5**5))
    assert matte_return(white, matte, head_on, torch.tensor(0.0)) == 0


def test_infrared_makes_dark_things_brighter_but_no_brighter_than_their_root() -> None:
    albedo = torch.full((200, 1, 2, 2), 0.09)
    seen = infrared_albedo(albedo, generator())
    assert (seen >= 0.09 - 1e-6).all() and (seen <= 0.3 + 1e-6).all() and seen.std() > 0.03
    assert (infrared_albedo(torch.zeros(1, 1, 2, 2), generator()) == 0).all()


@pytest.mark.parametrize(
    "wrong", [{"frequencies_mhz": []}, {"frequencies_mhz": [0]}, {"mixing": 0.5}, {"resolution_share": 0.0}]
)
def test_an_instrument_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"sensor.{next(iter(wrong))}="):
        Tof(**wrong)
