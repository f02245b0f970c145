import cv2
import numpy as np
import pytest

from depthreg.errors import InputError
from depthreg.rendering import Camera


def test_rays_project_back_onto_their_pixels_by_opencvs_camera_model() -> None:
    camera = Camera(width=37, height=23, focal_px=31.0, center_px=(17.5, 12.25))
    rays = camera.rays()
    pixels, _ = cv2.projectPoints(7.0 * rays.reshape(-1, 3), np.zeros(3), np.zeros(3), camera.intrinsics, None)
    v, u = np.mgrid[:23, :37]
    np.testing.assert_allclose(pixels[:, 0], np.stack([u.ravel(), v.ravel()], 1), atol=1e-3)


def test_the_principal_point_is_the_middle_pixel_where_not_given() -> None:
    camera = Camera(width=37, height=23, focal_px=31.0)
    np.testing.assert_allclose(camera.rays()[11, 18], [0, 0, 1])
    np.testing.assert_array_equal(camera.intrinsics[:2, 2], [18, 11])


def test_a_border_continues_the_same_pixel_grid() -> None:
    camera = Camera(width=37, height=23, focal_px=31.0)
    np.testing.assert_array_equal(camera.rays(5)[5:-5, 5:-5], camera.rays())


@pytest.mark.parametrize("wrong", [{"width": 0}, {"height": -3}, {"focal_px": 0.0}, {"margin_px": -1}])
def test_an_impossible_camera_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        Camera(**({"width": 8, "height": 8, "focal_px": 5.0} | wrong))
