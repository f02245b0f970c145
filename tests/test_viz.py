"""Oracles: geometry of scenes made here, colour order, and sizes that captions must not break."""

import numpy as np
import pytest
import torch

from depthreg import viz
from depthreg.geometry import identity_affine
from depthreg.networks import JointOutput

SIZE = (37, 53)


def _plane_m(slope: float = 0.02) -> np.ndarray:
    """A plane's depth, whose inverse is linear in the row: the ground, seen by a camera."""
    rows = np.arange(1, SIZE[0] + 1)[:, None]
    return np.broadcast_to(1 / (slope * rows), SIZE).astype(np.float32)


def test_near_is_warm_far_is_cold_and_none_is_grey():
    near, far, none = viz.colorize_depth(np.float32([[1, 50, 0]]), 1, 50)[0].astype(int)
    assert near[0] > near[2] and far[2] > far[0]
    assert len(set(none)) == 1


def test_depth_colours_are_equal_for_equal_ratios():
    a, b = (
        viz.colorize_depth(np.float32([[2, 8]]), 1, 16),
        viz.colorize_depth(np.float32([[20, 80]]), 10, 160),
    )
    np.testing.assert_array_equal(a, b)


def test_error_saturates_and_unknown_is_grey():
    half, full, beyond, unknown = viz.colorize_error(np.float32([[0.5, 1, 9, np.nan]]), 1)[0].astype(int)
    np.testing.assert_array_equal(full, beyond)
    assert (half != full).any() and len(set(unknown)) == 1


def test_limits_ignore_holes_and_outliers():
    depth_m = np.full(SIZE, 5, np.float32)
    depth_m[0, :2] = 0, 1e4
    low, high = viz.depth_limits_m(depth_m)
    assert low == 5 and 5 < high < 6


def test_limits_of_nothing_can_still_be_drawn():
    empty = np.zeros(SIZE, np.float32)
    assert viz.colorize_depth(empty, *viz.depth_limits_m(empty)).shape == (*SIZE, 3)


def test_dilation_puts_the_nearest_on_top_and_keeps_every_return():
    depth_m = np.zeros(SIZE, np.float32)
    depth_m[10, 10], depth_m[10, 13] = 2, 8
    grown = viz.dilate_depth(depth_m, 2)
    assert grown[10, 10] == 2 and grown[10, 13] == 8
    assert grown[10, 11] == grown[10, 12] == 2 and grown[10, 15] == 8 and grown[30, 30] == 0


def test_a_plane_has_no_edges_however_steep():
    assert not viz.depth_edges(_plane_m()).any()


def test_the_outline_of_a_nearer_thing_is_drawn_on_its_own_side():
    depth_m = np.full(SIZE, 10, np.float32)
    depth_m[12:25, 20:40] = 5
    edges = viz.depth_edges(depth_m)
    assert edges[12, 20:40].all() and edges[12:25, 20].all()
    assert not edges[depth_m == 10].any()
    assert not edges[14:23, 22:38].any()


def test_holes_are_no_edges():
    depth_m = np.full(SIZE, 10, np.float32)
    depth_m[12:25, 20:40] = 0
    assert not viz.depth_edges(depth_m).any()


def test_overlays_keep_the_colour_elsewhere():
    rgb = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    depth_m = np.full(SIZE, 10, np.float32)
    depth_m[12:25, 20:40] = 5
    changed = (viz.edges_overlay(rgb, depth_m) != rgb).any(axis=-1)
    assert changed.any() and not (changed & ~viz.depth_edges(depth_m)).any()
    one = np.zeros(SIZE, np.float32)
    one[18, 26] = 4
    dark = (viz.overlay_points(rgb, one) == rgb // 2).all(axis=-1)
    assert not dark[18, 26] and dark[:15].all()


def test_the_colour_bar_runs_from_near_to_far_beside_the_depth():
    depth_m = np.full((120, 40), 3, np.float32)
    picture = viz.depth_with_bar(depth_m, 1, 9)
    assert picture.shape[0] == 120
    column = picture[:, 40 + 4 + 2]
    np.testing.assert_array_equal(column[[0, -1]], viz.colorize_depth(np.float32([[1], [9]]), 1, 9)[:, 0])
    # The middle of a logarithmic scale is the geometric mean.
    assert np.abs(column[60].astype(int) - picture[60, 0].astype(int)).max() < 12


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_a_panel_holds_every_tile_unscaled(columns):
    sizes = [(37, 53), (20, 90), (64, 31), (5, 5), (40, 40)]
    colors = [np.uint8([50 * i + 20, 3, 7]) for i in range(len(sizes))]
    tiles = [(f"tile {i}", np.broadcast_to(c, (*s, 3))) for i, (s, c) in enumerate(zip(sizes, colors, strict=True))]
    picture = viz.panel(tiles, columns)
    assert picture.dtype == np.uint8
    for size, color in zip(sizes, colors, strict=True):
        rows, cols = np.nonzero((picture == color).all(axis=-1))
        assert len(rows) == size[0] * size[1]
        assert (np.ptp(rows) + 1, np.ptp(cols) + 1) == size


def test_a_caption_wider_than_its_picture_is_not_cut():
    def ink_px(image_width: int) -> int:
        picture = viz.panel([("a caption that is long", np.zeros((4, image_width, 3), np.uint8))])
        return int((picture.max(axis=-1) > 100).sum())

    assert ink_px(8) == ink_px(400) > 0


@pytest.mark.parametrize("size", [(96, 320), (75, 101), (375, 1242)])
@pytest.mark.parametrize("with_truth", [False, True])
def test_a_sample_panel_is_wide_enough_to_read(size, with_truth):
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(2, 3, *size, generator=generator)
    truth_m = torch.full((2, 1, *size), 20.0)
    sparse_m = truth_m * (torch.rand(truth_m.shape, generator=generator) < 0.05)
    output = JointOutput(truth_m + 1, rgb, identity_affine(2), [], torch.ones(2), truth_m)
    picture = viz.sample_panel(rgb, sparse_m, output, truth_m if with_truth else None, index=1)
    assert picture.dtype == np.uint8 and 800 < picture.shape[1] < 1700
    plain = viz.sample_panel(rgb, sparse_m, output, None, index=1)
    assert (picture.shape[0] > plain.shape[0]) == with_truth
