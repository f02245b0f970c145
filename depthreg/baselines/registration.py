"""Registration of colour to depth that needs no training: what a user would do without depthreg.

Each takes colour (H, W, 3) uint8 and a z-depth map (H, W) float32 in metres, 0 = no return, with at least one
return, and gives the affine A (2, 3) float64 in pixels for which `rgb[A @ (x, y, 1)]` belongs to
`depth_m[y, x]`, or None where it finds none.
"""

from collections.abc import Callable
from importlib.util import find_spec

import cv2
import numpy as np

from depthreg.baselines.completion import nearest
from depthreg.errors import InputError

Registrar = Callable[[np.ndarray, np.ndarray], np.ndarray | None]


def identity(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Believe that the pair lines up already."""
    return np.eye(2, 3)


def ecc(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray | None:
    """OpenCV's enhanced correlation coefficient (Evangelidis and Psarakis, 2008) on gradient magnitudes.

    None where it doesn't converge.
    """
    start = np.eye(2, 3, dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-6)
    try:
        _, affine = cv2.findTransformECC(
            _depth_edges(depth_m), _color_edges(rgb), start, cv2.MOTION_AFFINE, stop, None, 5
        )
    except cv2.error:
        return None
    return affine.astype(np.float64)


def mattes_mi(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray | None:
    """SimpleITK's Mattes mutual information between gradient magnitudes, coarse to fine.

    None where the images stop to overlap.

    Raises:
        InputError: SimpleITK isn't installed.
    """
    try:
        import SimpleITK as sitk  # here, since it is an extra
    except ImportError as error:
        raise InputError("mattes_mi needs SimpleITK: pip install 'depthreg[baselines]'") from error
    height, width = depth_m.shape
    start = sitk.AffineTransform(2)
    start.SetCenter(((width - 1) / 2, (height - 1) / 2))
    method = sitk.ImageRegistrationMethod()
    method.SetNumberOfWorkUnits(1)  # sums in one fixed order give the same answer every time
    method.SetMetricAsMattesMutualInformation(32)
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(0.2, seed=1)
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-3, 200)
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([4, 2, 1])
    method.SetSmoothingSigmasPerLevel([4, 2, 0])
    method.SetInterpolator(sitk.sitkLinear)
    method.SetInitialTransform(start, inPlace=True)
    try:
        method.Execute(sitk.GetImageFromArray(_depth_edges(depth_m)), sitk.GetImageFromArray(_color_edges(rgb)))
    except RuntimeError:
        return None
    # ITK writes y = M (x - c) + t + c.
    matrix, centre = np.reshape(start.GetMatrix(), (2, 2)), np.array(start.GetCenter())
    offset = np.array(start.GetTranslation()) + centre - matrix @ centre
    return np.column_stack([matrix, offset])


def registration_baselines() -> dict[str, Registrar]:
    """The methods that this installation can run, by the names that tables print."""
    methods: dict[str, Registrar] = {"identity": identity, "ECC": ecc}
    if find_spec("SimpleITK"):
        methods["Mattes MI"] = mattes_mi
    return methods


def _color_edges(rgb: np.ndarray) -> np.ndarray:
    return _gradient_magnitude(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32))


def _depth_edges(depth_m: np.ndarray) -> np.ndarray:
    """Of the filled logarithm: a step from 5 to 10 m weighs as much as one from 20 to 40 m."""
    return _gradient_magnitude(np.log(nearest(depth_m)))


def _gradient_magnitude(image: np.ndarray) -> np.ndarray:
    smooth = cv2.GaussianBlur(image, (0, 0), 2)
    return np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
