import sys

import cv2
import numpy as np
import pytest
import torch

from depthreg.baselines import ecc, identity, mattes_mi, registration_baselines
from depthreg.errors import InputError
from depthreg.geometry import corner_errors_px

HEIGHT, WIDTH = 131, 187
TRUTH = np.array([[1.01, -0.015, 4.0], [0.012, 0.99, -2.5]])


@pytest.fixture(scope="module")
def easy_pair():
    """Boxes before a wall, the brighter the farther, and the colour moved by TRUTH."""
    rng = np.random.default_rng(3)
    depth_m = np.full((HEIGHT, WIDTH), 20.0, np.float32)
    for _ in range(14):
        x, y, w, h = rng.integers([0, 0, 15, 15], [WIDTH - 20, HEIGHT - 20, 50, 40])
        depth_m[y : y + h, x : x + w] = rng.uniform(3, 15)
    rgb = np.uint8(12 * depth_m)[..., None].repeat(3, axis=-1)
    # rgb[A @ p] shows what the depth has at p, which is what cv2.warpAffine does with A.
    moved = cv2.warpAffine(rgb, TRUTH, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
    return moved, depth_m


def corner_error_px(affine):
    return corner_errors_px(torch.from_numpy(affine), torch.from_numpy(TRUTH), (HEIGHT, WIDTH)).mean().item()


@pytest.mark.parametrize("register", [ecc, mattes_mi])
def test_an_easy_pair_is_registered_to_a_pixel(easy_pair, register):
    if register is mattes_mi:
        pytest.importorskip("SimpleITK")
    affine = register(*easy_pair)
    assert affine.shape == (2, 3) and affine.dtype == np.float64
    assert corner_error_px(identity(*easy_pair)) > 4
    assert corner_error_px(affine) < 1


def test_mattes_mi_gives_the_same_answer_twice(easy_pair):
    pytest.importorskip("SimpleITK")
    np.testing.assert_allclose(mattes_mi(*easy_pair), mattes_mi(*easy_pair), rtol=1e-12)


def test_ecc_admits_that_it_found_nothing(easy_pair, monkeypatch):
    def diverge(*_):
        raise cv2.error("The algorithm stopped before its convergence")

    monkeypatch.setattr(cv2, "findTransformECC", diverge)
    assert ecc(*easy_pair) is None


def test_missing_simpleitk_is_explained(easy_pair, monkeypatch):
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with pytest.raises(InputError, match=r"depthreg\[baselines\]"):
        mattes_mi(*easy_pair)


def test_the_table_always_starts_with_the_identity():
    assert list(registration_baselines())[:2] == ["identity", "ECC"]
