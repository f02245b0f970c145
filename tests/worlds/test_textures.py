import numpy as np
import pytest

from depthreg.worlds import patterns, textures

NAMES = sorted(textures.PATTERNS)


def _tile(name: str) -> np.ndarray:
    return textures.PATTERNS[name].draw(np.random.default_rng(list(textures.PATTERNS).index(name)))


@pytest.mark.parametrize("name", NAMES)
def test_a_tile_continues_across_its_own_border(name: str) -> None:
    tile = _tile(name)
    inner = max(np.abs(np.diff(tile, axis=axis)).mean(axis=(0, 1)).max() for axis in (0, 1))
    worst_line = max(
        np.abs(np.diff(tile, axis=0)).mean(axis=(1, 2)).max(), np.abs(np.diff(tile, axis=1)).mean(axis=(0, 2)).max()
    )
    seams = np.abs(tile[0] - tile[-1]).mean(), np.abs(tile[:, 0] - tile[:, -1]).mean()
    assert max(seams) <= 1.5 * max(worst_line, inner) + 1e-3


@pytest.mark.parametrize("name", NAMES)
def test_tiles_stay_in_range_and_keep_brightness_about_even(name: str) -> None:
    tile = _tile(name)
    assert tile.shape == (textures.TILE, textures.TILE, 3)
    assert tile.min() >= 0 and tile.max() <= 1
    assert tile[..., 1].mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("name", ["brick", "grass", "windows"])
def test_every_mip_level_keeps_the_mean(name: str) -> None:
    start = textures.texture_start(name)
    mean = _tile(name).mean(axis=(0, 1))
    for level, offset in enumerate(textures.LEVEL_START):
        size = (textures.TILE >> level) ** 2
        texels = textures.TEXELS[start + offset : start + offset + size, :3] / 255
        np.testing.assert_allclose(texels.mean(axis=0), mean, atol=0.004)


def test_the_coarsest_level_is_one_texel_and_textures_do_not_overlap() -> None:
    assert textures.TILE >> (textures.LEVELS - 1) == 1
    starts = sorted(textures.texture_start(name) for name in NAMES)
    length = textures.LEVEL_START[-1] + 1
    assert np.diff(starts).min() == length
    assert starts[-1] + length == len(textures.TEXELS)


def test_noise_has_zero_mean_and_unit_variance_and_depends_on_the_generator() -> None:
    noise = patterns.fractal_noise(np.random.default_rng(3), range(2, 6))
    assert noise.mean() == pytest.approx(0, abs=1e-5)
    assert noise.std() == pytest.approx(1, abs=1e-5)
    np.testing.assert_array_equal(noise, patterns.fractal_noise(np.random.default_rng(3), range(2, 6)))
    assert np.abs(noise - patterns.fractal_noise(np.random.default_rng(4), range(2, 6))).mean() > 0.5


def test_checkers_are_half_and_half() -> None:
    assert _tile("checker")[..., 0].mean() == pytest.approx(0.5)


def test_a_brick_wall_has_the_bricks_that_its_repeats_say() -> None:
    mix = _tile("brick")[..., 0]
    row_of_bricks = mix[textures.TILE // 48]  # the middle of the first course
    joints = (np.diff((row_of_bricks > 0.4).astype(int)) == 1).sum()
    assert joints + (row_of_bricks[0] > 0.4) * (row_of_bricks[-1] <= 0.4) == textures.PATTERNS["brick"].repeats
