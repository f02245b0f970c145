"""Oracles: networks that answer the truth, or as IP-Basic does; figures worked out by hand."""

import json
import math

import bars
import numpy as np
import pytest
import torch
from judging import classical, colour, depth, readers, registration, second_camera, table
from judging.readers import measurement, on_grid
from judging.table import Row, ratio_row

from depthreg.baselines import ecc, ip_basic
from depthreg.evaluation.curves import UNREGISTERED
from depthreg.networks import JointOutput
from depthreg.report import OURS

SIZE = (101, 135)
SHIFT_PX = 60.0  # for 1242 px of width, so about 7 px here


def quietly(items, doing):
    return items


def make_frame(seed=0, share=0.1):
    rng = np.random.default_rng(seed)
    truth_m = np.broadcast_to(np.linspace(40, 5, SIZE[0], dtype=np.float32)[:, None], SIZE).copy()
    truth_m[30:50, 40:70] = 4.0
    rgb = rng.integers(0, 255, (*SIZE, 3)).astype(np.uint8)
    intrinsics = np.array([[80.0, 0, 67], [0, 80.0, 50], [0, 0, 1]])
    return measurement(f"frame {seed}", rgb, truth_m * (rng.random(SIZE) < share), truth_m, intrinsics)


class Answers(torch.nn.Module):
    """Answers what functions of its inputs say."""

    def __init__(self, depth=None, affine=None):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.depth, self.affine = depth or as_ip_basic, affine

    def forward(self, rgb, depth_m, register=True):
        affine = self.affine(rgb) if self.affine and register else torch.eye(2, 3)[None]
        return JointOutput(self.depth(depth_m), rgb, affine, [], torch.ones(1), torch.full_like(depth_m, torch.nan))


def as_ip_basic(depth_m):
    return torch.from_numpy(ip_basic(depth_m[0, 0].numpy()))[None, None]


def test_the_truth_has_ratio_nought_and_ip_basic_has_ratio_one():
    frame = make_frame()
    for answer, ratio in ((lambda _: frame["truth_depth_m"], 0.0), (as_ip_basic, 1.0)):
        scores = depth.score(Answers(answer), {name: [frame] for name in readers.KITTI_SETS}, quietly, "")
        rows = [row for row in depth.kitti_rows(scores, dict.fromkeys(scores, 1)) if row.bar]
        assert len(rows) == 4 * 3
        assert {row.value for row in rows} == {ratio}
        assert {row.met for row in rows} == {"aim" if ratio == 0 else "no"}


def test_rooms_are_compared_with_the_best_of_all_three_baselines():
    frame = make_frame()
    (row,) = depth.room_rows(depth.score(Answers(as_ip_basic), {"a room": [frame]}, quietly, ""), {"a room": 1})
    assert row.ours == row.rivals["IP-Basic"]
    assert row.value == max(row.ours / value for value in row.rivals.values()) >= 1


def test_a_registration_that_is_right_has_no_error_and_one_that_does_nothing_has_the_identitys():
    samples = registration.known_affines([make_frame(k) for k in range(2)], SHIFT_PX, registration.LARGE, draws=2)
    truth = {sample["rgb"].sum().item(): sample["truth_affine_rgb_from_depth"] for sample in samples}
    right = registration.measure(
        Answers(affine=lambda rgb: truth[rgb.sum().item()]), samples, quietly, "", {"ECC": ecc}, compared=1
    )
    assert right.px[OURS] == [0.0] * 4 and len(right.px["ECC"]) == 1
    median, share = registration.rows_of(right, "here", 2.5, 1.0, "")
    assert (median.value, share.value, median.met, share.met) == (0.0, 1.0, "aim", "aim")
    assert registration.beside_classical(right, "here", 1).value == 0
    idle = registration.measure(Answers(), samples, quietly, "", {})
    assert idle.px[OURS] == idle.px["identity"]
    width_px = samples[0]["rgb"].shape[-1]
    assert 0.4 * SHIFT_PX < np.median(idle.px["identity"]) * 1242 / SIZE[1] < SHIFT_PX and width_px < SIZE[1]


def test_answers_that_follow_the_affine_are_consistent_though_the_frame_was_off_before():
    frames = [make_frame(k) for k in range(2)]
    samples = registration.known_affines(frames, SHIFT_PX, registration.LARGE, draws=2)
    off = torch.tensor([[[1.0, 0.0, 3.0], [0.0, 1.0, 4.0]]])
    answers = {frame["rgb"].sum().item(): off for frame in frames}
    for sample in samples:
        truth = sample["truth_affine_rgb_from_depth"]
        shift = truth[..., :2] @ off[..., 2:] + truth[..., 2:]  # of A(p + off)
        answers[sample["rgb"].sum().item()] = torch.cat([truth[..., :2], shift], dim=-1)
    network = Answers(affine=lambda rgb: answers[rgb.sum().item()])
    errors = registration.measure(network, samples, quietly, "", {}, untouched=frames)
    assert registration.consistency(errors, "here", "").value == pytest.approx(0, abs=1e-3)
    assert registration.rows_of(errors, "here", 2.5, 1.0, "")[0].value == pytest.approx(5, rel=0.1)


def test_every_draw_is_another_affine_and_the_same_each_time():
    frames = [make_frame(0)]
    first, again = (registration.known_affines(frames, SHIFT_PX, registration.ANY, draws=3) for _ in range(2))
    affines = torch.cat([sample["truth_affine_rgb_from_depth"] for sample in first])
    torch.testing.assert_close(affines, torch.cat([sample["truth_affine_rgb_from_depth"] for sample in again]))
    assert len(affines.unique(dim=0)) == 3


def test_held_out_returns_and_the_others_are_all_of_them():
    frame = make_frame()
    held, what = depth.hold_out(frame, 0.27)
    assert what == "returns"  # those of this frame stand anywhere
    assert not (held["depth_m"] * held["truth_depth_m"]).any()
    torch.testing.assert_close(held["depth_m"] + held["truth_depth_m"], frame["depth_m"])


def test_the_rise_is_over_aligned_colour_in_per_cent():
    pooled = {
        ("misalignment", shift, "rmse_m", method): value
        for method, values in ((OURS, (2.0, 2.1, 2.2)), (UNREGISTERED, (2.0, 3.0, 4.0)))
        for shift, value in zip((0.0, 12.0, 24.0), values, strict=True)
    }
    mean, half, whole = depth.rise_rows(pooled, "")
    assert mean.value == pytest.approx(5) and mean.rivals[UNREGISTERED] == pytest.approx(50)
    assert half.value == pytest.approx(5) and whole.value == pytest.approx(10)


@pytest.fixture
def pair():
    """Depth whose colour lies 3 px to the right and 2 px below, judged by the colour as it should be."""
    rng = np.random.default_rng(0)
    smooth = torch.nn.functional.interpolate(torch.from_numpy(rng.random((1, 1, 12, 16))), (104, 138), mode="bicubic")
    whole = (255 * smooth[0, 0].clamp(0, 1).numpy()).astype(np.uint8)
    frame = make_frame()
    seen = np.zeros(SIZE, np.uint8)
    seen[2:, 3:] = whole[: SIZE[0] - 2, : SIZE[1] - 3]
    sample = measurement("pair", np.stack([seen] * 3, axis=-1), frame["depth_m"][0, 0].numpy())
    row, column = np.nonzero(frame["depth_m"][0, 0].numpy())
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1).astype(float)
    judge = whole[: SIZE[0], : SIZE[1]].astype(np.float32)
    return second_camera.Pair(sample, pixels, pixels[:, :2] + [3, 2], judge)


def test_a_second_camera_judges_by_place_and_by_likeness(pair):
    shifted = torch.tensor([[[1.0, 0, 3], [0, 1, 2]]])
    (found,) = second_camera.measure(Answers(affine=lambda rgb: shifted), [pair], quietly, "")
    assert found[OURS][0] == pytest.approx(0, abs=1e-6) and found[OURS][1] == pytest.approx(1, abs=1e-3)
    assert found["identity"][0] == pytest.approx(math.sqrt(13)) and found["identity"][1] < 0.99
    np.testing.assert_allclose(second_camera.fitted(pair), shifted[0], atol=1e-9)
    assert [row.met for row in second_camera.rows([found], "pair", "likeness")] == ["aim", "aim"]
    (idle,) = second_camera.measure(Answers(), [pair], quietly, "")
    assert [row.value for row in second_camera.rows([idle], "pair", "likeness")] == [0, 0]


def test_trust_is_right_where_it_tells_own_from_foreign_colour():
    said = [{colour.OWN: (1.0, 0.9), colour.OTHER: (2.0, 0.7), colour.NONE: (4.0, 0.1)}]
    harm, trust = colour.rows(said)
    assert harm.value == 0.5 and harm.met == "aim"
    assert trust.value == 0.5 and trust.met == "no"


def test_colour_of_another_frame_is_brought_to_this_frames_size():
    own, other = make_frame(0), measurement("other", np.full((37, 53, 3), 51, np.uint8), np.ones((37, 53)))
    shown = colour.colours(own, other)
    assert {tuple(rgb.shape) for rgb in shown.values()} == {(1, 3, *SIZE)}
    np.testing.assert_allclose(shown[colour.OTHER], 0.2, rtol=1e-5)
    assert not shown[colour.NONE].any()


def test_phase_correlation_finds_a_shift(pair):
    rgb = np.random.default_rng(0).integers(0, 255, (64, 80, 3)).astype(np.uint8)
    rgb = np.repeat(np.repeat(rgb[:16, :20], 4, axis=0), 4, axis=1)
    depth_m = np.exp(rgb.mean(axis=-1) / 100).astype(np.float32)
    moved = np.roll(rgb, (3, 5), axis=(0, 1))
    affine = classical.phase_correlation(moved, depth_m)
    np.testing.assert_allclose(affine, [[1, 0, 5], [0, 1, 3]], atol=0.5)


def test_small_pixels_lie_in_the_middle_of_those_that_they_cover():
    sparse_m = on_grid(np.array([[1.0, 2.0], [3.0, 4.0]]), (6, 6))
    assert sparse_m[1, 1] == 1 and sparse_m[1, 4] == 2 and sparse_m[4, 1] == 3 and sparse_m[4, 4] == 4
    assert (sparse_m > 0).sum() == 4


def test_a_row_says_whether_its_bar_is_met_and_the_files_hold_every_row(tmp_path):
    rows = [
        ratio_row("depth", "RMSE", 0.8, {"a": 1.0, "b": 2.0}, 0.85, 0.7, "3 frames"),
        ratio_row("depth", "RMSE", 1.0, {"a": 0.0}, 0.85),
        Row("registration", "share", 0.96, value=0.96, bar=0.7, aim=0.95, most=False),
        Row("cost", "time", math.nan, bar=8.0, aim=3.0),
        Row("others", "RMSE", 1.0),
    ]
    assert [row.met for row in rows] == ["yes", "no", "aim", "unknown", ""]
    assert rows[0].value == 0.8
    bars.write(rows, tmp_path / "new/bars.json", weights="w")
    written = json.loads((tmp_path / "new/bars.json").read_text())
    assert [row["met"] for row in written["rows"]] == [row.met for row in rows]
    assert written["rows"][1]["value"] is None and written["weights"] == "w"
    assert (
        "| depth | RMSE | 0.8 | a 1, b 2 | 0.8 | <= 0.85 | <= 0.7 | yes | 3 frames |"
        in (tmp_path / "new/bars.md").read_text()
    )
    table.print_table(rows)
