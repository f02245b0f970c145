"""Stereo: walls and edges whose disparities, shadows and dots are known in closed form."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from depthreg.config import build, compose_config
from depthreg.data.sample import Frame, FrameBatch
from depthreg.data.synthetic import RandomCamera, SyntheticFrames, collate_frames
from depthreg.errors import InputError
from depthreg.rendering.scan import no_returns
from depthreg.sensors import CameraPair, Projector, SemiGlobal, SensorSimulator, Stereo, StereoMatcher
from depthreg.sensors.matching import misaligned, reflections
from depthreg.sensors.projector import dot_tile, from_left, lit
from depthreg.worlds import HouseholdWorld

MakeFrames = Callable[..., FrameBatch]
FOCAL_PX, BASELINE_M = 200.0, 0.1  # so a disparity of 1 px is 20 m
PERFECT = CameraPair(0, 0, 0, 0, 0, 0)
SIZE = 75, 337
AREA = slice(8, -8), slice(56, -24)  # away from the borders and the blind band


def texture(shift_px: float = 0.0, rows_px: float = 0.0) -> np.ndarray:
    """A sum of waves 5 to 20 px long, moved to the left by `shift_px`: the closed form of a moved image."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    x, y = x + shift_px, y + rows_px
    angle, length, phase = rng.uniform(0, 2 * np.pi, 60), rng.uniform(5, 20, 60), rng.uniform(0, 2 * np.pi, 60)
    waves = [
        np.sin(2 * np.pi / k * (x * np.cos(a) + y * np.sin(a)) + p)
        for a, k, p in zip(angle, length, phase, strict=True)
    ]
    return np.rint(128 + 12 * np.sum(waves, axis=0)).clip(0, 255).astype(np.uint8)


def wall(disparity_px: float, *, blank: bool = False, albedo: float = 0.6, gloss: float = 0.0) -> Frame:
    """A frontal wall seen by two cameras; blank or with a texture."""
    grey = [np.full(SIZE, 140, np.uint8)] * 2 if blank else [texture(), texture(disparity_px)]
    left, right = (np.repeat(image[..., None], 3, axis=2) for image in grey)
    depth_m = np.full(SIZE, FOCAL_PX * BASELINE_M / disparity_px, np.float32)
    center = (SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2
    return Frame(
        rgb=left,
        margin_px=0,
        depth_m=depth_m,
        object_id=np.zeros(SIZE, np.int32),
        normal=np.broadcast_to(np.array([0, 0, -1], np.float32), (*SIZE, 3)),
        albedo=np.full(SIZE, albedo, np.float32),
        gloss=np.full(SIZE, gloss, np.float32),
        intrinsics=np.array([[FOCAL_PX, 0, center[0]], [0, FOCAL_PX, center[1]], [0, 0, 1]], np.float32),
        rgb_right=right,
        depth_right_m=depth_m,
        baseline_m=BASELINE_M,
        lidar=no_returns(),
    )


def match(frame: Frame, matcher: StereoMatcher, seed: int = 0) -> np.ndarray:
    return matcher(frame, np.random.default_rng(seed))


def found_share(found_px: np.ndarray, disparity_px: float = 10.0) -> float:
    """How much of the wall has the right disparity, give or take 1 px."""
    return float((np.abs(found_px[AREA] - disparity_px) < 1).mean())


@pytest.mark.parametrize("disparity_px", [12.0, 9.25, 5.5])
def test_a_moved_texture_has_the_disparity_that_it_was_moved_by(disparity_px: float) -> None:
    found_px = match(wall(disparity_px), StereoMatcher(PERFECT))[AREA]
    assert (found_px > 0).mean() > 0.98
    # Block matching leans towards whole pixels (Shimizu and Okutomi 2001), and OpenCV's by up to a quarter.
    lean_px = 0.0 if disparity_px == 12 else 0.25
    assert abs(np.median(found_px[found_px > 0]) - disparity_px) <= 1 / 16 + lean_px
    assert np.quantile(np.abs(found_px[found_px > 0] - disparity_px), 0.9) < 0.1 + lean_px


def test_a_walls_depth_is_right_within_the_step_of_the_disparity() -> None:
    disparity_px = 8.0
    depth_m = FOCAL_PX * BASELINE_M / disparity_px
    found_px = match(wall(disparity_px), StereoMatcher(PERFECT))[AREA]
    found_m = FOCAL_PX * BASELINE_M / found_px[found_px > 0]
    assert np.abs(found_m - depth_m).mean() < depth_m**2 / (FOCAL_PX * BASELINE_M) / 16


def test_disparities_come_in_sixteenths() -> None:
    found_px = match(wall(20.0), StereoMatcher())
    assert found_px.dtype == np.float32 and found_px.shape == SIZE
    assert np.array_equal(found_px * 16, np.round(found_px * 16))
    assert len(np.unique(found_px)) > 5


def test_what_the_right_camera_cannot_see_is_not_matched_and_what_is_beside_it_is() -> None:
    found_px = match(wall(20.0), StereoMatcher(PERFECT))[8:-8]
    assert not found_px[:, :19].any()
    assert (found_px[:, 24:44] > 0).mean() > 0.95  # which OpenCV by itself leaves out


def test_a_real_pair_agrees_with_structured_light(real_data: Path) -> None:
    folder = real_data / "middlebury" / "motorcycle"
    left, right = (cv2.imread(str(folder / f"motorcycle_{s}.png"), cv2.IMREAD_GRAYSCALE) for s in ("left", "right"))
    with np.load(folder / "motorcycle_disp.npz") as arrays:
        truth_px = np.nan_to_num(arrays[arrays.files[0]], posinf=0)
    found_px = SemiGlobal()(left, right, 80)
    seen = (truth_px > 0) & (found_px > 0)
    assert seen.sum() / (truth_px > 0).sum() > 0.85
    assert (np.abs(found_px - truth_px)[seen] > 1).mean() < 0.1


@pytest.mark.parametrize(("disparity_px", "search_px"), [(3.0, 32), (30.9, 32), (31.1, 48), (500.0, 96)])
def test_the_search_reaches_the_nearest_thing_within_its_limit(disparity_px: float, search_px: int) -> None:
    assert SemiGlobal(min_search_px=20, max_search_share=0.3).search_px(np.full(SIZE, disparity_px)) == search_px


def test_a_blank_wall_is_lost_without_a_projector_and_found_with_one() -> None:
    frame = wall(10.0, blank=True)
    passive_px, active_px = match(frame, StereoMatcher()), match(frame, StereoMatcher(projector=Projector()))
    assert (passive_px[AREA] > 0).mean() < 0.4  # what noise matches by chance
    assert found_share(passive_px) < 0.1 and found_share(active_px) > 0.95
    assert abs(np.median(active_px[AREA]) - 10) < 0.3


def test_sunshine_washes_the_dots_out() -> None:
    projectors = [Projector(ambient=(ambient, ambient)) for ambient in (0.1, 3.0, 30.0)]
    shares = [found_share(match(wall(10.0, blank=True), StereoMatcher(projector=one))) for one in projectors]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.95 and shares[-1] < 0.1


def test_a_mirror_throws_the_dots_away() -> None:
    matcher = StereoMatcher(CameraPair(reflection=0), projector=Projector())
    dull, mirror = (found_share(match(wall(10.0, blank=True, gloss=gloss), matcher)) for gloss in (0.0, 1.0))
    assert dull > 0.95 and mirror < 0.1


def test_a_polished_wall_is_found_where_its_mirror_image_is() -> None:
    found_px = match(wall(20.0, blank=True, gloss=1.0), StereoMatcher())[AREA]
    seen_px = found_px[found_px > 0]
    assert (found_px > 0).mean() > 0.3 and 0.3 * 20 - 1 <= np.median(seen_px) <= 0.8 * 20 + 1


def test_stripes_are_lost_or_mistaken_for_others() -> None:
    stripes = np.rint(128 + 60 * np.sin(2 * np.pi / 8 * np.arange(SIZE[1] + 10))).astype(np.uint8)
    left, right = (np.tile(stripes[start:][None, : SIZE[1], None], (SIZE[0], 1, 3)) for start in (0, 10))
    found_px = match(replace(wall(10.0), rgb=left, rgb_right=right), StereoMatcher())
    periods = (found_px[AREA][found_px[AREA] > 0] - 10) / 8
    assert found_share(found_px) < 0.5 and np.abs(periods - periods.round()).max(initial=0) < 0.1
    assert found_share(match(wall(10.0), StereoMatcher())) > 0.9


def box_before_a_wall(*, blank: bool = False) -> Frame:
    """A textured box at columns 150 to 209, 22 px of disparity, before a wall, 6 px."""
    box_px, frame, rows = 22, wall(6.0, blank=blank), slice(15, 60)
    left, right, depth_m = frame.rgb.copy(), frame.rgb_right.copy(), frame.depth_m.copy()
    left[rows, 150:210] = right[rows, 150 - box_px : 210 - box_px] = np.repeat(
        texture()[rows, 250:310, None], 3, axis=2
    )
    depth_m[rows, 150:210] = FOCAL_PX * BASELINE_M / box_px
    return replace(frame, rgb=left, rgb_right=right, depth_m=depth_m)


def test_nothing_is_found_where_the_right_camera_sees_the_box() -> None:
    checked = SemiGlobal(uniqueness_percent=0, speckle_px=0)  # nothing but the left-right check refuses an answer
    found_px = match(box_before_a_wall(), StereoMatcher(PERFECT, checked))[20:55]
    hidden = found_px[:, 150 - 16 + 4 : 150 - 4]
    assert (hidden == 0).mean() > 0.5 and (np.abs(hidden - 6) < 1).mean() < 0.1
    assert (np.abs(found_px[:, 155:205] - 22) < 1).mean() > 0.9 < (np.abs(found_px[:, 225:300] - 6) < 1).mean()


def test_the_foreground_grows_over_its_edges_onto_what_has_no_texture() -> None:
    found_px = match(box_before_a_wall(blank=True), StereoMatcher())[20:55]
    assert (np.abs(found_px[:, 210:212] - 22) < 1).mean() > 0.5


def test_no_dots_fall_into_a_shadow() -> None:
    frame = box_before_a_wall()
    dots = Projector(dot_size=1.0).dots(frame, frame.depth_m, BASELINE_M, np.zeros(2))[20:55]
    assert not dots[:, 150 - 15 : 150 - 1].any() and (dots[:, 100:130] > 0).all()


def test_depth_noise_grows_with_the_square_of_the_depth() -> None:
    cameras = CameraPair(shot_noise=1e-3, exposure_spread=0, rectification_px=0, blur_px=0)
    spreads_m = []
    for disparity_px in (16.0, 8.0, 4.0):
        found_px = match(wall(disparity_px), StereoMatcher(cameras))[AREA]
        depth_m = FOCAL_PX * BASELINE_M / found_px[np.abs(found_px - disparity_px) < 1]
        spreads_m.append(depth_m.std())
    np.testing.assert_allclose(np.array(spreads_m[1:]) / spreads_m[:-1], 4, rtol=0.25)


def test_what_calibration_leaves_moves_the_right_image_by_so_much() -> None:
    image = texture().astype(np.float32)
    assert np.array_equal(misaligned(image, 0, 0, 0), image)
    error = misaligned(image, 0.4, -0.3, 0) - texture(-0.4, 0.3)
    assert np.abs(error)[AREA].mean() < 4  # of 255; linear interpolation smooths a little
    assert np.abs(image - texture(-0.4, 0.3))[AREA].mean() > 10
    turned = misaligned(np.tile(np.arange(SIZE[0], dtype=np.float32)[:, None], SIZE[1]), 0, 0, 2.0)
    slope = np.diff(turned[SIZE[0] // 2, 5:-5]).mean()
    assert abs(slope) == pytest.approx(2 * 2.0 / SIZE[1], rel=0.01)


def test_noise_is_the_light_that_it_is_made_of() -> None:
    cameras = CameraPair(shot_noise=4e-4, read_noise=0.01, exposure_spread=0, blur_px=0, rectification_px=0)
    for light in (0.2, 0.6):
        image = np.full((200, 200), light, np.float32)
        left, right = cameras(image, image, np.random.default_rng(1))
        measured = [(shot / 255.0) ** 2.2 for shot in (left, right)]
        for one in measured:
            assert one.mean() == pytest.approx(light, rel=0.01)
            assert one.std() == pytest.approx(np.sqrt(4e-4 * light + 0.01**2), rel=0.05)
        assert abs(np.corrcoef(measured[0].ravel(), measured[1].ravel())[0, 1]) < 0.02


def test_only_the_right_camera_is_misaligned_and_either_may_be_blurred() -> None:
    light = texture().astype(np.float32) / 255
    for cameras, changed in (
        (CameraPair(0, 0, 0, 0, 1.0, 0), [False, True]),
        (CameraPair(0, 0, 0, 3, 0, 0), [True] * 2),
    ):
        images, sharp = cameras(light, light, np.random.default_rng(2)), PERFECT(light, light, np.random.default_rng(2))
        assert [not np.array_equal(*pair) for pair in zip(images, sharp, strict=True)] == changed
    contrasts = [np.diff(image.astype(float), axis=1).std() for image in (images[0], sharp[0])]
    assert contrasts[0] < 0.8 * contrasts[1]


def test_reflections_lie_behind_the_mirror_at_a_smaller_disparity() -> None:
    left, right = reflections(wall(20.0, gloss=1.0), 1.0, np.random.default_rng(3))
    middle = slice(30, 130)
    at_px = np.arange(1, 21)
    differences = [np.abs(right[:, 30:130] - left[:, 30 + k : 130 + k]).mean() for k in at_px]
    assert 0.3 * 20 - 1 <= at_px[np.argmin(differences)] <= 0.8 * 20 + 1
    assert np.abs(left[:, middle]).max() <= 0.08 * 1.2 and np.abs(left).max() > 0.01  # Schlick's share, head-on


def test_both_cameras_see_a_dot_on_the_same_point_of_the_wall() -> None:
    frame, disparity_px = wall(12.0), 12
    projector, phase = Projector(position=0.3), np.array([0.2, 0.7])
    left = projector.dots(frame, frame.depth_m, 0.3 * BASELINE_M, phase)
    right = projector.dots(frame, frame.depth_right_m, -0.7 * BASELINE_M, phase)
    assert left.max() > 5 * left.mean() > 0
    # A point at column u in the left image is at u - disparity in the right one; only the range differs a little.
    np.testing.assert_allclose(left[:, disparity_px:], right[:, :-disparity_px], rtol=0.1, atol=2e-3 * left.max())


def test_dots_fade_with_the_squared_distance() -> None:
    peaks = [Projector(dot_size=0.3).dots(wall(d), wall(d).depth_m, 0.05, np.zeros(2)).max() for d in (20.0, 10.0)]
    assert peaks[0] / peaks[1] == pytest.approx(4, rel=0.1)


def test_exposure_is_set_by_the_light_until_it_is_too_dark() -> None:
    sky = replace(wall(12.0), depth_m=np.zeros(SIZE, np.float32), depth_right_m=np.zeros(SIZE, np.float32))
    light = texture().astype(np.float32) / 255
    for ambient, level in ((5.0, 0.4), (0.01, 0.4 / 2)):
        left, right = Projector(ambient=(ambient, ambient), darkest=0.02)(sky, light, light, np.random.default_rng(0))
        np.testing.assert_allclose(left, right)
        np.testing.assert_allclose(left / left.mean(), light / light.mean(), rtol=1e-5)  # no dots in the sky
        assert np.quantile(left, 0.9) == pytest.approx(
            level * (np.quantile(light, 0.9) / light.mean() if ambient < 1 else 1), rel=0.05
        )


def test_the_pattern_repeats_without_a_seam() -> None:
    tile = dot_tile(0.2)
    assert tile.min() >= 0 and 0.9 < tile.max() <= 1
    inside = np.abs(np.diff(tile, axis=1)).mean()
    assert np.abs(tile[:, 0] - tile[:, -1]).mean() == pytest.approx(inside, rel=0.3)


@pytest.mark.parametrize("side", [1, -1])
def test_a_shadow_is_as_wide_as_the_parallax_and_lies_away_from_the_projector(side: int) -> None:
    depth_m = np.full((5, 120), 4.0, np.float32)
    depth_m[:, 50:70] = 1.0
    shift_px = side * 16 / depth_m  # focal length * offset = 16 px m: 16 px on the box, 4 px on the wall
    dark = np.flatnonzero(~lit(depth_m, shift_px)[2])
    assert len(dark) == pytest.approx(16 - 4, abs=1)
    assert dark.max() < 50 if side > 0 else dark.min() >= 70


def test_no_light_leaks_through_a_slanted_wall() -> None:
    shift_px = np.full((3, 120), 4.0, np.float32)
    shift_px[:, 50:70] = np.linspace(36, 17, 20)  # the projector sees it twice as long as the camera does
    assert not lit(40 / shift_px, shift_px)[:, 20:50].any()


def test_nothing_is_lit_in_the_sky_and_all_of_a_slanted_wall_is() -> None:
    depth_m = np.tile(np.linspace(1, 3, 120, dtype=np.float32), (3, 1))
    depth_m[0] = 0
    reached = lit(depth_m, np.where(depth_m > 0, 20 / depth_m.clip(0.1), 0))
    assert not reached[0].any() and reached[1:].all()


def test_the_right_image_finds_its_points_in_the_left_one() -> None:
    column = np.tile(np.arange(SIZE[1], dtype=np.float32), (SIZE[0], 1))
    seen = from_left(column, wall(6.0))
    np.testing.assert_allclose(seen[:, :-7], column[:, :-7] + 6, atol=0.05)
    assert not seen[:, -6:].any()


def test_the_matched_answer_stands_at_difficulty_one(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=3)
    matched_px = frames["disparity_px"]
    depth_m = Stereo(max_range_m=20.0)(frames, 1.0, torch.Generator().manual_seed(0))
    expected_m = torch.where(matched_px > 0, 80 * 0.54 / matched_px.clamp(min=1e-6), 0)
    torch.testing.assert_close(depth_m, torch.where(expected_m <= 20, expected_m, 0), rtol=1e-6, atol=0)
    assert (expected_m > 20).any() and (matched_px == 0).any()


def test_disparity_errors_are_scaled_and_holes_grow_patch_by_patch(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=3)
    sensor = Stereo()
    truth_m, matched_px = frames["depth_m"], frames["disparity_px"]
    depths_m = [sensor(frames, d, torch.Generator().manual_seed(4)) for d in (0, 0.2, 0.5, 0.8, 1)]
    assert torch.equal(depths_m[0], truth_m)
    answered = matched_px > 0
    error_px = 43.2 / depths_m[2][answered] - 43.2 / truth_m[answered]
    torch.testing.assert_close(error_px, 0.5 * (matched_px - 43.2 / truth_m)[answered], rtol=1e-3, atol=1e-4)
    for easier, harder in itertools.pairwise(depths_m):
        holes = easier == 0
        assert (harder[holes] == 0).all() and (harder == 0).sum() > holes.sum()
    unanswered = depths_m[2][~answered]
    assert torch.equal(unanswered[unanswered > 0], truth_m[~answered][unanswered > 0])
    torn = (depths_m[2] == 0) & ~answered
    assert 0.2 < torn.sum() / (~answered).sum() < 0.8


def test_what_is_found_in_the_sky_comes_nearer_from_infinity(make_frames: MakeFrames) -> None:
    frames = make_frames()
    sky = FrameBatch(**{**frames, "depth_m": torch.zeros_like(frames["depth_m"])})
    for difficulty in (0.1, 0.5, 1.0):
        depth_m, found_m = Stereo(max_range_m=25.0)(sky, difficulty), 43.2 / (difficulty * frames["disparity_px"])
        expected_m = torch.where((found_m <= 25) & (43.2 / frames["disparity_px"] <= 25), found_m, 0)
        torch.testing.assert_close(depth_m, expected_m)


def test_frames_without_a_pair_are_refused(make_frames: MakeFrames) -> None:
    frames = make_frames()
    del frames["disparity_px"]
    with pytest.raises(InputError, match="disparity_px"):
        Stereo()(frames, 0.5)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Stereo(max_range_m=0),
        lambda: SemiGlobal(block_px=4),
        lambda: SemiGlobal(small_step=40),
        lambda: SemiGlobal(max_search_share=1.5),
        lambda: CameraPair(blur_px=-1),
        lambda: Projector(ambient=(0.5, 0.1)),
        lambda: Projector(dot_spacing_mrad=0),
    ],
)
def test_values_that_cannot_be_meant_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(InputError):
        make()


@pytest.mark.parametrize("name", ["stereo", "active_stereo"])
def test_a_configured_sensor_measures_rendered_rooms(name: str) -> None:
    sensor = build(compose_config("evaluate", ["checkpoint=x", f"sensor={name}"]).sensor)
    camera = RandomCamera(width=161, height=119, focal_px=(130.0, 140.0))
    frames = SyntheticFrames(HouseholdWorld(), camera, SensorSimulator(sensor).rig, seed=5, count=2, max_depth_m=12.0)
    batch = collate_frames([frames[0], frames[1]])
    again = collate_frames([frames[0], frames[1]])
    assert torch.equal(batch["disparity_px"], again["disparity_px"])
    measured = SensorSimulator(sensor)(batch, 1.0, torch.Generator().manual_seed(0))
    depth_m, truth_m = measured["depth_m"], measured["truth_depth_m"]
    seen = (depth_m > 0) & (truth_m > 0)
    assert depth_m.shape == (2, 1, 119, 161) and 0.3 < seen.float().mean() < 0.99
    error_px = (1 / depth_m[seen] - 1 / truth_m[seen]) * 135 * 0.075
    assert error_px.abs().median() < 0.5
