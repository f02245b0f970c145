import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from likeness import classifier, pictures
from likeness.depth_cameras import (
    DEPTH_CAMERAS,
    depth_samples,
    depth_steps_mm,
    hole_sizes_px,
    real_depth_frames,
    share_of_holes_at_edges,
)
from likeness.distances import between_halves, between_sources, compare, jensen_shannon, wasserstein
from likeness.frames import DepthImage, real_lidar_frames
from likeness.lidar import (
    depth_steps,
    hole_share,
    image_elevation_deg,
    lidar_samples,
    line_gaps_px,
    lines_per_strip,
    plane_roughness_m,
    row_gaps_px,
    see_through_share,
)

from depthreg.rendering import Camera

CAMERA = Camera(width=211, height=97, focal_px=180.0)
Draw = Callable[[np.random.Generator], np.ndarray]


def _plane(normal: tuple[float, float, float], distance_m: float) -> np.ndarray:
    """Depth (H, W) of the plane normal . P = distance, with a unit normal."""
    n = np.array(normal) / np.linalg.norm(normal)
    return distance_m / (CAMERA.rays() @ n)


def _sparse(seed: int, share: float = 0.1) -> np.ndarray:
    return np.random.default_rng(seed).random((CAMERA.height, CAMERA.width)) < share


def test_roughness_is_the_noise_of_a_plane() -> None:
    noise_m = 0.03 * np.random.default_rng(0).standard_normal((CAMERA.height, CAMERA.width))
    rms_m, mean_m = plane_roughness_m((8.0 + noise_m) * _sparse(1), CAMERA.rays())
    assert len(rms_m) > 40
    assert np.sqrt(np.mean(rms_m**2)) == pytest.approx(0.03, rel=0.05)
    assert mean_m == pytest.approx(8.0, abs=0.05)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0.1, 0.8), (-0.3, 0.4, 0.9)])
def test_a_plane_without_noise_is_smooth_however_it_is_turned(normal: tuple[float, float, float]) -> None:
    rms_m, _ = plane_roughness_m(_plane(normal, 6.0) * _sparse(2), CAMERA.rays())
    assert len(rms_m) > 40
    assert rms_m.max() < 1e-5


def test_blocks_that_hold_an_edge_are_no_planes() -> None:
    step = np.where(np.arange(CAMERA.width) % 24 < 12, 5.0, 9.0) * _sparse(3, 0.3)  # an edge amid every block
    assert len(plane_roughness_m(step[:96, :192], CAMERA.rays()[:96, :192])[0]) == 0


def test_a_comb_has_the_gaps_of_its_teeth() -> None:
    comb = np.zeros((40, 61))
    comb[::5, ::4] = 7.0
    assert (row_gaps_px(comb) == 4).all()
    assert (line_gaps_px(comb, strip_px=4) == 5).all()
    assert (lines_per_strip(comb, strip_px=4)[1:] == 7).all()  # 8 less the one in the first row
    assert (depth_steps(comb) == 0).all()


def test_steps_are_ratios_of_neighbouring_depths() -> None:
    row = np.array([[2.0, 0, 4.0, 0, 0, 0, 0, 0, 9.0, 9.0]])
    np.testing.assert_allclose(depth_steps(row), [np.log(2), 0])  # 4 and 9 lie too far apart


def test_returns_lie_at_the_angles_of_their_rows() -> None:
    depth_m = np.zeros((9, 5))
    depth_m[[2, 6], 3] = 1.0
    np.testing.assert_allclose(image_elevation_deg(depth_m, focal_px=2.0, center_row=4.0), [45, -45])


def test_what_lies_behind_a_nearer_neighbour_counts_as_seen_through() -> None:
    depth_m = np.zeros((70, 70), np.float32)
    depth_m[5::10, 5::10] = 10.0  # 49 returns out of each other's reach
    depth_m[[5, 15, 25], [8, 15 - 3, 25 + 3]] = [13.0, 11.6, 11.4]  # beside three of them, 3 px away
    assert see_through_share(depth_m) == pytest.approx(2 / 52)


def test_holes_are_what_lies_far_from_every_return() -> None:
    depth_m = np.full((60, 80), 5.0)
    depth_m[20:41, 30:51] = 0  # of its 21x21 pixels the inner 11x11 are more than 5 px away
    assert hole_share(depth_m) == pytest.approx(121 / (60 * 80))
    depth_m[:15] = 0  # the sky is no hole
    assert hole_share(depth_m) == pytest.approx(121 / (45 * 80))


def _samples(values: list[np.ndarray]) -> list[dict[str, np.ndarray]]:
    return [{"x": value} for value in values]


def test_a_set_has_no_distance_from_itself_and_a_shifted_one_its_shift() -> None:
    values = list(np.random.default_rng(4).normal(size=(6, 50)))
    groups = list("aabbcc")
    for distance in (wasserstein, jensen_shannon):
        assert distance(_samples(values), _samples(values), "x", (groups, groups)) == pytest.approx(0, abs=1e-12)
    moved = _samples([value + 3.5 for value in values])
    assert wasserstein(_samples(values), moved, "x", (groups, groups)) == pytest.approx(3.5)
    apart = _samples([value + 100 for value in values])
    assert jensen_shannon(_samples(values), apart, "x", (groups, groups)) == pytest.approx(1)


def test_a_long_drive_counts_as_much_as_a_single_frame() -> None:
    frames, groups = _samples([np.zeros(7)] * 9 + [np.full(3, 4.0)]), ["drive"] * 9 + ["frame"]
    assert wasserstein(frames, _samples([np.zeros(1)]), "x", (groups, ["other"])) == pytest.approx(2.0)


def test_halves_of_equal_frames_do_not_differ_and_are_split_by_group() -> None:
    same = _samples([np.arange(5.0)] * 8)
    assert between_halves(wasserstein, same, "x", list("abcdefgh")) == pytest.approx(0, abs=1e-12)
    two = _samples([np.zeros(2)] * 3 + [np.ones(2)] * 3)  # however it is split, one drive stands against the other
    assert between_halves(wasserstein, two, "x", list("aaabbb")) == pytest.approx(1)


def test_the_longest_sequence_stands_against_the_rest() -> None:
    frames = _samples([np.zeros(2)] * 3 + [np.full(2, 2.0), np.full(2, 4.0)])
    assert between_sources(wasserstein, frames, "x", list("aaabc")) == pytest.approx(3)
    assert np.isnan(between_sources(wasserstein, frames, "x", list("aaaaa")))


def test_a_comparison_says_both_means_and_what_is_unknown() -> None:
    row = compare(_samples([np.zeros(2), np.ones(4)]), _samples([np.full(3, 3.0)]), list("ab"))["x"]
    assert row["real"] == 0.5 and row["simulated"] == 3
    assert row["w1"] == pytest.approx(2.5) and row["js"] == pytest.approx(1)
    assert row["w1_halves"] == row["w1_sources"] == pytest.approx(1)
    empty = compare(_samples([np.zeros(0)]), _samples([np.zeros(3)]), ["a"])["x"]
    assert np.isnan([empty["real"], empty["w1"], empty["w1_halves"], empty["w1_sources"]]).all()


def test_holes_have_the_size_of_squares_of_their_area() -> None:
    depth_m = np.full((60, 80), 2.0)
    depth_m[5:17, 5:17] = depth_m[30:33, 40:43] = 0
    sizes, counts = np.unique(hole_sizes_px(depth_m), return_counts=True)
    np.testing.assert_allclose(sizes, [3, 12])
    np.testing.assert_array_equal(counts, [9, 144])


def test_holes_in_walls_are_told_from_holes_at_edges() -> None:
    depth_m = np.where(np.arange(80) < 40, 1.0, 3.0) * np.ones((60, 1))
    depth_m[20:30, 38:42] = 0  # 40 pixels astride the step
    depth_m[20:30, 60:72] = 0  # 120 in the wall
    np.testing.assert_allclose(share_of_holes_at_edges(depth_m), [0.25])
    assert len(share_of_holes_at_edges(np.ones((9, 9)))) == 0


def test_kinects_steps_of_an_eighth_of_a_pixel_are_3_mm_at_1_m() -> None:
    disparity_px = np.arange(10, 60, 0.125)
    depth_m = (580 * 0.075 / disparity_px)[:, None] * np.ones(7)
    # z^2 s / (f b); between levels next to each other z changes a little.
    np.testing.assert_allclose(depth_steps_mm(depth_m), 1000 * 0.125 / (580 * 0.075), rtol=0.015)


def test_noise_on_a_wall_is_sorted_by_its_distance() -> None:
    wall_m = 1.5 + 0.004 * np.random.default_rng(5).standard_normal((144, 192))
    samples = depth_samples(DepthImage(wall_m.astype(np.float32), Camera(192, 144, 170.0), "a"))
    assert np.sqrt(np.mean(samples["noise 1-2 m, mm"] ** 2)) == pytest.approx(4, rel=0.05)
    assert not any(len(samples[f"noise {bounds} m, mm"]) for bounds in ("0.4-1", "2-3", "3-5"))
    assert samples["holes, %"] == 0 and len(samples["size of holes, px"]) == 0


def _frames(draw: Draw, count: int, name: str) -> list[DepthImage]:
    camera = Camera(131, 67, 90.0)
    rngs = [np.random.default_rng([i, *name.encode()]) for i in range(count)]
    return [DepthImage(draw(rng), camera, f"{name}{i}") for i, rng in enumerate(rngs)]


def _scattered(rng: np.random.Generator, depth_m: float = 12.0) -> np.ndarray:
    return np.where(rng.random((67, 131)) < 0.1, depth_m * rng.uniform(0.9, 1.1, (67, 131)), 0).astype(np.float32)


def _combed(rng: np.random.Generator) -> np.ndarray:
    depth_m = np.zeros((67, 131), np.float32)
    depth_m[rng.integers(4) :: 5, ::2] = 12.0
    return depth_m


def _auc(first: list[DepthImage], second: list[DepthImage], channels: str) -> float:
    patches = classifier.cut_patches(first, 0, channels), classifier.cut_patches(second, 1, channels)
    return classifier.separability(*patches, seed=0, steps=45)


def test_the_classifier_has_a_few_hundred_parameters() -> None:
    assert 200 <= sum(p.numel() for p in classifier.small_network().parameters()) <= 900


def test_frames_of_one_distribution_are_not_told_apart() -> None:
    auc = _auc(_frames(_scattered, 6, "a"), _frames(_scattered, 6, "b"), "validity and depth")
    assert auc == pytest.approx(0.5, abs=0.15)


def test_another_pattern_and_another_depth_are_told_apart_by_who_sees_them() -> None:
    scattered, combed = _frames(_scattered, 6, "a"), _frames(_combed, 6, "b")
    far = _frames(lambda rng: _scattered(rng, 30.0), 6, "c")
    assert _auc(scattered, combed, "validity only") > 0.95
    assert _auc(scattered, far, "depth only") > 0.95
    assert _auc(scattered, far, "validity only") == pytest.approx(0.5, abs=0.15)


def test_a_tenth_dropped_is_a_tenth_and_the_same_for_a_seed() -> None:
    frame = DepthImage(np.full((97, 211), 7.0, np.float32), CAMERA, "a")
    spoilt = classifier.drop_a_tenth(frame, 3).depth_m
    assert (spoilt == 0).mean() == pytest.approx(0.1, abs=0.01) and set(np.unique(spoilt)) == {0, 7}
    np.testing.assert_array_equal(spoilt, classifier.drop_a_tenth(frame, 3).depth_m)


def test_a_folder_without_real_frames_is_one_sentence(tmp_path: Path) -> None:
    script = Path(__file__).parents[2] / "benchmarks/realism.py"
    paths = os.pathsep.join([str(script.parent), str(script.parents[1])])
    found = subprocess.run(
        [sys.executable, str(script), "--out", str(tmp_path / "out")],
        env=os.environ | {"DEPTHREG_REAL_DATA": str(tmp_path), "PYTHONPATH": paths},
        text=True,
        capture_output=True,
    )
    assert found.returncode == 2 and not (tmp_path / "out").exists()
    assert found.stderr.splitlines()[-1].startswith(f"realism.py: error: no real frames in {tmp_path}")


def test_filling_hides_where_the_returns_were() -> None:
    patches = classifier.cut_patches(_frames(_scattered, 2, "a"), 0, "depth only").inputs
    assert (patches[:, 0] == 0).all()
    torch.testing.assert_close(patches[:, 1].abs().clamp(min=0.11), torch.full_like(patches[:, 1], 0.11))


def test_pictures_put_real_above_simulated() -> None:
    depths = [np.where(_sparse(k), 10.0, 0) for k in range(2)]
    picture = pictures.side_by_side(depths, depths, size=(60, 100), max_m=80.0)
    assert picture.shape == (2 * (60 + 24), 200, 3)
    samples = [lidar_samples(DepthImage(d.astype(np.float32), CAMERA, "a")) for d in depths]
    histograms = pictures.draw_histograms(samples, samples, size=(40, 90))
    assert histograms.shape == (3 * 64, 360, 3)


def test_real_frames_come_with_their_own_cameras(real_data: Path) -> None:
    frames = real_lidar_frames(real_data)
    assert len(frames) == 30 and len({frame.group for frame in frames}) == 18
    for frame in frames:
        assert frame.depth_m.shape == (frame.camera.height, frame.camera.width)
        assert 700 < frame.camera.focal_px < 725
        assert 0.03 < (frame.depth_m > 0).mean() < 0.05
        assert frame.depth_m.max() < 80  # metres


def test_real_depth_cameras_report_metres(real_data: Path) -> None:
    counts = {kind.sensor: real_depth_frames(real_data, kind) for kind in DEPTH_CAMERAS}
    assert {sensor: len(frames) for sensor, frames in counts.items()} == {"kinect": 17, "active_stereo": 4, "tof": 1}
    for frame in (frame for frames in counts.values() for frame in frames):
        assert 0.4 < np.median(frame.depth_m[frame.depth_m > 0]) < 4
