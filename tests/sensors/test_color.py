"""A camera's flaws, against closed forms, SciPy's filters, Pillow's JPEG and kornia's table of black bodies."""

import io
from dataclasses import fields

import numpy as np
import pytest
import torch
from kornia.augmentation._2d.intensity.planckian_jitter import get_planckian_coeffs
from PIL import Image
from scipy.ndimage import gaussian_filter
from torch import Tensor

from depthreg.data.sample import Measurement
from depthreg.errors import InputError
from depthreg.geometry import identity_affine
from depthreg.sensors import ColorCamera
from depthreg.sensors.color import blur_kernels, sensor_noise, temperature_gains, vignetting
from depthreg.sensors.reflection import view_rays

K = torch.tensor([[80.0, 0, 44], [0, 80, 31], [0, 0, 1]])
GAMMA = 2.2


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def measurement(rgb: Tensor) -> Measurement:
    batch, _, height, width = rgb.shape
    return Measurement(
        rgb=rgb,
        intrinsics=K.repeat(batch, 1, 1),
        truth_depth_m=torch.full((batch, 1, height, width), 20.0),
        truth_affine_rgb_from_depth=identity_affine(batch),
    )


def grey(batch: int, level: float = 0.4) -> Measurement:
    return measurement(torch.full((batch, 3, 37, 53), level))


def texture(batch: int, size: tuple[int, int] = (64, 96)) -> Tensor:
    noise = np.random.default_rng(0).random((3 * batch, *size))
    smooth = gaussian_filter(noise, (0, 1.5, 1.5))
    return torch.from_numpy((0.5 + 2.5 * (smooth - 0.5)).clip(0, 1)).float().unflatten(0, (batch, 3))


def only(**limits: float) -> ColorCamera:
    """A camera with one kind of flaw, which every picture has at difficulty 1."""
    none = {field.name: 0.0 for field in fields(ColorCamera) if field.name.startswith("max_")}
    return ColorCamera(**{"share": 1.0, "min_jpeg_quality": 100.0, **none, **limits})


FLAWS = {
    "exposure": {"max_exposure_ev": 1.0},
    "temperature": {"max_temperature_mired": 60.0},
    "vignetting": {"max_vignetting": 1.0},
    "defocus": {"max_defocus_px": 30.0},
    "motion": {"max_motion_px": 100.0},
    "noise": {"max_gain_stops": 5.0},
    "tone": {"max_tone_stops": 0.6},
    "jpeg": {"min_jpeg_quality": 20.0},
}


@pytest.mark.parametrize("camera", [ColorCamera(), *map(lambda limits: only(**limits), FLAWS.values())])
def test_difficulty_zero_is_the_identity(camera: ColorCamera) -> None:
    perfect = measurement(texture(2))
    assert torch.equal(camera(perfect, 0.0, generator()), perfect["rgb"])


@pytest.mark.parametrize("limits", FLAWS.values(), ids=FLAWS.keys())
def test_every_flaw_gets_stronger_with_difficulty_and_stays_in_range(limits: dict[str, float]) -> None:
    perfect, untouched = measurement(texture(12)), texture(12)
    changes = []
    for difficulty in (0.2, 0.6, 1.0):
        rgb = only(**limits)(perfect, difficulty, generator())
        assert rgb.shape == untouched.shape and rgb.min() >= 0 and rgb.max() <= 1
        changes.append((rgb - untouched).abs().mean().item())
    assert changes == sorted(changes) and changes[0] > 0 and changes[2] > 1.5 * changes[0]
    assert torch.equal(perfect["rgb"], untouched)


@pytest.mark.parametrize("limits", FLAWS.values(), ids=FLAWS.keys())
def test_the_stated_share_of_pictures_has_a_flaw_and_the_others_none(limits: dict[str, float]) -> None:
    perfect = measurement(texture(80, (17, 23)))
    rgb = only(share=0.5, **limits)(perfect, 0.6, generator())
    changed = (rgb != perfect["rgb"]).flatten(1).any(dim=1)
    assert changed.float().mean().item() == pytest.approx(0.3, abs=0.13)


@pytest.mark.parametrize("limits", FLAWS.values(), ids=FLAWS.keys())
def test_the_seed_decides(limits: dict[str, float]) -> None:
    perfect = measurement(texture(2))
    first, again, other = (only(**limits)(perfect, 1.0, generator(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_a_stop_doubles_or_halves_linear_light() -> None:
    rgb = only(max_exposure_ev=1.0)(grey(300), 1.0, generator())
    stops = np.log2((rgb[:, 0, 0, 0].numpy() / 0.4) ** GAMMA)
    assert -1 <= stops.min() < -0.95 and 0.95 < stops.max() <= 1.0001
    assert abs(stops.mean()) < 0.1


@pytest.mark.parametrize(("kelvin", "reference"), [(7500, 5000), (5000, 6500), (9000, 6500)])
def test_white_balance_goes_along_the_colours_of_black_bodies(kelvin: int, reference: int) -> None:
    table = get_planckian_coeffs("blackbody")  # red and blue over green, 3000 to 15000 K in steps of 500
    seen, known = (table[(temperature - 3000) // 500] for temperature in (kelvin, reference))
    gains = temperature_gains(torch.tensor([1e6 / kelvin - 1e6 / reference]))[0]
    assert gains[1] == 1
    torch.testing.assert_close(gains[[0, 2]].log(), torch.log(seen / known), rtol=0.2, atol=0)  # of whole spectra


def test_vignetting_is_cosine_to_the_fourth() -> None:
    size = (61, 93)
    share = vignetting(view_rays(K[None], size), torch.tensor([1.0]))[0, 0]
    for row, column in ((31, 44), (0, 0), (60, 92), (10, 80)):
        angle = np.arctan(np.hypot(row - 31, column - 44) / 80)
        assert share[row, column].item() == pytest.approx(np.cos(angle) ** 4, rel=1e-4)
    half = vignetting(view_rays(K[None], size), torch.tensor([0.5]))[0, 0]
    torch.testing.assert_close(half, share.sqrt())


def test_defocus_is_scipys_gaussian_filter() -> None:
    kernel = blur_kernels(torch.tensor([1.7]), torch.tensor([0.0]), torch.tensor([0.3]), 8)[0]
    impulse = np.zeros((17, 17))
    impulse[8, 8] = 1
    np.testing.assert_allclose(kernel.numpy(), gaussian_filter(impulse, 1.7, truncate=8), atol=2e-4)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_motion_blur_has_the_variance_of_a_line_in_its_direction(angle_deg: float) -> None:
    length_px, sigma_px, angle = 9.0, 1.2, np.deg2rad(angle_deg)
    kernel = blur_kernels(*map(lambda value: torch.tensor([value]), (sigma_px, length_px, angle)), 14)[0].double()
    offset = torch.arange(-14.0, 15)
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    assert kernel.sum().item() == pytest.approx(1)
    assert (kernel * along**2).sum().item() == pytest.approx(sigma_px**2 + length_px**2 / 12, rel=0.01)
    assert (kernel * across**2).sum().item() == pytest.approx(sigma_px**2, rel=0.01)


def test_blur_happens_in_linear_light_and_keeps_what_is_even() -> None:
    even = grey(4)
    torch.testing.assert_close(only(max_defocus_px=40.0, max_motion_px=90.0)(even, 1.0, generator()), even["rgb"])
    edge = grey(1, 0.0)
    edge["rgb"][..., 26:] = 1
    blurred = only(max_defocus_px=60.0)(edge, 1.0, generator(3))[0, 0, 18] ** GAMMA
    assert 0.3 < blurred[25] < 0.5 and blurred[25] + blurred[26] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("level", [0.0, 0.05, 0.5])
def test_noise_has_the_variance_of_electrons_counted_and_read(level: float) -> None:
    white_e, read_e = 400.0, 6.0
    image = torch.full((2, 3, 100, 100), level)
    noise = sensor_noise(image, torch.full((2,), white_e), read_e, generator()) - level
    expected_e = np.sqrt(level * white_e + read_e**2)  # Poisson's variance is its mean
    assert noise.mean().item() * white_e == pytest.approx(0, abs=4 * expected_e / np.sqrt(noise.numel()))
    assert noise.std().item() * white_e == pytest.approx(expected_e, rel=0.02)


def test_noise_is_stronger_in_shadows_once_the_tone_curve_is_on() -> None:
    dark, bright = (only(max_gain_stops=6.0)(grey(8, level), 1.0, generator()) for level in (0.15, 0.8))
    assert dark.std() > 1.5 * bright.std()


@pytest.mark.parametrize("quality", [20, 60])
def test_jpeg_loses_what_pillows_codec_loses(quality: int) -> None:
    clean = texture(40)
    rgb = only(min_jpeg_quality=float(quality))(measurement(clean), 1.0, generator())
    loss = (rgb - clean).square().mean(dim=(1, 2, 3))
    worst = int(loss.argmax())
    saved, pixels = io.BytesIO(), (clean[worst].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).save(saved, "jpeg", quality=quality, subsampling="4:2:0")
    expected = torch.from_numpy(np.asarray(Image.open(saved)) / 255).permute(2, 0, 1)
    assert (expected - clean[worst]).square().mean() == pytest.approx(loss[worst].item(), rel=0.15)
    assert (rgb[worst] - expected).abs().mean() < 0.35 * (rgb[worst] - clean[worst]).abs().mean()


@pytest.mark.parametrize(
    ("limits", "named"),
    [
        ({"share": 1.5}, "share"),
        ({"share": float("nan")}, "share"),
        ({"max_defocus_px": -1.0}, "limits"),
        ({"read_noise_e": -1.0}, "limits"),
        ({"min_jpeg_quality": 0.0}, "min_jpeg_quality"),
        ({"full_well_e": 0.0}, "full_well_e"),
    ],
)
def test_a_camera_that_cannot_be_meant_is_refused(limits: dict[str, float], named: str) -> None:
    with pytest.raises(InputError, match=named):
        ColorCamera(**limits)
