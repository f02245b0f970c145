"""Oracles: networks that answer the truth or a baseline, errors put in by hand, and the arithmetic of a mean."""

import csv
import math

import numpy as np
import pytest
import torch

from depthreg.baselines import ip_basic
from depthreg.evaluation.curve_page import curve_figure, label
from depthreg.evaluation.curves import IDENTITY, UNREGISTERED, CurveError, frame_errors, pool, write_csv
from depthreg.evaluation.settings import misalign
from depthreg.geometry import corner_errors_px, identity_affine
from depthreg.networks import JointOutput
from depthreg.report import OURS

SIZE = (101, 135)
SHIFT_PX = 60.0  # for 1242 px of width, so about 7 px here


def make_frame(share=0.1, size=SIZE):
    """A slope with a nearer square, and a share of its depth as returns."""
    height, width = size
    truth_m = torch.linspace(40, 5, height)[:, None].expand(height, width).clone()
    truth_m[height // 3 : height // 2, width // 3 : width // 2] = 4.0
    known = torch.rand(size, generator=torch.Generator().manual_seed(0)) < share
    rgb = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(1))
    return {"rgb": rgb, "depth_m": (truth_m * known)[None, None], "truth_depth_m": truth_m[None, None]}


class Answers(torch.nn.Module):
    """Completes by a function of the sparse depth; knows the affine unless it is told not to register."""

    def __init__(self, complete, affine=None):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.complete, self.affine, self.registered = complete, affine, []

    def forward(self, rgb, depth_m, register=True):
        self.registered.append(register)
        affine = self.affine if self.affine is not None and register else identity_affine(1)
        return JointOutput(
            self.complete(depth_m), rgb, affine, matches=[], trust=torch.ones(len(rgb)), log_error=0 * depth_m
        )


def crop_of(plane, depth_m):
    rows, columns = ((ours - asked) // 2 for ours, asked in zip(plane.shape[-2:], depth_m.shape[-2:], strict=True))
    return plane[..., rows : plane.shape[-2] - rows, columns : plane.shape[-1] - columns]


def values(errors, curve, metric, method):
    return {e.condition: e.value for e in pool(errors) if (e.curve, e.metric, e.method) == (curve, metric, method)}


def test_a_network_that_answers_the_truth_has_no_error_under_any_condition():
    frame = make_frame()
    network = Answers(lambda depth_m: crop_of(frame["truth_depth_m"], depth_m))
    errors = list(frame_errors(network, frame, SHIFT_PX))
    ours = [e for e in errors if e.method in (OURS, UNREGISTERED) and e.metric != "corner_error_px"]
    assert {e.curve for e in ours} == {"returns", "range", "gap", "misalignment"}
    assert all(e.value == 0 for e in ours)
    assert any(e.value > 0 for e in errors if e.method == "IP-Basic")


def test_a_network_that_answers_as_ip_basic_has_its_errors_exactly():
    def complete(depth_m):
        return torch.from_numpy(ip_basic(depth_m[0, 0].numpy()))[None, None]

    errors = list(frame_errors(Answers(complete), make_frame(), SHIFT_PX))
    for curve in ("returns", "range", "gap"):
        for metric in ("rmse_m", "mae_m"):
            theirs = values(errors, curve, metric, "IP-Basic")
            assert theirs and values(errors, curve, metric, OURS) == theirs


def test_the_identity_is_off_in_proportion_to_the_shift_and_every_second_run_does_not_register():
    frame = make_frame()
    network = Answers(lambda depth_m: crop_of(frame["truth_depth_m"], depth_m))
    errors = list(frame_errors(network, frame, SHIFT_PX))
    off_px = values(errors, "misalignment", "corner_error_px", IDENTITY)
    assert list(off_px) == [0, 7.5, 15, 30, 45, 60]
    np.testing.assert_allclose([off_px[x] / off_px[60] for x in off_px], [x / 60 for x in off_px], atol=1e-4)
    assert off_px == values(errors, "misalignment", "corner_error_px", OURS)
    assert network.registered[-12:] == [True, False] * 6


def test_the_worst_corner_moves_by_the_shift_that_was_asked_for():
    frame = make_frame()
    generator = torch.Generator().manual_seed(5)
    out = misalign(frame, SHIFT_PX, generator, corner_shift_px=30.0)
    size = out["rgb"].shape[-2:]
    shift_px = corner_errors_px(out["truth_affine_rgb_from_depth"], identity_affine(1), size).max()
    assert shift_px == pytest.approx(30.0 * SIZE[1] / 1242, rel=1e-4)


def test_errors_are_counted_where_they_are():
    frame = make_frame()
    truth_m = frame["truth_depth_m"]
    network = Answers(lambda depth_m: crop_of(truth_m + 2.0 * (truth_m >= 20), depth_m))
    by_range = values(frame_errors(network, frame, SHIFT_PX), "range", "rmse_m", OURS)
    assert by_range == {x: pytest.approx(2.0 * (x >= 20)) for x in (3.0, 5.0, 8.0, 12.0, 20.0, 30.0)}


def test_gaps_are_measured_from_the_nearest_return():
    frame = make_frame()
    frame["depth_m"] = torch.zeros(1, 1, *SIZE)
    frame["depth_m"][..., 50, 60] = 9.0
    errors = list(frame_errors(Answers(lambda depth_m: torch.full_like(depth_m, 9.0)), frame, SHIFT_PX))
    count = {e.condition: e.weight for e in pool(errors) if e[:4] == ("gap", e.condition, "mae_m", OURS)}
    assert count[0.0] == 1 and count[0.5] == 8  # itself, and all that touch it
    assert sum(count.values()) == SIZE[0] * SIZE[1]


def test_depth_without_truth_is_not_scored_and_a_small_frame_is_not_misaligned():
    network = Answers(lambda depth_m: torch.ones_like(depth_m))
    blind = {key: value for key, value in make_frame().items() if key != "truth_depth_m"}
    assert {e.metric for e in frame_errors(network, blind, SHIFT_PX)} == {"corner_error_px"}
    small = make_frame(size=(65, 71))
    assert {e.curve for e in frame_errors(network, small, SHIFT_PX)} == {"returns", "range", "gap"}


def test_frames_are_averaged_and_pixels_of_a_bin_are_pooled():
    frames = [CurveError("lines", 8, "rmse_m", OURS, value) for value in (1.0, 3.0)]
    bins = [CurveError("gap", 0, "rmse_m", OURS, value, pixels) for value, pixels in ((1.0, 3), (5.0, 1))]
    assert [(e.value, e.weight) for e in pool([*bins, *frames])] == [(2.0, 2.0), (pytest.approx(math.sqrt(7)), 4.0)]


def test_the_page_and_the_table_hold_every_number(tmp_path):
    errors = pool(frame_errors(Answers(lambda depth_m: torch.ones_like(depth_m)), make_frame(), SHIFT_PX))
    write_csv(errors, tmp_path / "curves.csv")
    rows = list(csv.DictReader((tmp_path / "curves.csv").open()))
    assert [float(row["value"]) for row in rows] == [error.value for error in errors]
    lines = curve_figure(errors, "title").data
    assert sorted(y for line in lines for y in line.y) == sorted(error.value for error in errors)
    assert label("range", 50.0) == "50 or more" and label("gap", 2.5) == "2.5 to 4.5" and label("lines", 8.0) == "8"
