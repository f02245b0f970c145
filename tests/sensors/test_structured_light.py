"""Structured light against Nguyen's and Khoshelham's figures, closed forms and loops."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch
from depthreg.errors import InputError
from depthreg.sensors import StructuredLight
from depthreg.sensors.fields import blotches, correlated_noise
from depthreg.sensors.structured_light import (
    agreeing_share,
    axial_sigma_m,
    lateral_sigma_px,
    projector_shadow,
    quantise,
)
from depthreg.sensors.windows import look_up

MakeFrames = Callable[..., FrameBatch]
NO_SHADOW_FOCAL_PX = 1.0  # a frame so coarse that shadows are narrower than a pixel


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def walls(*depths_m: float, height: int = 61, width: int = 93) -> Tensor:
    return torch.tensor(depths_m, dtype=torch.float32)[:, None, None, None].expand(-1, 1, height, width).clone()


@pytest.mark.parametrize(("depth_m", "nguyen_mm"), [(1.0, 1.884), (2.0, 6.064), (3.5, 19.459)])
def test_noise_on_a_wall_is_nguyens(depth_m: float, nguyen_mm: float, make_surface: MakeFrames) -> None:
    truth_m = walls(*np.linspace(0.97 * depth_m, 1.03 * depth_m, 24))  # so that rounding meets every phase
    measured_m = StructuredLight()(make_surface(truth_m), 1.0, generator())[..., 8:-8, 8:-8]  # corners see few dots
    assert (measured_m > 0).all()
    error_mm = 1e3 * (measured_m - truth_m[..., 8:-8, 8:-8])
    assert error_mm.std().item() == pytest.approx(nguyen_mm, rel=0.1)
    assert abs(error_mm.mean().item()) < 0.1 * nguyen_mm


def test_disparities_are_whole_eighths_of_a_pixel(make_surface: MakeFrames) -> None:
    measured_m = StructuredLight()(make_surface(walls(0.8, 1.7, 3.1)), 1.0, generator())
    eighths = 8 * 580 * 0.075 / measured_m[measured_m > 0]
    assert len(eighths.round().unique()) > 10
    assert (eighths - eighths.round()).abs().max() < 0.01


def test_rounding_leaves_at_least_one_step() -> None:
    assert quantise(torch.tensor([-1.0, 0.01, 0.2, 5.07]), 0.125).tolist() == [0.125, 0.125, 0.25, 5.125]


def test_nguyens_formulas_at_angles_of_his_paper() -> None:
    angles = torch.tensor([0.0, math.pi / 4, math.radians(80)])
    # 0.8 + 0.035 a / (90 - a) in degrees, as a ratio
    torch.testing.assert_close(lateral_sigma_px(angles), torch.tensor([0.8, 0.835, 1.08]))
    at_2m = torch.full((3,), 2.0)
    grazing = 0.0001 / math.sqrt(2) * 8**2
    torch.testing.assert_close(axial_sigma_m(at_2m, angles), torch.tensor([0.006064, 0.006064, 0.006064 + grazing]))


def test_a_shadow_is_as_wide_as_parallax_and_lies_to_the_left() -> None:
    """f b (1 / near - 1 / far) = 525 * 0.075 * (1 - 1/2) = 19.7 px."""
    depth_m = walls(2.0, width=93)
    depth_m[..., 50:70] = 1.0
    dark = projector_shadow(depth_m, torch.full((1, 1, 1, 1), 525 * 0.075))
    columns = dark[0, 0, 7].nonzero().flatten().tolist()
    assert columns in (list(range(31, 50)), list(range(30, 50)))


def test_shadows_agree_with_rays_traced_one_by_one() -> None:
    """A point is dark where the straight line from the projector to it passes behind something that the camera sees."""
    rng = np.random.default_rng(3)
    depth_m = np.repeat(rng.uniform(1, 3, 12), 5)
    focal_baseline = 12.3
    at_projector = np.arange(60) - focal_baseline / depth_m
    expected = [any(at_projector[k] < at_projector[i] for k in range(i + 1, 60)) for i in range(60)]
    dark = projector_shadow(
        torch.tensor(depth_m, dtype=torch.float32)[None, None, None], torch.full((1, 1, 1, 1), focal_baseline)
    )
    assert dark[0, 0, 0].tolist() == expected and 0 < sum(expected) < 60


def test_dots_agree_as_often_as_a_loop_counts_them() -> None:
    disparity_px = (torch.rand(1, 1, 13, 17, generator=generator()) * 3).round() * 2
    lit = torch.rand(1, 1, 13, 17, generator=generator(1)) < 0.8
    share = agreeing_share(disparity_px, lit, 1.0)[0, 0]
    for y, x in np.ndindex(13, 17):
        dots = [(y + dy, x + dx) for dy in (-3, 0, 3) for dx in (-3, 0, 3)]
        inside = [(v, u) for v, u in dots if 0 <= v < 13 and 0 <= u < 17 and lit[0, 0, v, u]]
        agreeing = sum(bool(disparity_px[0, 0, v, u] == disparity_px[0, 0, y, x]) for v, u in inside)
        assert share[y, x].item() == pytest.approx(agreeing / 9)


def test_what_is_thinner_than_the_dots_are_apart_vanishes(make_surface: MakeFrames) -> None:
    depth_m = walls(2.0)
    depth_m[..., 20:22], depth_m[..., 50:62] = 1.0, 1.0
    frames = make_surface(depth_m, focal_px=NO_SHADOW_FOCAL_PX)
    frames["normal"] = -torch.nn.functional.normalize(torch.ones(1, 3, 61, 93), dim=1)
    still = StructuredLight(baseline_m=0.075, min_signal=0.0, max_signal=math.inf)
    seen = still._matched(frames, 43.5 / depth_m, torch.ones_like(depth_m), 1.0, generator())
    assert not seen[..., 5:-5, 20:22].any()
    assert seen[..., 5:-5, 50:62].all()


def test_an_upright_outline_is_as_ragged_as_nguyen_measured(make_surface: MakeFrames) -> None:
    """0.8 px, and the nearest pixel's 1 / sqrt(12) on top; dots move together, so rows are taken far apart."""
    depth_m = walls(1.0, 1.0, 1.0, 1.0, height=361)
    depth_m[..., 46:] = 1.5  # what is far lies to the right: no shadow
    measured_m = StructuredLight(min_agreeing_share=0.0)(make_surface(depth_m, focal_px=1e4), 1.0, generator())
    outline_px = (measured_m < 1.25).sum(dim=-1).float()[:, 0, ::6]
    assert outline_px.mean().item() == pytest.approx(46, abs=0.3)
    assert outline_px.std().item() == pytest.approx(math.hypot(0.8, 1 / math.sqrt(12)), rel=0.25)


def test_a_look_up_takes_the_nearest_pixel_and_stays_inside() -> None:
    image = torch.arange(20.0).view(1, 1, 4, 5)
    shift_px = torch.stack([torch.full((4, 5), 1.4), torch.full((4, 5), -0.6)])[None]
    expected = [[image[0, 0, max(y - 1, 0), min(x + 1, 4)].item() for x in range(5)] for y in range(4)]
    assert look_up(image, shift_px)[0, 0].tolist() == expected


@pytest.mark.parametrize(
    ("depth_m", "albedo", "gloss", "seen"),
    [
        (1.0, 0.9, 0.0, True),
        (4.0, 0.9, 0.0, True),
        (4.0, 0.004, 0.0, False),
        (1.0, 0.9, 0.3, False),
        (0.4, 0.9, 0.0, False),
    ],
)
def test_dark_polished_and_near_surfaces_drop_out(
    depth_m: float, albedo: float, gloss: float, seen: bool, make_surface: MakeFrames
) -> None:
    measured_m = StructuredLight()(make_surface(walls(depth_m), albedo, gloss), 1.0, generator())
    assert (measured_m > 0).float().mean().item() == pytest.approx(float(seen), abs=0.02)


def test_a_polished_surface_seen_aslant_mirrors_nothing_back(make_surface: MakeFrames) -> None:
    frames = make_surface(walls(1.0), albedo=0.9, gloss=0.3)
    frames["normal"] = torch.tensor([0.6, 0, -0.8])[:, None, None].expand(1, 3, 61, 93)
    assert (StructuredLight()(frames, 1.0, generator())[..., 8:-8, 8:-8] > 0).all()


def test_errors_and_holes_grow_with_the_difficulty(make_surface: MakeFrames) -> None:
    depth_m = walls(*np.linspace(2, 4, 12))
    depth_m[..., 40:60] -= 1
    frames = make_surface(depth_m, albedo=0.1, focal_px=525.0)
    measured = [
        StructuredLight(min_signal=0.05)(frames, difficulty, generator()) for difficulty in (0.1, 0.4, 0.7, 1.0)
    ]
    holes = [(m == 0).float().mean().item() for m in measured]
    errors = [(m - depth_m)[m > 0].abs().median().item() for m in measured]
    assert holes == sorted(holes) and holes[0] < 0.05 < holes[-1]
    assert errors == sorted(errors) and errors[0] < 0.2 * errors[-1]


def test_noise_fields_have_unit_variance_and_the_stated_reach() -> None:
    noise = correlated_noise(torch.Size([60, 1, 37, 53]), generator(), torch.device("cpu"))
    assert noise.var().item() == pytest.approx(1, abs=0.05) and noise[..., 0, 0].var().item() == pytest.approx(
        1, abs=0.6
    )
    kernel = np.array([1, 2, 3, 3, 3, 2, 1])
    expected = [(kernel[k:] * kernel[: 7 - k]).sum() / (kernel**2).sum() for k in (1, 3)]
    found = [(noise[..., k:] * noise[..., :-k]).mean().item() for k in (1, 3)]
    np.testing.assert_allclose(found, expected, atol=0.05)
    patches = blotches(torch.Size([60, 2, 37, 53]), 6.0, generator(), torch.device("cpu"))
    assert patches.shape == (60, 2, 37, 53) and patches.var().item() == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("wrong", [{"baseline_m": 0.0}, {"min_agreeing_share": 1.2}, {"step_px": "fine"}])
def test_an_instrument_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"sensor.{next(iter(wrong))}="):
        StructuredLight(**wrong)
