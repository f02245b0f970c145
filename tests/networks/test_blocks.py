"""The shared layers, against plain formulations and closed forms."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.interpolate import RBFInterpolator
from torch import Tensor

from depthreg.networks.blocks import CMRF, fill_nearest, fill_smoothly, nearest_valid, upsample_to

Fill = Callable[[Tensor, Tensor], Tensor]
AVERAGES = [fill_nearest, fill_smoothly]
fill_plate = partial(fill_smoothly, plate_steps=8)
FILLS = [*AVERAGES, fill_plate]


def seeded(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


def trained_looking(block: CMRF) -> CMRF:
    """Statistics and scales far from their initial values, so that a forgotten normalisation shows."""
    for i, module in enumerate(block.modules()):
        if isinstance(module, torch.nn.BatchNorm2d):
            generator = torch.Generator().manual_seed(i)
            for tensor in (module.running_mean, module.running_var, module.weight.data, module.bias.data):
                tensor.copy_(0.5 + torch.rand(tensor.shape, generator=generator))
    return block.eval()


def published_cmrf(block: CMRF, x: Tensor) -> Tensor:
    """TinyU-Net's block as its paper writes it: one input, concatenated and enlarged beforehand."""

    def normalize(x: Tensor, norm: torch.nn.Module) -> Tensor:
        return F.batch_norm(x, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=1e-3)

    narrow = F.gelu(normalize(F.conv2d(x, block.reduce.weight), block.normalize[0]))
    even, odd = narrow[:, 0::2], narrow[:, 1::2]
    seen = [even + odd]
    for convolution, norm in block.cascade:
        odd = normalize(F.conv2d(odd, convolution.weight, padding=1, groups=odd.shape[1]), norm)
        seen.append(odd)
    out = F.gelu(normalize(F.conv2d(torch.cat(seen, 1), block.expand[0].weight), block.expand[1]))
    return out + x if x.shape[1] == out.shape[1] else out


@pytest.mark.parametrize("channels", [(5, 32), (32, 32), (48, 16)])
def test_the_block_computes_what_the_paper_writes(channels: tuple[int, int]) -> None:
    block = trained_looking(CMRF(*channels))
    x = seeded(2, channels[0], 9, 11)
    torch.testing.assert_close(block(x), published_cmrf(block, x), atol=1e-5, rtol=1e-5)


def test_parts_give_what_their_concatenation_gives() -> None:
    block = trained_looking(CMRF(24 + 16 + 3, 16))
    below, skip, extra = seeded(2, 24, 5, 7), seeded(2, 16, 10, 14), seeded(2, 3, 10, 14)
    enlarged = F.interpolate(below, scale_factor=2, mode="bilinear", align_corners=False)
    expected = published_cmrf(block, torch.cat([enlarged, skip, extra], dim=1))
    torch.testing.assert_close(block(below, skip, extra), expected, atol=1e-5, rtol=1e-5)


def test_a_width_that_does_not_split_into_the_cascade_is_refused() -> None:
    with pytest.raises(ValueError, match=r"out_channels.*16.*24"):
        CMRF(3, 24)


def test_upsampling_keeps_a_constant_and_takes_the_others_size() -> None:
    out = upsample_to(torch.full((1, 2, 3, 5), 4.5), torch.zeros(1, 1, 7, 11))
    torch.testing.assert_close(out, torch.full((1, 2, 7, 11), 4.5))


@pytest.mark.parametrize("fill", AVERAGES)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (17, 33), (64, 97)])
@pytest.mark.parametrize("share", [0.01, 0.2, 1.0])
def test_filling_keeps_what_is_valid_and_invents_nothing_beyond_it(
    fill: Fill, size: tuple[int, int], share: float
) -> None:
    values, valid = 3 + 5 * seeded(2, 1, *size), seeded(2, 1, *size).flip(-1) < share
    valid[..., 0, 0] = True
    filled = fill(values, valid)
    torch.testing.assert_close(filled[valid], values[valid])
    for image, known, mask in zip(filled, values, valid, strict=True):
        assert known[mask].min() - 1e-5 <= image.min() and image.max() <= known[mask].max() + 1e-5


@pytest.mark.parametrize("fill", FILLS)
def test_filling_ignores_what_invalid_pixels_hold(fill: Fill) -> None:
    values, valid = seeded(1, 1, 19, 23), seeded(1, 1, 19, 23) < 0.5
    garbage = torch.where(valid, values, 1e6)
    torch.testing.assert_close(fill(garbage, valid), fill(values, valid))


@pytest.mark.parametrize("fill", FILLS)
def test_a_constant_field_stays_constant(fill: Fill) -> None:
    valid = seeded(1, 1, 37, 53) < 0.02
    torch.testing.assert_close(fill(torch.full(valid.shape, 7.25), valid), torch.full(valid.shape, 7.25))


@pytest.mark.parametrize("fill", FILLS)
def test_without_a_valid_pixel_everything_is_zero(fill: Fill) -> None:
    values, valid = seeded(2, 1, 13, 21), torch.zeros(2, 1, 13, 21, dtype=torch.bool)
    valid[1] = True
    filled = fill(values, valid)
    assert (filled[0] == 0).all()
    torch.testing.assert_close(filled[1], values[1])


@pytest.mark.parametrize("fill", AVERAGES)
def test_one_hole_takes_the_mean_of_its_block(fill: Fill) -> None:
    values, valid = torch.tensor([[1.0, 2.0], [6.0, 99.0]])[None, None], torch.ones(1, 1, 2, 2).bool()
    valid[..., 1, 1] = False
    assert fill(values, valid)[0, 0, 1, 1].item() == pytest.approx(3.0)


def scattered(surface: np.ndarray, share: float) -> tuple[Tensor, Tensor]:
    """A surface and where it was measured."""
    valid = np.random.default_rng(0).random(surface.shape) < share
    return torch.from_numpy(surface.astype(np.float32))[None, None], torch.from_numpy(valid)[None, None]


@pytest.mark.parametrize("share", [0.005, 0.02, 0.1])
def test_a_thin_plate_leans_like_the_plane_that_holds_it(share: float) -> None:
    y, x = np.mgrid[:96, :128]
    plane, valid = scattered(3 + 0.02 * x - 0.03 * y, share)
    inside = np.s_[..., 16:-16, 16:-16]  # within what was measured
    off, off_averages = ((fill(plane, valid) - plane)[inside].abs().mean() for fill in (fill_plate, fill_smoothly))
    assert off < 0.5 * off_averages


@pytest.mark.parametrize("share", [0.005, 0.02])
def test_a_thin_plate_bends_as_scipys_does(share: float) -> None:
    y, x = np.mgrid[:96, :128]
    surface, valid = scattered(2 + np.sin(x / 25) * np.cos(y / 30), share)
    points = np.stack(np.nonzero(valid[0, 0].numpy()), axis=-1)
    exact = RBFInterpolator(points, surface[valid].numpy(), kernel="thin_plate_spline")
    everywhere = exact(np.stack([y, x], axis=-1).reshape(-1, 2)).reshape(y.shape)
    off, off_averages = (
        np.abs(fill(surface, valid)[0, 0].numpy() - everywhere)[16:-16, 16:-16].mean()
        for fill in (fill_plate, fill_smoothly)
    )
    assert off < 0.5 * off_averages
    torch.testing.assert_close(fill_plate(surface, valid)[valid], surface[valid])


@pytest.mark.parametrize("share", [0.002, 0.05, 0.6])
def test_the_nearest_valid_value_is_what_a_distance_transform_finds(share: float) -> None:
    valid = np.random.default_rng(1).random((37, 53)) < share
    valid[5, 40] = True
    values = np.random.default_rng(2).random(valid.shape).astype(np.float32)
    distance = ndimage.distance_transform_edt(~valid)
    found = nearest_valid(torch.from_numpy(values)[None, None], torch.from_numpy(valid)[None, None])
    ours, ours_distance = (image[0, 0].numpy() for image in found)
    # Where two neighbours are equally near, either may be taken; jump flooding misses a few pixels besides.
    rows, columns = np.nonzero(valid)
    y, x = np.mgrid[: valid.shape[0], : valid.shape[1]]
    reach = np.hypot(y[..., None] - rows, x[..., None] - columns)
    taken = np.abs(values[rows, columns] - ours[..., None]).argmin(axis=-1)
    excess = np.take_along_axis(reach, taken[..., None], axis=-1)[..., 0] - distance
    assert (excess < 1e-4).mean() > 0.99 and excess.max() < 2
    np.testing.assert_allclose(np.sqrt(ours_distance), distance + excess, atol=1e-3)


def test_far_from_any_value_the_filling_has_no_edge() -> None:
    values, valid = torch.zeros(1, 1, 64, 128), torch.zeros(1, 1, 64, 128, dtype=torch.bool)
    values[..., -1, :64], values[..., -1, 64:] = 1.0, 2.0
    valid[..., -1, :] = True
    filled = fill_nearest(values, valid)[0, 0]
    assert filled[-4].diff().abs().max() > 0.4  # crisp beside the values
    assert filled[4].diff().abs().max() < 0.1


@pytest.mark.parametrize("fill", FILLS)
def test_a_hole_is_filled_much_as_its_nearest_neighbour_would(fill: Fill) -> None:
    y, x = np.mgrid[:48, :80].astype(np.float32)
    surface = 10 + 0.05 * x + 0.1 * y
    valid = np.random.default_rng(0).random(surface.shape) < 0.1
    nearest = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    by_neighbour = np.abs(surface[tuple(nearest)] - surface).mean()
    filled = fill(torch.from_numpy(surface)[None, None], torch.from_numpy(valid)[None, None])[0, 0].numpy()
    assert np.abs(filled - surface).mean() < 1.5 * by_neighbour


@pytest.mark.parametrize("fill", FILLS)
def test_filling_gives_finite_slopes_where_nothing_is_valid(fill: Fill) -> None:
    values = seeded(1, 1, 8, 9).requires_grad_()
    fill(values, torch.zeros(1, 1, 8, 9, dtype=torch.bool)).sum().backward()
    assert values.grad.isfinite().all()
