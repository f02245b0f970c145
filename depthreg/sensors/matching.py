"""A stereo pair as two real cameras give it, and what semi-global matching finds in it.

Hirschmueller 2008, "Stereo Processing by Semiglobal Matching and Mutual Information", in OpenCV's block-wise variant.
Its failures are its own: the band at the left that the right camera doesn't see, blank and repetitive surfaces, polish,
foreground that grows over its edges, steps of 1/16 px, a leaning towards whole pixels, speckles. Arrays are (H, W);
light is linear and float32.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from depthreg.data.sample import Frame
from depthreg.errors import InputError
from depthreg.sensors.projector import Projector, from_left, left_cosine

_GAMMA = 2.2
_LINEAR = (np.linspace(0, 1, 256) ** _GAMMA).astype(np.float32)
_TONES = np.rint(255 * np.linspace(0, 1, 4096) ** (1 / _GAMMA)).astype(np.uint8)


@dataclass(frozen=True)
class SemiGlobal:
    """OpenCV's StereoSGBM with the left-right check, on grey images.

    Three paths (MODE_SGBM_3WAY) are as good as eight (MODE_HH) and take less than a third of the time: on pairs of
    KITTI and Middlebury the shares of pixels wrong by more than 1 px differ by 0.002.

    Args:
        block_px: Side of the compared blocks, odd.
        small_step, large_step: Penalty for a disparity step of 1 px and for a larger one, for each pixel of a block:
            P1 = small_step * block_px^2, P2 likewise. OpenCV advises 8 and 32 for each channel.
        uniqueness_percent: By how much the best cost has to undercut the others.
        speckle_px: Smaller islands of disparity are removed.
        near_share: Share of the pixels that may be nearer than the search reaches; the rig suits the place otherwise.
        min_search_px: Shortest search. Among few candidates noise finds a unique best one: of a blank wall, 0.5 is
            "matched" with 16 of them, 0.14 with 48.
        max_search_share: Longest search, as a share of the image's width.
    """

    block_px: int = 5
    small_step: int = 8
    large_step: int = 32
    uniqueness_percent: int = 15
    speckle_px: int = 100
    near_share: float = 0.01
    min_search_px: int = 64
    max_search_share: float = 0.15

    def __post_init__(self) -> None:
        if self.block_px < 1 or self.block_px % 2 == 0:
            raise InputError(f"block_px must be odd and positive, got {self.block_px}")
        if not 0 < self.small_step < self.large_step:
            raise InputError(f"0 < small_step < large_step expected, got {self.small_step} and {self.large_step}")
        if not (0 <= self.near_share < 1 and 0 < self.max_search_share < 1):
            raise InputError(f"near_share and max_search_share are shares below 1, got {self}")
        if not (0 <= self.uniqueness_percent < 100 and min(self.speckle_px, self.min_search_px) >= 0):
            raise InputError(
                f"uniqueness_percent must be in [0, 100), speckle_px and min_search_px not negative: {self}"
            )

    def search_px(self, true_disparity_px: np.ndarray) -> int:
        """How many disparities to search in a place of these true ones (H, W): a multiple of 16, as OpenCV needs."""
        nearest_px = np.quantile(true_disparity_px[::4, ::4], 1 - self.near_share)
        wanted_px = max(nearest_px + 1, self.min_search_px)
        limit = int(self.max_search_share * true_disparity_px.shape[1]) // 16
        return 16 * max(1, min(math.ceil(wanted_px / 16), limit))

    def __call__(self, left: np.ndarray, right: np.ndarray, search_px: int) -> np.ndarray:
        """Disparity in the left image, (H, W) float32 in steps of 1/16 px; 0 where there is none.

        Args:
            left, right: Rectified grey images, (H, W) uint8.
            search_px: Disparities from 0 to this, a multiple of 16.
        """
        area = self.block_px**2
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=search_px,
            blockSize=self.block_px,
            P1=self.small_step * area,
            P2=self.large_step * area,
            disp12MaxDiff=1,
            preFilterCap=63,
            uniquenessRatio=self.uniqueness_percent,
            speckleWindowSize=self.speckle_px,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        # OpenCV leaves the first search_px columns out, whatever is there; a border makes it try them.
        padded = (cv2.copyMakeBorder(image, 0, 0, search_px, 0, cv2.BORDER_REPLICATE) for image in (left, right))
        found_px = matcher.compute(*padded)[:, search_px:].astype(np.float32) / 16
        seen_by_both = found_px <= np.arange(left.shape[1], dtype=np.float32)
        return np.where(seen_by_both, found_px, 0).clip(min=0)


@dataclass(frozen=True)
class CameraPair:
    """Two cameras that aren't quite alike, nor quite parallel.

    Args:
        shot_noise: Variance of the light, as a share of it, at full scale 1: 5e-5 is a full well of 20 000 electrons.
        read_noise: Standard deviation in the dark, as a share of the full scale.
        exposure_spread: Standard deviation of the ratio of the two exposures.
        blur_px: Largest standard deviation of the two lenses' blur, each drawn uniformly.
        rectification_px: Standard deviation of what calibration leaves: of the right image's shift along each axis and
            of its corners' motion by a roll.
        reflection: Contrast of what polished surfaces mirror, as a share of the full scale.
    """

    shot_noise: float = 5e-5
    read_noise: float = 1e-3
    exposure_spread: float = 0.03
    blur_px: float = 0.7
    rectification_px: float = 0.15
    reflection: float = 0.3

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 0:
            raise InputError(f"a camera's defects can't be negative, got {self}")

    def __call__(self, left: np.ndarray, right: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The two images, uint8 (H, W), of the light (H, W) that falls into the two lenses."""
        right = right * np.float32(rng.normal(1, self.exposure_spread))
        right = misaligned(right, *rng.normal(0, self.rectification_px, 3))
        left, right = (blurred(light, self.blur_px * rng.uniform()) for light in (left, right))
        return self._recorded(left, rng), self._recorded(right, rng)

    def _recorded(self, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        sigma = np.sqrt(np.float32(self.shot_noise) * light + np.float32(self.read_noise**2))
        noisy = light + sigma * rng.standard_normal(light.shape, np.float32)
        return _TONES[(noisy * (len(_TONES) - 1)).clip(0, len(_TONES) - 1).astype(np.uint16)]


def misaligned(image: np.ndarray, right_px: float, down_px: float, roll_px: float) -> np.ndarray:
    """The image (H, W) shifted, and turned so far about its middle that the ends of its middle row move by roll_px."""
    height, width = image.shape
    slope = 2 * roll_px / width
    turned = np.array([[1, slope, right_px - slope * height / 2], [-slope, 1, down_px + slope * width / 2]])
    return cv2.warpAffine(image, turned, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """The image (H, W) through a lens of Gaussian blur."""
    return cv2.GaussianBlur(image, (5, 5), sigma_px) if sigma_px > 0.1 else image


def linear_grey(rgb: np.ndarray) -> np.ndarray:
    """Light (H, W) float32 in [0, 1] that made a picture (H, W, 3) uint8."""
    return _LINEAR[cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)]


def reflections(frame: Frame, contrast: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Light (H, W) that polished surfaces add to the left and the right image: a blotchy world behind them.

    A flat mirror shows things as far behind it as they lie before it, so the matcher finds them at a share of the
    surface's disparity: half where they lie as far from it as the cameras. The light's share is Schlick's
    approximation, as in the renderer, which mirrors no such detail.
    """
    share = frame.gloss * (0.08 + 0.92 * (1 - left_cosine(frame)) ** 5)
    height, width = share.shape
    world = np.zeros((height, width), np.float32)
    for cell_px in (24, 6):
        coarse = rng.uniform(-1, 1, (height // cell_px + 2, width // cell_px + 2)).astype(np.float32)
        world += 0.5 * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    left = contrast * share * world
    right = contrast * from_left(share, frame) * from_left(world, frame, disparity_share=rng.uniform(0.3, 0.8))
    return left, right


@dataclass(frozen=True)
class StereoMatcher:
    """Matches a rendered pair as real cameras would see it; with a projector, in the infrared.

    Args:
        cameras: How the images suffer.
        matching: Finds disparities.
        projector: Throws dots onto the scene; none makes it passive.
    """

    cameras: CameraPair = CameraPair()
    matching: SemiGlobal = SemiGlobal()
    projector: Projector | None = None

    def __call__(self, frame: Frame, rng: np.random.Generator) -> np.ndarray:
        """Disparity in the left image, (H, W) float32 pixels; 0 where it found nothing."""
        return self.matching(*self.images(frame, rng), self.search_px(frame))

    def search_px(self, frame: Frame) -> int:
        """How many disparities are searched."""
        focal_px = float(frame.intrinsics[0, 0])
        depth_m = frame.depth_m
        return self.matching.search_px(np.where(depth_m > 0, focal_px * frame.baseline_m / depth_m.clip(1e-3), 0))

    def images(self, frame: Frame, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The grey images (H, W) uint8 that are matched."""
        height, width = frame.depth_m.shape
        inner = slice(frame.margin_px, frame.margin_px + height), slice(frame.margin_px, frame.margin_px + width)
        left, right = linear_grey(frame.rgb[inner]), linear_grey(frame.rgb_right)
        if self.cameras.reflection and frame.gloss.any():
            mirrored = reflections(frame, self.cameras.reflection, rng)
            left, right = (left + mirrored[0]).clip(min=0), (right + mirrored[1]).clip(min=0)
        if self.projector:
            left, right = self.projector(frame, left, right, rng)
        return self.cameras(left, right, rng)
