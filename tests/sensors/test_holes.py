"""Missing patches and pixels."""

from collections.abc import Callable

import pytest
import torch

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.sensors import Holes
from depthreg.sensors.holes import random_patches

MakeFrames = Callable[..., FrameBatch]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_single_pixels_go_missing_at_the_stated_rate(make_frames: MakeFrames) -> None:
    frames = make_frames(batch=4)
    measured_m = Holes(patches=0, missing_share=0.6)(frames, 0.5, generator())
    assert (measured_m == 0).float().mean().item() == pytest.approx(0.3, abs=0.01)


def test_what_is_left_is_the_truth(make_frames: MakeFrames) -> None:
    frames = make_frames()
    measured_m = Holes()(frames, 0.4, generator())
    kept = measured_m > 0
    assert kept.any() and not kept.all()
    assert torch.equal(measured_m[kept], frames["depth_m"][kept])


def test_patches_cover_no_more_than_their_ellipses_could() -> None:
    height, width, count, radius = 61, 93, 3, 0.2
    patches = random_patches(200, (height, width), count, radius, generator())
    assert patches.shape == (200, 1, height, width) and patches.dtype == torch.bool
    largest_px = count * torch.pi * (radius * height) ** 2
    area_px = patches.flatten(1).sum(dim=1)
    assert area_px.max() <= largest_px * 1.1 and area_px.min() > 0
    assert len({tuple(area) for area in patches[:5].flatten(1).int().tolist()}) == 5


def test_a_patch_is_one_piece_with_holes_nowhere() -> None:
    for patch in random_patches(20, (61, 93), 1, 0.3, generator())[:, 0]:
        for row in patch:
            assert row.int().diff().abs().sum() <= 2  # an ellipse is convex


def test_rough_outlines_stray_from_ellipses_and_cover_about_as_much() -> None:
    smooth, rough = (random_patches(300, (61, 93), 1, 0.3, generator(), roughness) for roughness in (0.0, 0.8))
    assert rough.float().mean().item() == pytest.approx(smooth.float().mean().item(), rel=0.25)
    assert (smooth ^ rough).float().mean() > 0.1 * smooth.float().mean()
    changes = rough.int().diff(dim=-1).abs().sum(dim=-1)
    assert (changes > 2).any()  # rows that leave the patch and come back


@pytest.mark.parametrize("wrong", [{"patches": -1}, {"missing_share": 1.5}, {"roughness": -0.1}])
def test_holes_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"sensor.{next(iter(wrong))}="):
        Holes(**wrong)
