"""Pictures to judge results by eye: depth and error in colours, edges over colour, panels of captioned tiles.

Pictures are (H, W, 3) uint8 RGB; depth is (H, W) metres, 0 where there is none.
"""

import cv2
import numpy as np
from torch import Tensor

from depthreg.networks.joint import JointOutput

Tile = tuple[str, np.ndarray]  # a caption (ASCII) and a picture

_BACKGROUND = 24
_UNKNOWN = 60  # grey of pixels that have no value
_TEXT = 235
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_FONT_PX = 22  # height of its capitals at scale 1
_EDGE_RGB = np.array([80, 255, 80], np.uint8)
_TOO_NEAR_RGB, _TOO_FAR_RGB = np.array([20, 60, 200]), np.array([200, 30, 20])


def depth_limits_m(*depths_m: np.ndarray) -> tuple[float, float]:
    """Depths that hold all but 1 % of the valid pixels at either end: one colour scale for several maps."""
    valid = np.concatenate([depth[depth > 0] for depth in depths_m])
    if not valid.size:
        return 1.0, 2.0
    low, high = np.percentile(valid, [1, 99])
    return float(low), float(max(high, 1.05 * low))


def colorize_depth(depth_m: np.ndarray, min_m: float, max_m: float) -> np.ndarray:
    """Colour depth over its logarithm, near = red, far = blue, none = grey."""
    unit = np.log(np.maximum(depth_m, 1e-6) / min_m) / np.log(max_m / min_m)
    return _apply_colormap(1 - unit, cv2.COLORMAP_TURBO, known=depth_m > 0)


def colorize_error(error_m: np.ndarray, max_m: float) -> np.ndarray:
    """Colour an absolute error, 0 = dark violet, `max_m` and beyond = yellow, unknown (NaN) = grey."""
    known = np.isfinite(error_m)
    return _apply_colormap(np.where(known, error_m, 0) / max_m, cv2.COLORMAP_VIRIDIS, known)


def _apply_colormap(unit: np.ndarray, colormap: int, known: np.ndarray) -> np.ndarray:
    level = (255 * unit.clip(0, 1)).round().astype(np.uint8)
    colored = cv2.cvtColor(cv2.applyColorMap(level, colormap), cv2.COLOR_BGR2RGB)
    return np.where(known[..., None], colored, np.uint8(_UNKNOWN))


def color_bar(colors: np.ndarray, ticks_m: np.ndarray) -> np.ndarray:
    """A vertical scale beside a picture: its `colors` (H, 3) from top to bottom, and evenly spaced ticks."""
    height = len(colors)
    font_px = 10 + height // 50
    labels = [np.format_float_positional(tick, precision=2, fractional=False, trim="-") + " m" for tick in ticks_m]
    width = font_px + 12 + max(_text_width(label, font_px) for label in labels)
    bar = np.full((height, width, 3), _BACKGROUND, np.uint8)
    bar[:, 4 : 4 + font_px] = colors[:, None]
    for label, y in zip(labels, np.linspace(font_px, height - 4, len(labels)), strict=True):
        _put_text(bar, label, (font_px + 8, round(y)), font_px)
    return bar


def depth_with_bar(depth_m: np.ndarray, min_m: float, max_m: float) -> np.ndarray:
    """Coloured depth with its scale at the right."""
    colors = colorize_depth(np.geomspace(min_m, max_m, len(depth_m))[:, None], min_m, max_m)[:, 0]
    bar = color_bar(colors, np.geomspace(min_m, max_m, 5))
    return np.hstack([colorize_depth(depth_m, min_m, max_m), bar])


def error_with_bar(error_m: np.ndarray, max_m: float) -> np.ndarray:
    """Coloured error with its scale at the right."""
    colors = colorize_error(np.linspace(max_m, 0, len(error_m))[:, None], max_m)[:, 0]
    bar = color_bar(colors, np.linspace(max_m, 0, 5))
    return np.hstack([colorize_error(error_m, max_m), bar])


def colorize_signed_error(error_m: np.ndarray, max_m: float) -> np.ndarray:
    """Colour an error by its sign: too near = blue, none = white, too far = red, unknown (NaN) = grey."""
    known = np.isfinite(error_m)
    unit = (np.where(known, error_m, 0) / max_m).clip(-1, 1)[..., None]
    colored = 255 + np.abs(unit) * (np.where(unit < 0, _TOO_NEAR_RGB, _TOO_FAR_RGB) - 255.0)
    return np.where(known[..., None], colored.round().astype(np.uint8), np.uint8(_UNKNOWN))


def signed_error_with_bar(error_m: np.ndarray, max_m: float) -> np.ndarray:
    """Error coloured by its sign, with its scale at the right."""
    colors = colorize_signed_error(np.linspace(max_m, -max_m, len(error_m))[:, None], max_m)[:, 0]
    bar = color_bar(colors, np.linspace(max_m, -max_m, 5))
    return np.hstack([colorize_signed_error(error_m, max_m), bar])


def dilate_depth(depth_m: np.ndarray, radius_px: int) -> np.ndarray:
    """Grow every return into a disc so that it can be seen; where discs meet, the nearest one is on top."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1,) * 2)
    grown = cv2.dilate(_inverse(depth_m), disc)
    return np.where(depth_m > 0, depth_m, _inverse(grown))


def overlay_points(rgb: np.ndarray, depth_m: np.ndarray, radius_px: int = 1) -> np.ndarray:
    """Draw sparse returns, coloured by depth, over a darkened colour image."""
    grown = dilate_depth(depth_m, radius_px)
    return np.where(grown[..., None] > 0, colorize_depth(grown, *depth_limits_m(depth_m)), rgb // 2)


def depth_edges(depth_m: np.ndarray, relative_jump: float = 0.07) -> np.ndarray:
    """Where a nearer surface ends, (H, W) bool: the last pixel inside its outline.

    On a plane, inverse depth is linear in the pixel position: it equals the mean around it, however steep.
    """
    inverse = _inverse(depth_m)
    above_mean = inverse - cv2.blur(inverse, (5, 5)) > 0.4 * relative_jump * inverse  # 2 of 5 columns are beyond
    at_the_drop = cv2.erode(inverse, np.ones((3, 3), np.uint8)) < (1 - relative_jump / 2) * inverse
    known = cv2.erode(np.uint8(depth_m > 0), np.ones((5, 5), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return above_mean & at_the_drop & (known > 0)


def edges_overlay(rgb: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Draw the depth's edges over colour: where both are registered, they follow the outlines of things."""
    return np.where(depth_edges(depth_m)[..., None], _EDGE_RGB, rgb)


def _inverse(depth_m: np.ndarray) -> np.ndarray:
    return np.divide(1, depth_m, out=np.zeros_like(depth_m, np.float32), where=depth_m > 0)


def panel(tiles: list[Tile], columns: int = 1) -> np.ndarray:
    """Arrange captioned pictures, of whatever sizes, in a grid."""
    font_px = max(16, max(image.shape[1] for _, image in tiles) // 54)
    framed = [_with_caption(caption, image, font_px) for caption, image in tiles]
    return grid([framed[start : start + columns] for start in range(0, len(framed), columns)])


def grid(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Arrange pictures of whatever sizes in rows and columns."""
    columns = max(len(row) for row in rows)
    widths = [max(row[column].shape[1] for row in rows if column < len(row)) for column in range(columns)]
    padded = []
    for row in rows:
        height = max(tile.shape[0] for tile in row)
        cells = [_pad(tile, height, width) for tile, width in zip(row, widths, strict=False)]
        padded.append(_pad(np.hstack(cells), height, sum(widths)))
    return np.vstack(padded)


def _with_caption(caption: str, image: np.ndarray, font_px: int) -> np.ndarray:
    width = max(image.shape[1], _text_width(caption, font_px) + 12)
    strip = np.full((2 * font_px, width, 3), _BACKGROUND, np.uint8)
    _put_text(strip, caption, (6, round(1.45 * font_px)), font_px)
    framed = np.vstack([strip, _pad(image, image.shape[0], width)])
    return _pad(framed, framed.shape[0] + 4, framed.shape[1] + 4)


def _pad(image: np.ndarray, height: int, width: int) -> np.ndarray:
    extra = (0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)
    return np.pad(image, extra, constant_values=_BACKGROUND)


def _text_width(text: str, font_px: int) -> int:
    return cv2.getTextSize(text, _FONT, font_px / _FONT_PX, 1)[0][0]


def _put_text(image: np.ndarray, text: str, xy: tuple[int, int], font_px: int) -> None:
    thickness = max(1, font_px // 12)
    cv2.putText(image, text, xy, _FONT, font_px / _FONT_PX, (_TEXT,) * 3, thickness, cv2.LINE_AA)


def sample_panel(
    rgb: Tensor, depth_m: Tensor, output: JointOutput, truth_depth_m: Tensor | None = None, index: int = 0
) -> np.ndarray:
    """The picture of one sample: colour before and after, sparse and completed depth, truth, error.

    Args:
        rgb: Colour as given, (B, 3, H, W) in [0, 1].
        depth_m: Sparse depth, (B, 1, H, W).
        output: What the joint network made of them.
        truth_depth_m: True depth, (B, 1, H, W), 0 where unknown.
        index: Which sample of the batch.

    Returns:
        RGB, about 1000 pixels wide or more: small samples are enlarged, wide ones stacked in one column.
    """
    height, width = rgb.shape[-2:]
    columns = 1 if width > 2 * height else 2
    factor = max(1, round(1000 / (columns * width)))
    before, after = (to_picture(image[index]) for image in (rgb, output.rgb_aligned))
    sparse, completed = (depth[index, 0].detach().cpu().numpy() for depth in (depth_m, output.depth_m))
    truth = np.zeros_like(sparse) if truth_depth_m is None else truth_depth_m[index, 0].cpu().numpy()
    limits = depth_limits_m(sparse, truth)
    judge, outlines = ("true", truth) if np.mean(truth > 0) > 0.5 else ("completed", completed)
    tiles = [
        (f"colour as given, edges of the {judge} depth", enlarge(edges_overlay(before, outlines), factor)),
        ("colour aligned, the same edges", enlarge(edges_overlay(after, outlines), factor)),
        (f"depth as given, {np.mean(sparse > 0):.1%} of pixels", depth_tile(sparse, limits, factor)),
        ("depth completed", depth_tile(completed, limits, factor)),
    ]
    if truth.any():
        error = np.where(truth > 0, np.abs(completed - truth), np.nan)
        tiles.append(("true depth", depth_tile(truth, limits, factor)))
        # Relative to the scene's depth, not to the error: pictures of one scene stay comparable over epochs.
        in_colour = error_with_bar(enlarge(error, factor), limits[1] / 20)
        tiles.append((f"error, mean {np.nanmean(error):.2f} m", in_colour))
    return panel(tiles, columns)


def to_picture(rgb: Tensor) -> np.ndarray:
    """Colour (3, H, W) in [0, 1] as a picture."""
    return (255 * rgb.detach().clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()


def enlarge(image: np.ndarray, factor: int) -> np.ndarray:
    """A picture `factor` times as large, every pixel a square."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def depth_tile(depth_m: np.ndarray, limits_m: tuple[float, float], factor: int) -> np.ndarray:
    """Coloured depth with its scale; returns that are few are grown until they can be seen."""
    share = max(float(np.mean(depth_m > 0)), 1e-3)
    radius_px = max(0, round((np.sqrt(0.25 / share) - 1) / 2))  # about a quarter of the picture gets covered
    return depth_with_bar(enlarge(dilate_depth(depth_m, radius_px), factor), *limits_m)
