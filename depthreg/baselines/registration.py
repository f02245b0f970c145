"""Registration of colour to depth that needs no training: what a user would do without depthreg.

Each takes colour (H, W, 3) uint8 and a z-depth map (H, W) float32 in metres, 0 = no return, with at least one
return, and gives the affine A (2, 3) float64 in pixels for which `rgb[A @ (x, y, 1)]` belongs to
`depth_m[y, x]`, or None where it finds none.
"""

from collections.abc import Callable, Sequence
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
            depth_edges(depth_m), color_edges(rgb), start, cv2.MOTION_AFFINE, stop, None, 5
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
    return mutual_information(color_edges(rgb), depth_edges(depth_m))


def mutual_information(
    moving: np.ndarray,
    fixed: np.ndarray,
    *,
    bins: int = 32,
    levels: Sequence[tuple[int, int]] = ((4, 4), (2, 2), (1, 0)),
    mask: np.ndarray | None = None,
    first: np.ndarray | None = None,
) -> np.ndarray | None:
    """The affine, from `fixed` pixels to `moving` ones, of the most Mattes mutual information that SimpleITK finds.

    Args:
        moving, fixed: (H, W) float32.
        bins: Of the joint histogram.
        levels: By how much both are shrunk, and blurred in pixels, coarse to fine.
        mask: Which pixels of `fixed` count, (H, W) bool: all of them are used; a fifth of all, chosen by chance, where
            not given.
        first: The affine to start from; the identity where not given.

    Returns:
        (2, 3) float64, or None where the images stop to overlap.

    Raises:
        InputError: SimpleITK isn't installed.
    """
    try:
        import SimpleITK as sitk  # here, since it is an extra
    except ImportError as error:
        raise InputError("mutual information needs SimpleITK: pip install 'depthreg[baselines]'") from error
    height, width = fixed.shape
    start, centre = sitk.AffineTransform(2), np.array([(width - 1) / 2, (height - 1) / 2])
    start.SetCenter(centre.tolist())
    if first is not None:
        start.SetMatrix(first[:, :2].ravel().tolist())
        start.SetTranslation((first[:, 2] + first[:, :2] @ centre - centre).tolist())
    method = sitk.ImageRegistrationMethod()
    method.SetNumberOfWorkUnits(1)  # sums in one fixed order give the same answer every time
    method.SetMetricAsMattesMutualInformation(bins)
    if mask is None:
        method.SetMetricSamplingStrategy(method.RANDOM)
        method.SetMetricSamplingPercentage(0.2, seed=1)
    else:
        method.SetMetricFixedMask(sitk.GetImageFromArray(mask.astype(np.uint8)))
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-3, 200)
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([shrink for shrink, _ in levels])
    method.SetSmoothingSigmasPerLevel([sigma for _, sigma in levels])
    method.SetInterpolator(sitk.sitkLinear)
    method.SetInitialTransform(start, inPlace=True)
    try:
        method.Execute(sitk.GetImageFromArray(fixed), sitk.GetImageFromArray(moving))
    except RuntimeError:
        return None
    # ITK writes y = M (x - c) + t + c.
    matrix = np.reshape(start.GetMatrix(), (2, 2))
    return np.column_stack([matrix, np.array(start.GetTranslation()) + centre - matrix @ centre])


def registration_baselines() -> dict[str, Registrar]:
    """The methods that this installation can run, by the names that tables print."""
    methods: dict[str, Registrar] = {"identity": identity, "ECC": ecc}
    if find_spec("SimpleITK"):
        methods["Mattes MI"] = mattes_mi
    return methods


def color_edges(rgb: np.ndarray) -> np.ndarray:
    """Gradient magnitude of the luminance, (H, W) float32."""
    return _gradient_magnitude(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32))


def depth_edges(depth_m: np.ndarray) -> np.ndarray:
    """Gradient magnitude of the filled logarithm, (H, W) float32.

    A step from 5 to 10 m weighs as much as one from 20 to 40 m.
    """
    return _gradient_magnitude(np.log(nearest(depth_m)))


def _gradient_magnitude(image: np.ndarray) -> np.ndarray:
    smooth = cv2.GaussianBlur(image, (0, 0), 2)
    return np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
