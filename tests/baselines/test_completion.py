import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from depthreg.baselines import ip_basic, linear, nearest
from depthreg.metrics import depth_errors

COLUMNS, ROWS = np.meshgrid(np.arange(53, dtype=np.float32), np.arange(37, dtype=np.float32))
PLANE_M = 10 + 0.1 * COLUMNS + 0.2 * ROWS


def sparse(depth_m, share, seed=0):
    kept = np.random.default_rng(seed).random(depth_m.shape) < share
    return np.where(kept, depth_m, 0).astype(np.float32)


@pytest.mark.parametrize("complete", [nearest, linear, ip_basic])
def test_completion_is_dense_float32_and_leaves_its_input_alone(complete):
    depth_m = sparse(PLANE_M, 0.2)
    before = depth_m.copy()
    dense = complete(depth_m)
    assert dense.shape == depth_m.shape and dense.dtype == np.float32
    assert (dense > 0).all()
    np.testing.assert_array_equal(depth_m, before)


def test_nearest_takes_a_return_at_about_the_distance_that_scipy_finds():
    depth_m = sparse(PLANE_M, 0.05)
    depth_m[depth_m > 0] = np.arange(1, 1 + (depth_m > 0).sum())  # depths that tell which return was taken
    filled = nearest(depth_m)
    rows, columns = np.zeros(int(depth_m.max()) + 1), np.zeros(int(depth_m.max()) + 1)
    rows[depth_m[depth_m > 0].astype(int)], columns[depth_m[depth_m > 0].astype(int)] = np.nonzero(depth_m)
    taken = filled.astype(int)
    distance_px = np.hypot(rows[taken] - ROWS, columns[taken] - COLUMNS)
    # OpenCV's distances are good to a few percent.
    np.testing.assert_allclose(distance_px, distance_transform_edt(depth_m == 0), rtol=0.06, atol=0.01)


def test_linear_is_exact_on_a_plane_inside_the_hull():
    depth_m = sparse(PLANE_M, 0.2)
    depth_m[[0, 0, -1, -1], [0, -1, 0, -1]] = PLANE_M[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(linear(depth_m), PLANE_M, rtol=1e-5)


@pytest.mark.parametrize("complete", [nearest, linear])
def test_a_dense_map_stays_as_it_is(complete):
    np.testing.assert_array_equal(complete(PLANE_M), PLANE_M)


def test_linear_bridges_a_hole_in_a_dense_map():
    depth_m = PLANE_M.copy()
    depth_m[10:20, 15:40] = 0
    np.testing.assert_allclose(linear(depth_m), PLANE_M, rtol=1e-5)


@pytest.mark.parametrize("pixels", [[(3, 4)], [(3, 4), (8, 9)], [(5, x) for x in range(0, 50, 7)]])
def test_linear_falls_back_to_the_nearest_return_without_a_triangle(pixels):
    depth_m = np.zeros((37, 53), np.float32)
    for value, pixel in enumerate(pixels, start=3):
        depth_m[pixel] = value
    np.testing.assert_array_equal(linear(depth_m), nearest(depth_m))


def test_ip_basic_lets_near_surfaces_win():
    depth_m = np.zeros((37, 53), np.float32)
    depth_m[::3, ::3] = 40.0
    depth_m[17:20, 26:29] = 10.0
    assert ip_basic(depth_m)[18, 25:30] == pytest.approx(10.0, abs=1e-3)


def test_ip_basic_extends_the_topmost_depth_upwards():
    depth_m = np.zeros((60, 53), np.float32)
    depth_m[45:] = 20.0
    np.testing.assert_allclose(ip_basic(depth_m), 20.0, rtol=1e-5)


# RMSE and MAE in metres, iRMSE and iMAE in 1/km, measured once on the same frames by other code.
PUBLISHED = {
    ("kitti_dc_official/triple_5", nearest): (2.888, 0.683, 5.62, 2.08),
    ("kitti_dc_official/triple_5", linear): (2.551, 0.661, 4.85, 1.84),
    ("kitti_dc_official/triple_5", ip_basic): (2.639, 0.629, 6.29, 2.12),
    ("kitti_odom_04/cam2", nearest): (1.477, 0.331, 3.84, 1.44),
    ("kitti_odom_04/cam2", linear): (1.437, 0.292, 3.62, 1.11),
    ("kitti_odom_04/cam2", ip_basic): (1.286, 0.278, 2.80, 1.11),
}


@pytest.mark.parametrize(("folder", "complete"), PUBLISHED)
def test_scores_on_real_frames_are_those_of_the_reference(real_data, folder, complete):
    if folder.endswith("triple_5"):
        pairs = [(real_data / folder / "sparse_depth.png", real_data / folder / "gt_depth.png")]
    else:
        truths = sorted((real_data / folder / "groundtruth_depth").glob("*.png"))
        pairs = [(real_data / folder / "velodyne_raw" / truth.name, truth) for truth in truths]
    errors = []
    for pair in pairs:
        depth_m, truth_m = (np.float32(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) / 256 for path in pair)
        dense = torch.from_numpy(complete(depth_m))[None, None]
        errors.append(depth_errors(dense, torch.from_numpy(truth_m)[None, None])[0, :4])
    measured = torch.stack(errors).mean(dim=0).tolist()
    assert measured == pytest.approx(PUBLISHED[folder, complete], abs=0.006)
