"""Shadows darken straight bands, reflections add structure, contrast fades; truth, depth and the other samples stay."""

import numpy as np
import pytest
import torch

from depthreg.data.sample import Measurement
from depthreg.distractors import CLEAREST, DARKEST, FAINTEST, add_distractors, shade
from depthreg.sensors.simulator import seeded_generator


def _measurement(batch: int = 3) -> Measurement:
    rgb = torch.rand(batch, 3, 64, 96, generator=seeded_generator(0))
    return Measurement(rgb=rgb, truth_rgb=rgb.clone(), depth_m=torch.ones(batch, 1, 64, 96))


def _generators(batch: int = 3, seed: int = 1) -> list[torch.Generator]:
    return [seeded_generator(seed, index) for index in range(batch)]


def test_a_shadow_is_a_straight_band_of_the_given_darkness() -> None:
    light = shade((64, 96), [(0.0, 0.5, 0.5, 1.0)])  # upright, in the middle, 0.125 of the width broad
    expected = np.ones((64, 96), np.float32)
    expected[:, np.abs(np.arange(96) / 96 - 0.5) < 0.0625] = 1 - DARKEST
    np.testing.assert_allclose(light.numpy(), expected, atol=1e-6)


def test_where_shadows_meet_both_take_their_share() -> None:
    light = shade((64, 64), [(0.0, 0.5, 1.0, 0.4), (0.5, 0.5, 1.0, 0.8)])
    levels = sorted({round(float(level), 4) for level in light.unique()})
    one, other = 1 - 0.4 * DARKEST, 1 - 0.8 * DARKEST
    np.testing.assert_allclose(levels, sorted([one * other, one, other, 1]), atol=1e-3)


def test_everybodys_chance_makes_the_colour_differ_and_nothing_else() -> None:
    before = _measurement()
    after = add_distractors(before, _generators(), share=1.0)
    assert ((after["rgb"] - before["rgb"]).abs().amax(dim=(1, 2, 3)) > 0.05).all()
    assert after["rgb"].min() >= 0 and after["rgb"].max() <= 1
    assert after["truth_rgb"] is before["truth_rgb"] and after["depth_m"] is before["depth_m"]
    torch.testing.assert_close(before["rgb"], before["truth_rgb"])


def test_no_share_leaves_everything_as_it_is() -> None:
    before = _measurement()
    assert add_distractors(before, _generators(), share=0.0) is before


@pytest.mark.parametrize("seed", range(3))
def test_a_frame_is_distracted_alike_whatever_its_batch(seed: int) -> None:
    batch = _measurement()
    together = add_distractors(batch, _generators(seed=seed), share=0.5)["rgb"]
    alone = add_distractors(Measurement(rgb=batch["rgb"][1:2]), _generators(seed=seed)[1:2], share=0.5)["rgb"]
    torch.testing.assert_close(together[1], alone[0])


def test_reflections_stay_fainter_than_what_they_cover() -> None:
    white_above = torch.zeros(1, 3, 64, 96)
    white_above[:, :, :32] = 1
    reflected = [
        add_distractors(Measurement(rgb=white_above), _generators(1, seed), share=1.0)["rgb"] for seed in range(20)
    ]
    assert max(float(rgb[:, :, 32:].max() - rgb[:, :, 32:].min()) for rgb in reflected) <= CLEAREST


def test_contrast_fades_in_some_and_is_never_gone() -> None:
    chequered = torch.zeros(1, 3, 64, 96)
    chequered[..., ::2, ::2] = 1
    spans = []
    for seed in range(40):
        rgb = add_distractors(Measurement(rgb=chequered), _generators(1, seed), share=0.3)["rgb"]
        spans.append(float(rgb.max() - rgb.min()))
    assert min(spans) >= (1 - FAINTEST) * (1 - DARKEST) ** 3 and 1.0 in spans
    assert sum(span < 0.9 for span in spans) > 5
