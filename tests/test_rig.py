"""Series of known affines, constant or drifting, with noise and with frames that are wrong."""

import numpy as np
import pytest
import torch

from depthreg.rig import FrameAffine, parameters_of, summarize_rig
from depthreg.rig_page import describe, rig_figure, write_page

SIZE = (375, 1242)  # height, width
CENTRE = np.array([(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2])


def _affine(x_px: float, y_px: float, rotation_deg: float, scale_percent: float) -> np.ndarray:
    """A turn and a scaling about the image's centre, and a shift."""
    angle, scale = np.deg2rad(rotation_deg), 1 + scale_percent / 100
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([linear, CENTRE + np.array([x_px, y_px]) - linear @ CENTRE])


def _frames(count: int, drift_px: float = 0, outliers: int = 0, noise: float = 1, seed: int = 0) -> list[FrameAffine]:
    """(4, -3) px, 0.5 deg, 1 % on average; every one with noise, some wrong by 30 px and not trusted."""
    rng = np.random.default_rng(seed)
    frames = []
    for number in range(count):
        x_px, y_px, rotation_deg, scale_percent = noise * rng.normal(size=4) * (0.5, 0.4, 0.05, 0.1)
        x_px += drift_px * (number / (count - 1) - 0.5)
        wrong = number % 7 == 3 and number // 7 < outliers
        affine = _affine(4 + x_px + 30 * wrong, y_px - 3, 0.5 + rotation_deg, 1 + scale_percent)
        frames.append(FrameAffine(f"{number:03d}", 100 + 0.1 * number, affine, 0.1 if wrong else 0.9))
    return frames


def test_a_constant_misalignment_with_noise_is_a_mounting_error_of_the_known_size():
    rig = summarize_rig(_frames(80), SIZE)
    assert (rig.verdict, rig.frames, rig.frames_used) == ("constant", 80, 80)
    assert rig.duration == pytest.approx(7.9)
    for (name, expected), scatter in zip(
        {"x_px": 4, "y_px": -3, "rotation_deg": 0.5, "scale_percent": 1}.items(), (0.5, 0.4, 0.05, 0.1), strict=True
    ):
        trend = rig.parameters[name]
        assert abs(trend.median - expected) < 0.5 * scatter and not trend.drifts
        assert 0.7 * scatter < trend.scatter < 1.3 * scatter
    np.testing.assert_allclose(rig.affine_rgb_from_depth, _affine(4, -3, 0.5, 1), atol=0.5)


def test_without_noise_the_summary_is_exact():
    rig = summarize_rig(_frames(12, noise=0), SIZE)
    np.testing.assert_allclose(rig.affine_rgb_from_depth, _affine(4, -3, 0.5, 1), atol=1e-9)
    assert rig.verdict == "constant" and rig.parameters["x_px"].median == pytest.approx(4)
    corners = np.array([[x, y] for x in (0, SIZE[1] - 1) for y in (0, SIZE[0] - 1)]) - CENTRE
    moved = corners @ (_affine(4, -3, 0.5, 1)[:, :2].T - np.eye(2)) + [4, -3]
    assert rig.corner_px == pytest.approx(np.linalg.norm(moved, axis=1).mean())


def test_a_drift_of_one_parameter_is_found_measured_and_named():
    rig = summarize_rig(_frames(80, drift_px=3), SIZE)
    assert rig.verdict == "drifts"
    assert [name for name, trend in rig.parameters.items() if trend.drifts] == ["x_px"]
    assert rig.parameters["x_px"].change == pytest.approx(3, abs=0.6)
    assert rig.parameters["x_px"].scatter == pytest.approx(0.5, rel=0.3)  # about the trend, not about the median
    *_, verdict = describe(rig, "s")
    assert verdict.startswith("drifts over 7.9 s: x by +") and "rotation" not in verdict


def test_a_drift_below_the_scatter_of_single_frames_doesnt_count():
    rig = summarize_rig(_frames(1000, drift_px=0.4), SIZE)
    assert rig.parameters["x_px"].p_value < 1e-4 and rig.verdict == "constant"


@pytest.mark.parametrize("likeness", [0.0, 0.5, 0.8])
def test_noise_that_lingers_is_rarely_taken_for_a_drift(likeness):
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(20):
        noise = rng.normal(size=(150, 4))
        for number in range(1, 150):  # a first-order process
            noise[number] = likeness * noise[number - 1] + (1 - likeness**2) ** 0.5 * noise[number]
        frames = [FrameAffine(str(number), number, _affine(*row), 1) for number, row in enumerate(noise)]
        alarms += summarize_rig(frames, SIZE).verdict == "drifts"
    assert alarms <= 2


def test_frames_that_the_network_doesnt_trust_are_left_out():
    rig = summarize_rig(_frames(70, outliers=10), SIZE)
    assert (rig.frames, rig.frames_used) == (70, 60)
    assert rig.parameters["x_px"].scatter < 0.8
    assert rig.as_json()["min_trust"] == 0.5


@pytest.mark.parametrize("trust", [0.9, 0.2])
def test_few_frames_or_few_trusted_ones_give_a_median_but_no_verdict(trust):
    frames = [frame._replace(trust=trust) for frame in _frames(9 if trust > 0.5 else 40, drift_px=20)]
    rig = summarize_rig(frames, SIZE)
    assert rig.verdict == "too few frames" and abs(rig.parameters["y_px"].median + 3) < 0.5
    off, *_, verdict = describe(rig, "s")
    assert "too few to tell" in verdict
    assert ("trusts none of these frames" in off) == (trust < 0.5)
    assert summarize_rig(frames[:1], SIZE).verdict == "too few frames"


def test_the_order_of_the_frames_doesnt_matter():
    frames = _frames(40, drift_px=3)
    shuffled = [frames[number] for number in np.random.default_rng(0).permutation(40)]
    assert summarize_rig(shuffled, SIZE) == summarize_rig(frames, SIZE)


def test_words_give_pixels_degrees_and_percent():
    off, scatter, verdict = describe(summarize_rig(_frames(12, noise=0), SIZE), "frames")
    assert off.startswith("colour is off by (+4.0, -3.0) px, +0.50 deg, +1.00 %; the corners by")
    assert scatter.startswith("single frames scatter by (0.0, 0.0) px, 0.00 deg, 0.00 %")
    assert verdict == "constant over 12 frames, as a mounting error is, by 12 of 12 frames that the network trusts"


def test_less_than_a_pixel_is_well_aligned():
    frames = [FrameAffine(str(number), number, _affine(0.5, 0.5, 0, 0), 1) for number in range(10)]
    assert describe(summarize_rig(frames, SIZE), "s")[-1].startswith("constant over 9.0 s, well aligned, by 10 of 10")


def test_the_page_shows_every_frame_and_the_trend(tmp_path):
    frames = _frames(70, drift_px=4, outliers=10)
    rig = summarize_rig(frames, SIZE)
    points = [trace for trace in rig_figure(rig, frames, "s").data if trace.mode == "markers"]
    assert [len(trace.x) for trace in points] == [60, 10] * 4
    lines = [trace for trace in rig_figure(rig, frames, "s").data if trace.mode == "lines" and len(trace.x) == 2]
    assert lines[0].y[1] - lines[0].y[0] == pytest.approx(rig.parameters["x_px"].change)
    assert lines[1].y[0] == lines[1].y[1] == rig.parameters["y_px"].median
    write_page(tmp_path / "rig.html", rig, frames, "s")
    assert "rotation (deg)" in (tmp_path / "rig.html").read_text()


def test_parameters_are_those_that_an_affine_was_made_of():
    found = parameters_of(torch.tensor(_affine(1, 2, 3, 4))[None], SIZE)
    assert {name: round(float(value[0]), 9) for name, value in found.items()} == {
        "x_px": 1,
        "y_px": 2,
        "rotation_deg": 3,
        "scale_percent": 4,
    }
