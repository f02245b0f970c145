import cv2
import numpy as np
import pytest

from depthreg.errors import InputError
from depthreg.rendering import Camera, ScanPattern, hdl64


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


def test_hdl64_has_the_data_sheets_beams() -> None:
    scan = hdl64()
    assert len(scan.elevations_deg) == 64
    assert scan.elevations_deg[0] == pytest.approx(1.97)
    assert scan.elevations_deg[-1] == pytest.approx(-24.9)
    assert (np.diff(scan.elevations_deg) < 0).all()
    upper, lower = -np.diff(scan.elevations_deg[:32]), -np.diff(scan.elevations_deg[32:])
    np.testing.assert_allclose([upper.mean(), lower.mean()], [1 / 3, 1 / 2], atol=0.02)


def test_a_turn_has_the_number_of_firings_that_the_step_says() -> None:
    scan = ScanPattern((0.0, -10.0), azimuth_step_deg=0.5)
    rays, ring = scan.rays(-90.0, 89.9)
    assert len(rays) == 2 * 360
    assert np.bincount(ring).tolist() == [360, 360]


def test_scan_rays_are_unit_vectors_at_their_rings_elevation() -> None:
    scan = ScanPattern((2.0, -24.0), azimuth_step_deg=1.0)
    rays, ring = scan.rays(-40.0, 40.0)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(np.arcsin(rays[:, 2])), np.array([2.0, -24.0])[ring], atol=1e-4)


@pytest.mark.parametrize("wrong", [{"width": 0}, {"height": -3}, {"focal_px": 0.0}, {"margin_px": -1}])
def test_an_impossible_camera_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        Camera(**({"width": 8, "height": 8, "focal_px": 5.0} | wrong))
