"""Examples are what a user's own files would be, and the truth is that of the renderer."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from depthreg.demonstration.examples import DEPTH_SCALE, SCENES, render_example


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.title)
def test_every_example_is_a_pair_of_files_of_one_size_whose_depth_is_nearly_true(scene, tmp_path: Path) -> None:
    example = render_example(scene, tmp_path / "example")
    rgb = cv2.imread(str(example.rgb), cv2.IMREAD_UNCHANGED)
    depth_m = cv2.imread(str(example.depth), cv2.IMREAD_UNCHANGED) / DEPTH_SCALE
    assert rgb.dtype == np.uint8 and rgb.shape == (*depth_m.shape, 3) and min(depth_m.shape) > 300
    assert depth_m.shape == example.truth_depth_m.shape and np.loadtxt(example.intrinsics).shape == (3, 3)
    both = (depth_m > 0) & (example.truth_depth_m > 0)
    assert both.sum() > 50
    assert np.median(np.abs(depth_m - example.truth_depth_m)[both] / example.truth_depth_m[both]) < 0.05
    height, width = depth_m.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]])
    moved_px = np.abs(corners @ example.truth_affine_rgb_from_depth.T - corners[:, :2]).max()
    assert 2 < moved_px < 24 * width / 1242 + 1  # worth registering, and within what training knows
