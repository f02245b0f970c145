"""Surface patterns as tiles with mip levels, so that far patterns fade to their mean instead of flickering."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from depthreg.worlds import patterns

TILE = patterns.TILE
LEVELS = TILE.bit_length()  # down to a single texel


@dataclass(frozen=True)
class Pattern:
    """A tileable picture of how a surface varies.

    Attributes:
        draw: Draws the tile; see `depthreg.worlds.patterns`.
        repeats: How many repeats of the motif (a brick, a bay of windows) a tile's side holds: neighbours differ.
    """

    draw: Callable[[np.random.Generator], np.ndarray]
    repeats: int = 1


PATTERNS: dict[str, Pattern] = {
    "plain": Pattern(patterns.plain),
    "noise": Pattern(patterns.noise),
    "checker": Pattern(patterns.checker, repeats=4),
    "stripes": Pattern(patterns.stripes, repeats=8),
    "plaster": Pattern(patterns.plaster),
    "concrete": Pattern(patterns.concrete, repeats=4),
    "asphalt": Pattern(patterns.asphalt),
    "paving": Pattern(patterns.paving, repeats=16),
    "gravel": Pattern(patterns.gravel),
    "grass": Pattern(patterns.grass),
    "foliage": Pattern(patterns.foliage),
    "bark": Pattern(patterns.bark),
    "brick": Pattern(patterns.brick, repeats=8),
    "stones": Pattern(patterns.stones, repeats=6),
    "tiles": Pattern(patterns.tiles, repeats=8),
    "roof_tiles": Pattern(patterns.roof_tiles, repeats=16),
    "wood": Pattern(patterns.wood),
    "planks": Pattern(patterns.planks, repeats=8),
    "fabric": Pattern(patterns.fabric),
    "carpet": Pattern(patterns.carpet),
    "corrugated": Pattern(patterns.corrugated, repeats=16),
    "clouds": Pattern(patterns.clouds),
    "windows": Pattern(patterns.windows, repeats=4),
    "shuttered_windows": Pattern(patterns.shuttered_windows, repeats=4),
    "wide_windows": Pattern(patterns.wide_windows, repeats=4),
    "ribbon_windows": Pattern(patterns.ribbon_windows, repeats=4),
}


GAMMA = 2.2  # of pictures; what the renderers' own tone curve inverts
LINEAR = (np.arange(256, dtype=np.float32) / 255) ** np.float32(GAMMA)  # light of a picture's byte

_LEVEL_SIZES = (TILE >> np.arange(LEVELS)) ** 2
LEVEL_START = np.concatenate([[0], np.cumsum(_LEVEL_SIZES)[:-1]]).astype(np.int32)  # of each mip level in a texture

# Rows of mix, shade, gloss and nothing: all textures one after the other, each baked when it is first asked for.
TEXELS = np.zeros((len(PATTERNS) * _LEVEL_SIZES.sum(), 4), dtype=np.uint8)


def _mip_levels(tile: np.ndarray) -> np.ndarray:
    """A tile (TILE, TILE, 3) and its halvings down to one texel, one texel a row."""
    levels = [tile]
    while len(levels[-1]) > 1:
        side = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(side, 2, side, 2, 3).mean(axis=(1, 3)))
    return np.concatenate([level.reshape(-1, 3) for level in levels])


@cache
def texture_start(name: str) -> int:
    """Row of `TEXELS` where a pattern's texture starts; bakes it at the first call in a process, the same in all."""
    number = list(PATTERNS).index(name)
    texels = _mip_levels(PATTERNS[name].draw(np.random.default_rng(number)))
    start = number * len(texels)
    TEXELS[start : start + len(texels), :3] = np.rint(255 * texels)
    return start


def picture_texels(image: np.ndarray) -> np.ndarray:
    """A picture as a tile with its mip levels, averaged as light is.

    Args:
        image: Of any size, (H, W, 3) uint8, its highest row first.

    Returns:
        (R, 3) uint8, one texel a row as in `TEXELS`, the lowest row first.
    """
    shrinks = min(image.shape[:2]) >= TILE
    linear = LINEAR[np.ascontiguousarray(image[::-1])]
    tile = cv2.resize(linear, (TILE, TILE), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.rint(255 * _mip_levels(tile) ** (1 / GAMMA)).astype(np.uint8)


def palette_texels(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A picture that holds one texel for each colour, for faces that have a colour each.

    Args:
        colors: Of each face, (F, 3) uint8, to the same gamma as pictures.

    Returns:
        The texels, as those of `picture_texels`, and where each face's corners lie in them, (F, 3, 2).
    """
    bits = 8
    distinct, number = np.unique(colors, axis=0, return_inverse=True)
    while len(distinct) > TILE**2:  # coarser, until they fit
        bits -= 1
        distinct, number = np.unique(colors >> (8 - bits) << (8 - bits), axis=0, return_inverse=True)
    tile = np.zeros((TILE**2, 3), np.uint8)
    tile[: len(distinct)] = distinct
    row, column = np.divmod(number.ravel(), TILE)
    uv = (np.stack([column, row], axis=-1) + 0.5) / TILE
    levels = np.zeros((_LEVEL_SIZES.sum(), 3), np.uint8)
    levels[: TILE**2] = tile
    return levels, np.repeat(uv[:, None], 3, axis=1)
