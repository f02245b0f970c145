import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torchmetrics import MetricCollection

from depthreg.geometry import identity_affine
from depthreg.metrics import DEPTH_KEYS, DepthMetrics, RegistrationMetrics, masked_mean, masked_ssim, ssim_map

TRUTH_M = torch.tensor([[2.0, 4.0, 0.0], [5.0, 0.0, 10.0]])[None, None]
PRED_M = torch.tensor([[2.5, 4.0, 9.0], [4.0, 1.0, 20.0]])[None, None]
# By hand, over the four pixels with truth: errors 0.5, 0, -1, 10 m.
BY_HAND = {
    "rmse_m": (101.25 / 4) ** 0.5,
    "mae_m": 11.5 / 4,
    "irmse_per_km": ((100.0**2 + 0 + 50.0**2 + 50.0**2) / 4) ** 0.5,
    "imae_per_km": (100.0 + 0 + 50.0 + 50.0) / 4,
    "abs_rel": (0.25 + 0 + 0.2 + 1.0) / 4,
    "delta1": 1 / 4,  # ratios 1.25 (not below), 1, 1.25, 2
}


def depth_scores(*batches):
    metric = DepthMetrics()
    for pred_m, truth_m in batches:
        metric.update(pred_m, truth_m)
    return {key: value.item() for key, value in metric.compute().items()}


def test_depth_scores_equal_those_computed_by_hand():
    assert depth_scores((PRED_M, TRUTH_M)) == pytest.approx(BY_HAND, rel=1e-6)


def test_scores_are_means_over_images_and_not_over_pixels():
    one_pixel = torch.zeros_like(TRUTH_M)
    one_pixel[..., 0, 0] = 1.0
    scores = depth_scores((torch.full_like(one_pixel, 4.0), one_pixel), (PRED_M, TRUTH_M))
    assert scores["rmse_m"] == pytest.approx((3 + BY_HAND["rmse_m"]) / 2)


def test_the_batch_size_does_not_matter():
    generator = torch.Generator().manual_seed(1)
    truth_m = 1 + 50 * torch.rand(5, 1, 9, 13, generator=generator)
    truth_m[torch.rand(truth_m.shape, generator=generator) < 0.5] = 0
    pred_m = 1 + 50 * torch.rand(5, 1, 9, 13, generator=generator)
    singly = depth_scores(*zip(pred_m.split(1), truth_m.split(1), strict=True))
    assert depth_scores((pred_m, truth_m)) == pytest.approx(singly, rel=1e-5)


def test_an_image_without_truth_does_not_count():
    empty = torch.zeros_like(TRUTH_M)
    batch = torch.cat([PRED_M, PRED_M]), torch.cat([TRUTH_M, empty])
    assert depth_scores(batch) == depth_scores((PRED_M, TRUTH_M))


def test_without_any_truth_every_score_is_unknown():
    assert all(np.isnan(value) for value in depth_scores((PRED_M, torch.zeros_like(TRUTH_M))).values())


@pytest.mark.parametrize("hole_m", [0.0, -1.0])
def test_a_hole_in_the_prediction_makes_inverse_errors_infinite(hole_m):
    holed = PRED_M.clone()
    holed[..., 0, 0] = hole_m
    scores = depth_scores((holed, TRUTH_M))
    assert np.isinf(scores["irmse_per_km"]) and np.isinf(scores["imae_per_km"])
    assert np.isfinite(scores["rmse_m"])


def test_infinite_predictions_beside_the_truth_are_ignored():
    wild = PRED_M.clone()
    wild[TRUTH_M == 0] = torch.inf
    assert depth_scores((wild, TRUTH_M)) == depth_scores((PRED_M, TRUTH_M))


def registration_scores(affine, truth, size=(37, 53)):
    metric = RegistrationMetrics()
    metric.update(affine, truth, size)
    return {key: value.item() for key, value in metric.compute().items()}


def test_a_shift_of_3_and_4_px_is_a_corner_error_of_5_px():
    shift = identity_affine(1)
    shift[..., 2] = torch.tensor([3.0, 4.0])
    scores = registration_scores(identity_affine(1), shift)
    expected = {
        "corner_error_px": 5,
        "corner_error_median_px": 5,
        "identity_corner_error_px": 5,
        "translation_px": 5,
    }
    expected |= {"rotation_deg": 0, "scale_pct": 0}
    expected |= {"share_under_1px": 0, "share_under_3px": 0, "share_under_5px": 0}
    assert scores == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("angle_deg", "scale"), [(3.0, 1.0), (-179.0, 0.9), (0.5, 1.07)])
def test_rotation_and_scale_about_the_centre_are_named_as_such(angle_deg, scale):
    height, width = 37, 53
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    angle = np.deg2rad(angle_deg)
    matrix = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    affine = torch.from_numpy(np.column_stack([matrix, centre - matrix @ centre])).float()[None]
    scores = registration_scores(affine, identity_affine(1))
    radius = np.hypot(*centre)  # every corner is as far from the centre, so each moves by the same chord
    chord = radius * abs(scale * np.exp(1j * angle) - 1)
    assert scores["corner_error_px"] == pytest.approx(chord, rel=1e-4)
    assert scores["rotation_deg"] == pytest.approx(abs(angle_deg), abs=1e-3)
    assert scores["scale_pct"] == pytest.approx(100 * abs(scale - 1), abs=1e-3)
    assert scores["translation_px"] == pytest.approx(0, abs=1e-3)


def test_shares_and_median_count_frames():
    shifts = identity_affine(5)
    shifts[:, 0, 2] = torch.tensor([0.5, 2.0, 2.5, 4.0, 40.0])
    scores = registration_scores(shifts, identity_affine(5))
    shares = [scores[f"share_under_{limit}px"] for limit in (1, 3, 5)]
    assert shares == pytest.approx([0.2, 0.6, 0.8])
    assert scores["corner_error_median_px"] == pytest.approx(2.5)
    assert scores["corner_error_px"] == pytest.approx(49 / 5)


def test_both_metrics_fit_into_one_collection():
    metrics = MetricCollection({"depth": DepthMetrics(), "registration": RegistrationMetrics()})
    metrics["depth"].update(PRED_M, TRUTH_M)
    metrics["registration"].update(identity_affine(1), identity_affine(1), (37, 53))
    assert set(DEPTH_KEYS) < set(metrics.compute())


def random_images(seed, size=(37, 53)):
    image, other = torch.rand(2, 1, 3, *size, generator=torch.Generator().manual_seed(seed))
    return image, 0.7 * image + 0.3 * other


def test_ssim_agrees_with_scikit_image():
    image, other = random_images(1)
    _, theirs = structural_similarity(
        image[0].numpy(),
        other[0].numpy(),
        channel_axis=0,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    ours = ssim_map(image, other)[0, 0].numpy()
    inner = np.s_[5:-5, 5:-5]  # the two treat the border differently
    np.testing.assert_allclose(ours[inner], theirs.mean(axis=0)[inner], atol=1e-4)


def test_what_the_mask_hides_does_not_change_the_masked_ssim():
    image, other = random_images(2)
    mask = torch.ones(1, 1, 37, 53, dtype=torch.bool)
    mask[..., :20] = False
    spoilt = torch.where(mask, other, torch.zeros_like(other))
    assert masked_ssim(image, spoilt, mask).item() == pytest.approx(masked_ssim(image, other, mask).item())
    assert masked_ssim(image, image, mask).item() == pytest.approx(1)


def test_masked_ssim_under_an_empty_mask_is_zero():
    image, other = random_images(3)
    assert masked_ssim(image, other, torch.zeros(1, 1, 37, 53, dtype=torch.bool)).item() == 0


def test_masked_ssim_pulls_an_image_towards_its_target():
    image, other = random_images(4)
    image.requires_grad_(True)
    mask = torch.ones(1, 1, 37, 53, dtype=torch.bool)
    before = masked_ssim(image, other, mask)
    before.backward()
    after = masked_ssim(image + 0.01 * image.grad / image.grad.abs().max(), other, mask)
    assert after > before


def test_masked_mean_broadcasts_the_mask_and_ignores_infinities():
    values = torch.tensor([[1.0, torch.inf], [3.0, torch.nan]])[None, None].expand(2, 3, 2, 2)
    mask = torch.tensor([[True, False], [True, False]])[None, None]
    assert masked_mean(values, mask).item() == 2
