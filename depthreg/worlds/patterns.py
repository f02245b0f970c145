"""Drawings of surface patterns: each makes one tile that continues across its own borders.

A drawing is a function (rng) -> (TILE, TILE, 3) float32 in [0, 1]. Its planes are `mix` (0 = the material's colour,
1 = its second colour), `shade` (0.5 leaves the brightness alone, 0 is black, 1 doubles it) and `gloss` (scales the
material's gloss). Columns run along u (across a wall, the world's x on level ground), rows along v (up a wall).
"""

import cv2
import numpy as np

TILE = 512  # texels along a tile's side


def stack(mix: np.ndarray | float, shade: np.ndarray | float, gloss: np.ndarray | float = 1.0) -> np.ndarray:
    """Put the three planes of a tile together, clipped to [0, 1]."""
    planes = [np.broadcast_to(np.asarray(p, dtype=np.float32), (TILE, TILE)) for p in (mix, shade, gloss)]
    return np.clip(np.stack(planes, axis=-1), 0, 1)


def fractal_noise(
    rng: np.random.Generator, octaves: range, roughness: float = 0.5, stretch: tuple[int, int] = (1, 1)
) -> np.ndarray:
    """Tileable value noise of zero mean and unit variance, (TILE, TILE).

    Args:
        rng: Source of the noise.
        octaves: Which octaves to add; octave k has 2^k cells along the tile.
        roughness: Amplitude of each octave relative to the one before.
        stretch: How many times fewer cells there are down the rows and along the columns: makes streaks.
    """
    noise = np.zeros((TILE, TILE), dtype=np.float32)
    for order, octave in enumerate(octaves):
        rows, columns = (max(2**octave // s, 1) for s in stretch)
        grid = np.pad(rng.standard_normal((rows, columns)).astype(np.float32), 2, mode="wrap")
        high, wide = TILE // rows, TILE // columns
        fine = cv2.resize(grid, None, fx=wide, fy=high, interpolation=cv2.INTER_CUBIC)
        noise += roughness**order * fine[2 * high : -2 * high, 2 * wide : -2 * wide]
    return (noise - noise.mean()) / noise.std()


def _grid() -> tuple[np.ndarray, np.ndarray]:
    line = (np.arange(TILE, dtype=np.float32) + 0.5) / TILE
    return line[None, :], line[:, None]


def _courses(
    rng: np.random.Generator, rows: int, columns: int, joint: tuple[float, float], bond: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Where the joints of laid stones are (bool), and a random number of unit variance for each stone."""
    u, v = _grid()
    row = np.floor(v * rows)
    across = u * columns + bond * (row % 2)
    joints = (np.abs(across % 1 - 0.5) > 0.5 - joint[0]) | (np.abs((v * rows) % 1 - 0.5) > 0.5 - joint[1])
    stone = rng.standard_normal((rows, columns))[row.astype(int), (np.floor(across) % columns).astype(int)]
    return joints, stone


def plain(rng: np.random.Generator) -> np.ndarray:
    """One colour."""
    return stack(0, 0.5)


def noise(rng: np.random.Generator) -> np.ndarray:
    """Soft blotches of both colours."""
    return stack(0.5 + 0.2 * fractal_noise(rng, range(2, 9), 0.6), 0.5 + 0.05 * fractal_noise(rng, range(5, 9), 0.8))


def checker(rng: np.random.Generator) -> np.ndarray:
    """Squares of the two colours in turn."""
    u, v = _grid()
    return stack((np.floor(u * 8) + np.floor(v * 8)) % 2, 0.5 + 0.02 * fractal_noise(rng, range(3, 9)))


def stripes(rng: np.random.Generator) -> np.ndarray:
    """Upright stripes of the two colours in turn."""
    u, _ = _grid()
    return stack(np.floor(u * 16) % 2, 0.5 + 0.02 * fractal_noise(rng, range(3, 9)))


def plaster(rng: np.random.Generator) -> np.ndarray:
    """Rendered wall: fine grain, faint stains that run down it."""
    grain, clouds = fractal_noise(rng, range(6, 10), 0.9), fractal_noise(rng, range(1, 6))
    runs = fractal_noise(rng, range(4, 8), 0.8, stretch=(8, 1))
    return stack(0.12 * (clouds + runs).clip(0), 0.5 + 0.015 * grain + 0.02 * clouds + 0.012 * runs)


def concrete(rng: np.random.Generator) -> np.ndarray:
    """Cast slabs with joints and stains."""
    joints, slab = _courses(rng, 4, 4, (0.008, 0.008), bond=0.0)
    stain = fractal_noise(rng, range(1, 9), 0.65)
    return stack(0.25 * stain.clip(0), 0.5 + 0.03 * stain + 0.02 * slab - 0.18 * joints)


def asphalt(rng: np.random.Generator) -> np.ndarray:
    """Stone grain, worn patches and a few cracks sealed with tar."""
    grain = fractal_noise(rng, range(6, 10), 1.1)
    wear = fractal_noise(rng, range(0, 5), 0.7)
    crack = np.exp(-((fractal_noise(rng, range(1, 7), 0.55) / 0.012) ** 2)) * (fractal_noise(rng, range(1, 3)) > 0.9)
    return stack(0.5 + 0.22 * wear, 0.5 + 0.08 * grain + 0.025 * wear - 0.2 * crack)


def paving(rng: np.random.Generator) -> np.ndarray:
    """Pavement slabs."""
    joints, slab = _courses(rng, 16, 16, (0.03, 0.03))
    grain = fractal_noise(rng, range(1, 9), 0.8)
    return stack(0.15 * slab.clip(0), 0.5 + 0.035 * slab + 0.04 * grain - 0.2 * joints)


def gravel(rng: np.random.Generator) -> np.ndarray:
    """Loose stones, bare soil."""
    grain = fractal_noise(rng, range(5, 10), 1.0)
    return stack(0.4 + 0.3 * fractal_noise(rng, range(1, 8), 0.7), 0.5 + 0.15 * grain)


def grass(rng: np.random.Generator) -> np.ndarray:
    """Short grass with dry (second colour) patches."""
    blades = fractal_noise(rng, range(5, 10), 1.0)
    patches = fractal_noise(rng, range(1, 7), 0.75)
    return stack(0.35 + 0.28 * patches + 0.08 * blades, 0.5 + 0.14 * blades + 0.06 * patches)


def foliage(rng: np.random.Generator) -> np.ndarray:
    """Leaves in clumps with dark gaps between them."""
    clumps, leaves = fractal_noise(rng, range(2, 6), 0.8), fractal_noise(rng, range(5, 9), 0.9)
    return stack(0.4 + 0.3 * leaves, 0.45 + 0.13 * clumps + 0.12 * leaves)


def bark(rng: np.random.Generator) -> np.ndarray:
    """Rough upright ridges."""
    ridges = fractal_noise(rng, range(4, 9), 0.9, stretch=(4, 1))
    return stack(0.4 + 0.3 * fractal_noise(rng, range(2, 6)), 0.5 + 0.13 * ridges)


def brick(rng: np.random.Generator) -> np.ndarray:
    """Bricks in running bond; the joints take the second colour."""
    joints, stone = _courses(rng, 24, 8, (0.03, 0.08))
    grain = fractal_noise(rng, range(1, 9), 0.9)
    return stack(0.8 * joints, 0.5 + np.where(joints, 0, 0.05 * stone) + 0.03 * grain)


def stones(rng: np.random.Generator) -> np.ndarray:
    """A wall of rough stone blocks."""
    joints, stone = _courses(rng, 12, 6, (0.03, 0.06))
    grain = fractal_noise(rng, range(2, 9), 0.85)
    return stack(0.35 + 0.2 * stone, 0.5 + 0.05 * stone + 0.06 * grain - 0.2 * joints)


def tiles(rng: np.random.Generator) -> np.ndarray:
    """Glazed square tiles; the joints take the second colour and don't shine."""
    joints, tile = _courses(rng, 8, 8, (0.02, 0.02), bond=0.0)
    return stack(joints, 0.5 + np.where(joints, 0, 0.012 * tile), ~joints)


def roof_tiles(rng: np.random.Generator) -> np.ndarray:
    """Overlapping roof tiles, lighter towards their lower edge."""
    _, v = _grid()
    joints, tile = _courses(rng, 16, 16, (0.06, 0.0))
    moss = fractal_noise(rng, range(1, 8), 0.7)
    return stack(0.3 * moss.clip(0), 0.5 + 0.05 * tile - 0.16 * ((v * 16) % 1) ** 3 - 0.1 * joints + 0.05 * moss)


def wood(rng: np.random.Generator) -> np.ndarray:
    """Grain along u."""
    _, v = _grid()
    fibre = fractal_noise(rng, range(4, 10), 0.9, stretch=(1, 16))
    rings = np.sin(2 * np.pi * (10 * v + 0.35 * fractal_noise(rng, range(1, 5), stretch=(1, 2))))
    return stack(0.4 + 0.22 * rings + 0.1 * fibre, 0.5 + 0.03 * fibre)


def planks(rng: np.random.Generator) -> np.ndarray:
    """Boards along u with gaps between them."""
    joints, board = _courses(rng, 8, 2, (0.004, 0.03))
    fibre = fractal_noise(rng, range(4, 10), 0.9, stretch=(1, 16))
    return stack(0.4 + 0.25 * board + 0.12 * fibre, 0.5 + 0.03 * board + 0.03 * fibre - 0.25 * joints)


def fabric(rng: np.random.Generator) -> np.ndarray:
    """Woven cloth with soft folds."""
    u, v = _grid()
    weave = np.sin(2 * np.pi * 64 * u) * np.sin(2 * np.pi * 64 * v)
    return stack(0.25 + 0.15 * weave, 0.5 + 0.02 * weave + 0.02 * fractal_noise(rng, range(1, 5)))


def carpet(rng: np.random.Generator) -> np.ndarray:
    """Short pile."""
    pile = fractal_noise(rng, range(6, 10), 1.1)
    return stack(0.4 + 0.15 * pile, 0.5 + 0.04 * pile + 0.02 * fractal_noise(rng, range(1, 5)))


def corrugated(rng: np.random.Generator) -> np.ndarray:
    """Sheet metal with upright ribs."""
    u, _ = _grid()
    rust = fractal_noise(rng, range(1, 8), 0.7, stretch=(2, 1))
    return stack(0.1 * rust.clip(0), 0.5 + 0.09 * np.sin(2 * np.pi * 16 * u) + 0.015 * rust)


def clouds(rng: np.random.Generator) -> np.ndarray:
    """Cloud thickness in `mix`, its shaded side in `shade`."""
    thickness = fractal_noise(rng, range(1, 9), 0.55)
    return stack(0.5 + 0.2 * thickness, 0.5 - 0.06 * thickness)


def _windows(
    rng: np.random.Generator, half_width: float, bottom: float, top: float, bars: int, shutters: bool
) -> np.ndarray:
    """Four by four bays, each with a window of `bars` panes; the panes take the second colour and shine."""
    u, v = (4 * axis for axis in _grid())
    bay = np.floor(v).astype(int), np.floor(u).astype(int)
    across, up = u % 1 - 0.5, v % 1
    side, frame = np.abs(across), 0.025
    opening = (side < half_width) & (up > bottom) & (up < top)
    pane = (side < half_width - frame) & (up > bottom + frame) & (up < top - frame)
    pane &= np.abs((across / (2 * half_width) * bars + 0.5 * (bars % 2)) % 1 - 0.5) < 0.5 - 0.4 * frame * bars
    # Curtains and blinds: some panes are lighter, some from above only.
    drawn = top - (top - bottom) * rng.choice([0, 0, 0.2, 0.4, 1.0], (4, 4))[bay]
    shade = 0.5 + 0.02 * fractal_noise(rng, range(1, 9), 0.8) + 0.018 * fractal_noise(rng, range(3, 8), 0.8, (8, 1))
    shade = np.where(opening & ~pane, 0.72, shade)  # window frames are light
    shade = np.where(pane, 0.42 + 0.1 * rng.standard_normal((4, 4))[bay] + 0.25 * (up > drawn), shade)
    sill = (side < half_width + 0.04) & (up > bottom - 0.035) & (up <= bottom)
    shade = np.where(sill, 0.6, shade)
    shade = np.where((side < half_width + 0.03) & (up > bottom - 0.07) & (up <= bottom - 0.035), 0.36, shade)
    mix = pane * np.where(up > drawn, 0.55, 1.0)
    if shutters:
        leaf = (side > half_width) & (side < 1.9 * half_width) & (up > bottom) & (up < top)
        mix, shade = np.where(leaf, 0.6, mix), np.where(leaf, 0.45 + 0.12 * (np.floor(up * 40) % 2), shade)
    return stack(mix, shade, pane)


def windows(rng: np.random.Generator) -> np.ndarray:
    """Rendered house front: one window in a bay."""
    return _windows(rng, half_width=0.19, bottom=0.3, top=0.8, bars=2, shutters=False)


def shuttered_windows(rng: np.random.Generator) -> np.ndarray:
    """House front with shutters beside the windows."""
    return _windows(rng, half_width=0.15, bottom=0.28, top=0.8, bars=2, shutters=True)


def wide_windows(rng: np.random.Generator) -> np.ndarray:
    """Block of flats: broad windows, three panes each."""
    return _windows(rng, half_width=0.36, bottom=0.32, top=0.82, bars=3, shutters=False)


def ribbon_windows(rng: np.random.Generator) -> np.ndarray:
    """Office block: unbroken bands of glass."""
    return _windows(rng, half_width=0.51, bottom=0.3, top=0.85, bars=2, shutters=False)
