"""Pictures on faces against barycentric coordinates and the physics of averaging."""

import numpy as np

from depthreg.rendering.pictures import texture_rows
from depthreg.worlds.textures import palette_texels, picture_texels


def test_texture_coordinates_are_affine_on_each_face() -> None:
    rng = np.random.default_rng(0)
    corners, uv = rng.uniform(-9, 9, (31, 3, 3)), rng.uniform(-3, 3, (31, 3, 2))
    share = rng.dirichlet(np.ones(3), 31)  # barycentric coordinates of a point on each face
    points, expected = (np.einsum("fc,fck->fk", share, values) for values in (corners, uv))
    rows = texture_rows(corners, uv)
    found = np.stack([np.einsum("kf,fk->f", rows[i : i + 3], points) + rows[i + 3] for i in (0, 4)], axis=-1)
    np.testing.assert_allclose((found - expected + 0.5) % 1, 0.5, atol=1e-6)  # but for whole tiles


def test_a_picture_keeps_its_light_in_every_mip_level() -> None:
    """A fine board of black and white is a grey of half the light from afar: 255 * 0.5 ** (1 / 2.2)."""
    board = np.uint8(255) * (np.indices((1024, 1024)).sum(axis=0)[..., None] // 2 % 2).astype(np.uint8)
    texels = picture_texels(np.repeat(board, 3, axis=2))
    assert len(texels) == sum(4**level for level in range(10))
    assert np.abs(texels[-1].astype(int) - 186).max() <= 1


def test_more_colours_than_a_palette_holds_are_rounded() -> None:
    colors = np.stack(np.unravel_index(np.arange(300_000) * 50, (256, 256, 256)), axis=-1).astype(np.uint8)
    texels, uv = palette_texels(colors)
    column, row = np.floor(uv[:, 0] * 512).astype(int).T
    assert np.abs(texels[512 * row + column].astype(int) - colors).max() <= 3
