"""Beam tables against the makers' data sheets, and the geometry of a sweep."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from depthreg.errors import InputError
from depthreg.rendering import SCANNERS, ScanPattern, hdl64


def angles_deg(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation."""
    return np.rad2deg(np.arctan2(rays[..., 1], rays[..., 0])), np.rad2deg(np.arcsin(rays[..., 2]))


def test_hdl64_has_the_data_sheets_beams() -> None:
    scan = hdl64()
    assert len(scan.elevations_deg) == 64
    # Every unit is calibrated: KITTI's keeps within a quarter of a degree of the data sheet's angles.
    sheet_deg = np.concatenate([np.linspace(1.97, -8.5, 32), np.linspace(-8.9, -24.9, 32)])
    np.testing.assert_allclose(scan.elevations_deg, sheet_deg, atol=0.25)
    assert scan.elevations_deg[-1] == pytest.approx(-24.9)
    upper, lower = -np.diff(scan.elevations_deg[:32]), -np.diff(scan.elevations_deg[32:])
    np.testing.assert_allclose([upper.mean(), lower.mean()], [1 / 3, 1 / 2], atol=0.02)
    assert scan.azimuth_step_deg * scan.sweep_s * 10 == pytest.approx(0.1728 * 0.1 * 10)  # at 10 turns a second
    assert scan.divergence_mrad == 2.0


@pytest.mark.parametrize(
    ("name", "lines", "highest_deg", "lowest_deg", "gap_deg", "firings_per_s"),
    [
        ("hdl32", 32, 10.67, -30.67, 1.333, 695_000),  # "up to ~0.7 million points per second"
        ("vlp16", 16, 15.0, -15.0, 2.0, 289_000),  # "~0.3 million"
        ("os1_64", 64, 22.5, -22.5, 0.714, 655_360),  # 64 * 1024 * 10
        ("os1_128", 128, 22.5, -22.5, 0.354, 2_621_440),  # of the data sheet
        ("solid_state", 126, 12.5, -12.5, 0.2, 757_000),  # RoboSense M1: 750,000
    ],
)
def test_other_scanners_have_their_data_sheets_beams(
    name: str, lines: int, highest_deg: float, lowest_deg: float, gap_deg: float, firings_per_s: int
) -> None:
    scan = SCANNERS[name]
    assert len(scan.elevations_deg) == lines
    assert (scan.elevations_deg[0], scan.elevations_deg[-1]) == pytest.approx((highest_deg, lowest_deg))
    np.testing.assert_allclose(-np.diff(scan.elevations_deg), gap_deg, rtol=2e-3)
    firings = scan.firings().time_s.size / scan.sweep_s
    assert firings == pytest.approx(firings_per_s, rel=0.01)


def test_the_two_halves_of_a_puck_fire_in_turns() -> None:
    scan = SCANNERS["vlp16"]
    order = np.asarray(scan.elevations_deg)[np.argsort(scan.azimuth_offsets_deg)]
    # The user manual's firing order.
    np.testing.assert_allclose(order, [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])


def test_a_turn_has_the_number_of_firings_that_the_step_says() -> None:
    scan = ScanPattern((0.0, -10.0), azimuth_step_deg=0.5)
    assert scan.firings(-90.0, 89.9).rays.shape == (2, 360, 3)


def test_rays_are_unit_vectors_at_their_rings_elevation_and_offset() -> None:
    scan = ScanPattern((2.0, -24.0), azimuth_step_deg=1.0, azimuth_offsets_deg=(0.0, 0.3))
    rays = scan.firings(-40.0, 40.0).rays
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-6)
    azimuth, elevation = angles_deg(rays)
    np.testing.assert_allclose(elevation, np.broadcast_to([[2.0], [-24.0]], elevation.shape), atol=1e-4)
    np.testing.assert_allclose(azimuth[1] - azimuth[0], 0.3, atol=1e-4)
    np.testing.assert_allclose(azimuth[0], np.arange(-40, 41), atol=1e-4)


def test_columns_of_an_hdl64_do_not_line_up_and_those_of_an_ouster_do() -> None:
    for name, aligned in (("hdl64", False), ("os1_128", True)):
        scan = SCANNERS[name]
        azimuth, _ = angles_deg(scan.firings(-20.0, 20.0).rays)
        phase = azimuth[:, 0] / scan.azimuth_step_deg % 1
        assert (len(np.unique(np.round(phase, 3) % 1)) == 1) == aligned


def test_columns_of_hdl64s_rings_stand_at_no_fixed_phase_from_their_neighbours() -> None:
    scan = hdl64()
    phase = np.asarray(scan.azimuth_offsets_deg) / scan.azimuth_step_deg
    between = np.abs(np.exp(2j * np.pi * np.diff(phase)).mean())
    assert between < 3 / np.sqrt(63)  # Rayleigh: random phases leave 1 / sqrt(n), equal ones 1


def test_a_laser_that_is_turned_by_whole_steps_looks_there_so_many_firings_earlier() -> None:
    straight = ScanPattern((0.0, -1.0), 0.5, azimuth_tick_deg=0.3, view_deg=90.0, sweep_s=0.9)
    turned = replace(straight, azimuth_offsets_deg=(0.0, 3.0))
    before, after = (scan.firings(-20.0, 20.0) for scan in (straight, turned))
    np.testing.assert_allclose(after.rays, before.rays, atol=1e-6)
    np.testing.assert_allclose(after.time_s - before.time_s, np.array([[0.0], [-0.03]]) * np.ones(81), atol=1e-6)
    np.testing.assert_allclose(after.slip_rad[1, 6:], before.slip_rad[1, :-6], atol=1e-6)


def test_the_encoders_ticks_leave_gaps_at_other_azimuths_in_every_ring() -> None:
    firings = hdl64().firings(-30, 30)
    stated = np.arctan2(firings.rays[..., 1], firings.rays[..., 0]) + firings.slip_rad
    short = np.diff(stated) < np.deg2rad(0.135)  # one tick where others have two
    chance = short.mean()
    together = np.mean([(short[k] & short[k + 1]).mean() for k in range(63)])
    assert 0.1 < chance < 0.2 and together < 2.5 * chance**2


def test_kittis_lasers_point_where_another_of_its_recordings_shows_them(real_data: Path) -> None:
    scan = hdl64()
    points = np.fromfile(real_data / "kitti_raw_0048/velodyne_fov/0000000001.bin", np.float32).reshape(-1, 4)
    azimuth, range_m = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    starts = np.flatnonzero((azimuth[:-1] < 0) & (azimuth[1:] >= 0)) + 1  # the file goes ring by ring
    rings = [ring for ring in np.split(np.arange(len(points)), starts) if len(ring) > 60]
    up_m = np.array(scan.laser_up_m)
    for ring in rings[2:50]:
        slope = (points[ring, 2] - up_m[:, None]) / range_m[ring]  # (64, N), if it were each of the lasers
        off_deg = np.rad2deg(np.arctan(np.median(slope, axis=1))) - scan.elevations_deg
        assert np.abs(off_deg).min() < 0.02  # neighbours are 0.25 apart and more


def test_a_sweep_starts_at_another_phase_each_time_and_the_generator_decides() -> None:
    scan = hdl64()
    starts = [scan.started(np.random.default_rng(seed)).start for seed in (0, 0, *range(1, 200))]
    assert starts[0] == starts[1] and len(set(starts)) == 200
    assert min(starts) < 0.05 and 0.95 < max(starts) < 1
    at_rest, turned = (replace(scan, start=start).firings(-5, 5).rays for start in (0.0, 0.5))
    shift_deg = angles_deg(turned)[0][0, 0] - angles_deg(at_rest)[0][0, 0]
    assert abs(shift_deg) == pytest.approx(scan.azimuth_step_deg / 2, abs=1e-3)


def test_azimuths_are_reported_in_ticks_off_by_half_of_one_at_most() -> None:
    scan = replace(hdl64(), azimuth_offsets_deg=(), start=0.3)
    firings = scan.firings(-30, 30)
    slip_deg = np.rad2deg(firings.slip_rad)
    assert np.abs(slip_deg).max() <= 0.0451 and slip_deg.std() == pytest.approx(0.09 / np.sqrt(12), rel=0.1)
    stated_deg = angles_deg(firings.rays)[0][0] + slip_deg
    gaps = np.diff(stated_deg) / 0.09
    np.testing.assert_allclose(gaps, np.round(gaps), atol=1e-2)
    # As in KITTI's files: two ticks between firings, and now and then one.
    assert set(np.unique(np.round(gaps))) == {1, 2}
    assert np.rad2deg(SCANNERS["vlp16"].firings(-30, 30).slip_rad).any() == 0


def test_time_runs_along_the_turn_or_down_the_raster() -> None:
    turning = ScanPattern((1.0, 0.0), azimuth_step_deg=1.0, sweep_s=0.1).firings(-90, 90)
    np.testing.assert_allclose(turning.time_s[:, [0, 90, 180]], [[-0.025, 0, 0.025]] * 2, atol=1e-7)
    raster = replace(SCANNERS["solid_state"], sweep_s=0.1).firings()
    assert np.ptp(raster.time_s, axis=1).max() == 0
    np.testing.assert_allclose(raster.time_s[[0, -1], 0], [-0.05, 0.05], atol=1e-3)


def test_a_solid_state_scanner_sees_no_further_than_its_field_of_view() -> None:
    azimuth, _ = angles_deg(SCANNERS["solid_state"].firings().rays)
    assert azimuth.min() == pytest.approx(-60, abs=0.2) and azimuth.max() == pytest.approx(60, abs=0.2)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"elevations_deg": (0.0, 1.0)}, "highest first"),
        ({"elevations_deg": ()}, "at least one"),
        ({"azimuth_offsets_deg": (0.1,)}, "azimuth_offsets_deg has 1 entries for 2"),
        ({"laser_up_m": (0.1,) * 3}, "laser_up_m has 3 entries for 2"),
        ({"azimuth_step_deg": 0.0}, "positive step"),
        ({"max_range_m": 0.5}, "range limits"),
        ({"view_deg": 400.0}, "up to 360"),
        ({"divergence_mrad": -1.0}, "not be negative"),
        ({"motion_residual": 1.5}, "motion_residual"),
    ],
)
def test_an_impossible_scanner_is_refused(wrong: dict[str, object], named: str) -> None:
    given: dict[str, object] = {"elevations_deg": (1.0, 0.0), "azimuth_step_deg": 0.2}
    with pytest.raises(InputError, match=named):
        ScanPattern(**(given | wrong))  # type: ignore[arg-type]
