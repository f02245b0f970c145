import numpy as np

from depthreg import viz
from depthreg.evaluation.worst import error_panel, grow


def test_known_values_grow_as_far_as_they_may_and_no_further():
    values = np.full((9, 11), np.nan)
    values[4, 5] = -3.0
    grown = grow(values, 2)
    assert (grown[~np.isnan(grown)] == -3.0).all()
    assert np.isnan(grown[4, 8]) and grown[4, 7] == -3.0 and np.isnan(grown[0, 0])
    assert np.isnan(grow(np.full((5, 5), np.nan))).all()


def test_too_near_is_blue_too_far_is_red_none_is_white_and_unknown_is_grey():
    near, right, far, beyond, unknown = viz.colorize_signed_error(np.array([[-1, 0, 1, 9, np.nan]]), 1.0)[0].astype(int)
    assert near[2] > near[0] + 100 and far[0] > far[2] + 100
    assert (right == 255).all() and (far == beyond).all() and len(set(unknown)) == 1


def test_a_panel_shows_the_error_of_every_method():
    size = (41, 53)
    rgb, truth_m = np.full((*size, 3), 90, np.uint8), np.full(size, 5.0, np.float32)
    for offset_m, color in ((-1.0, (20, 60, 200)), (1.0, (200, 30, 20))):
        picture = error_panel(rgb, truth_m, {"ours": truth_m + offset_m, "other": truth_m}, truth_m)
        error_px = (picture == color).all(axis=-1).sum() / (640 // size[1]) ** 2
        assert error_px >= size[0] * size[1]
