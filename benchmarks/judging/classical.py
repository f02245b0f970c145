"""Registration that needs no training, with every setting that did best somewhere."""

from collections.abc import Callable
from importlib.util import find_spec

import cv2
import numpy as np

from depthreg.baselines import ecc, mattes_mi, nearest
from depthreg.baselines.registration import Registrar, color_edges, depth_edges, mutual_information


def _luminance(rgb: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)


def mi_filled(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray | None:
    """Mattes MI between luminance and the logarithm of depth, filled from the nearest return."""
    return mutual_information(_luminance(rgb), np.log(nearest(depth_m)))


def mi_at_returns(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray | None:
    """Mattes MI at the returns alone, 16 bins, nothing filled; luminance is blurred less and less."""
    known = depth_m > 0
    fixed = np.where(known, np.log(np.maximum(depth_m, 1e-3)), 0).astype(np.float32)
    affine: np.ndarray | None = None
    for sigma in (4, 2, 0):
        moving = cv2.GaussianBlur(_luminance(rgb), (0, 0), sigma) if sigma else _luminance(rgb)
        found = mutual_information(moving, fixed, bins=16, levels=((1, 0),), mask=known, first=affine)
        if found is None:
            break
        affine = found
    return affine


def phase_correlation(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """The translation of the highest peak of OpenCV's phase correlation between gradients."""
    window = cv2.createHanningWindow(depth_m.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(depth_edges(depth_m), color_edges(rgb), window)
    return np.array([[1, 0, shift[0]], [0, 1, shift[1]]])


def elastix(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray | None:
    """elastix' default affine of Mattes MI, between gradients."""
    import itk  # here, since it is no dependency

    parameters = itk.ParameterObject.New()
    parameters.AddParameterMap(parameters.GetDefaultParameterMap("affine", 4))
    fixed, moving = (itk.image_from_array(np.ascontiguousarray(e)) for e in (depth_edges(depth_m), color_edges(rgb)))
    try:
        _, result = itk.elastix_registration_method(fixed, moving, parameter_object=parameters, log_to_console=False)
    except RuntimeError:
        return None
    found = result.GetParameterMap(0)
    a, b, c, d, tx, ty = map(float, found["TransformParameters"])
    centre = np.array([float(x) for x in found["CenterOfRotationPoint"]])
    matrix = np.array([[a, b], [c, d]])
    return np.column_stack([matrix, np.array([tx, ty]) + centre - matrix @ centre])


def methods() -> dict[str, Registrar]:
    """What this installation can run, by name."""
    found: dict[str, Callable] = {"ECC": ecc, "phase correlation": phase_correlation}
    if find_spec("SimpleITK"):
        found |= {"MI, gradients": mattes_mi, "MI, filled": mi_filled, "MI, at returns": mi_at_returns}
    if find_spec("itk"):
        found["elastix"] = elastix
    return found
