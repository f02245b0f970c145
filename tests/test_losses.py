"""The training loss, against sums done by hand and skimage."""

import hydra
import numpy as np
import pytest
import torch
from scipy import ndimage, stats
from skimage.metrics import structural_similarity
from torch import Tensor

from depthreg.config import compose_config
from depthreg.data.sample import Measurement
from depthreg.geometry import identity_affine, transform_points, warp_affine
from depthreg.losses import (
    CornerError,
    DepthL1,
    Dissimilarity,
    EarlierDepth,
    ErrorLikelihood,
    JointLoss,
    LogDepthL1,
    MatchCrossEntropy,
    NearSky,
    RelativeL1,
    RelativeRmse,
    TrustCrossEntropy,
    match_cross_entropy,
)
from depthreg.networks import JointOutput, LocalMatches

SIZE = (41, 57)
SHIFT = torch.tensor([[[1.0, 0, 2], [0, 1, -1]]])


def make_case(
    affine: Tensor, truth: Tensor, matches: list[LocalMatches] | None = None
) -> tuple[JointOutput, Measurement]:
    """Colour misaligned by `truth`, warped back by `affine`; depth is off by 2 m where it has truth, else far off."""
    scene = torch.rand(1, 3, SIZE[0] + 20, SIZE[1] + 20, generator=torch.Generator().manual_seed(0))
    truth_rgb = scene[..., 10:-10, 10:-10]
    dx, dy = truth[0, :, 2].round().int().tolist()
    rgb = scene[..., 10 - dy : 10 - dy + SIZE[0], 10 - dx : 10 - dx + SIZE[1]]
    truth_m = torch.full((1, 1, *SIZE), 10.0)
    truth_m[..., ::2] = 0
    depth_m = torch.where(truth_m > 0, truth_m - 2, 90)
    output = JointOutput(depth_m, warp_affine(rgb, affine)[0], affine, matches or [], torch.ones(1), 0 * depth_m)
    measurement = Measurement(rgb=rgb, truth_depth_m=truth_m, truth_rgb=truth_rgb, truth_affine_rgb_from_depth=truth)
    return output, measurement


def test_depth_counts_where_there_is_truth_and_in_metres() -> None:
    losses = JointLoss(depth=DepthL1(0.5))(*make_case(SHIFT, SHIFT))
    assert losses["depth"].item() == pytest.approx(2.0)
    assert losses["total"].item() == pytest.approx(1.0)


def test_without_any_depth_truth_the_term_is_zero_and_its_slope_finite() -> None:
    output, measurement = make_case(SHIFT, SHIFT)
    measurement["truth_depth_m"] = torch.zeros(1, 1, *SIZE)
    depth_m = output.depth_m.requires_grad_()
    loss = JointLoss(depth=DepthL1(0.9))(output._replace(depth_m=depth_m), measurement)["total"]
    loss.backward()
    assert loss == 0 and depth_m.grad.isfinite().all()


def test_a_perfect_alignment_costs_nothing_though_its_border_is_black() -> None:
    losses = JointLoss(ssim=Dissimilarity(1), corner=CornerError(1))(*make_case(SHIFT, SHIFT))
    assert losses["ssim"].item() == pytest.approx(0, abs=1e-4)
    assert losses["corner"].item() == pytest.approx(0, abs=1e-6)


def test_the_colour_term_is_one_minus_skimages_similarity_over_what_the_warp_saw() -> None:
    wider = torch.tensor([[[1.2, 0, -5.0], [0, 1.2, -5.0]]])  # looks beyond the image on all four sides
    output, measurement = make_case(wider, SHIFT)
    similarity = structural_similarity(
        *(image[0].numpy() for image in (output.rgb_aligned, measurement["truth_rgb"])),
        channel_axis=0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        full=True,
    )[1].mean(axis=0)
    seen = warp_affine(measurement["rgb"], wider)[1][0, 0].numpy()
    whole_window = ndimage.binary_erosion(seen, np.ones((11, 11)))
    assert 100 < whole_window.sum() < seen.sum()
    ours = JointLoss(ssim=Dissimilarity(1))(output, measurement)["ssim"].item()
    assert ours == pytest.approx(1 - similarity[whole_window].mean(), abs=1e-3)


def test_the_corner_term_is_in_percent_of_the_width() -> None:
    moved = SHIFT + torch.tensor([[0, 0, 3.0], [0, 0, 4.0]])
    losses = JointLoss(corner=CornerError(1))(*make_case(moved, SHIFT))
    assert losses["corner"].item() == pytest.approx(100 * 5 / SIZE[1], rel=1e-5)


def make_matches(shift_px: tuple[float, float], sharpness: float = 4.0) -> LocalMatches:
    """Scores that peak at one displacement, whatever the place."""
    side = torch.arange(-2.0, 3.0) * 4
    dy, dx = torch.meshgrid(side, side, indexing="ij")
    offsets_px = torch.stack([dx, dy], dim=-1).reshape(-1, 2)
    points_px = torch.tensor([[5.0, 6.0], [40.0, 8.0], [22.0, 30.0]])
    distance = (offsets_px - torch.tensor(shift_px)).abs().sum(-1) / 4
    scores = (-sharpness * distance).expand(1, 3, -1)
    return LocalMatches(points_px, offsets_px, scores, identity_affine(1))


def square(affine: Tensor) -> np.ndarray:
    return np.vstack([affine[0].numpy(), [0, 0, 1]])


def translation(x: float, y: float) -> Tensor:
    return identity_affine(1) + torch.tensor([[0, 0, x], [0, 0, y]])


def test_cross_entropy_is_lowest_at_the_true_displacement() -> None:
    truth = translation(4, -8)
    cost = {
        (x, y): match_cross_entropy(make_matches((x, y)), truth).item()
        for x in (-8, -4, 0, 4, 8)
        for y in (-8, -4, 0, 4, 8)
    }
    assert min(cost, key=cost.get) == (4, -8)


def test_cross_entropy_equals_that_of_torch_where_the_truth_is_a_candidate() -> None:
    matches = make_matches((0.0, 4.0), sharpness=0.7)
    index = matches.offsets_px.tolist().index([8.0, -4.0])
    expected = torch.nn.functional.cross_entropy(matches.scores[0], torch.full((3,), index))
    torch.testing.assert_close(match_cross_entropy(matches, translation(8, -4)), expected[None])


def test_a_truth_between_candidates_is_shared_among_them() -> None:
    matches = make_matches((0.0, 0.0), sharpness=0.7)
    by_candidate = {xy: match_cross_entropy(matches, translation(*xy)).item() for xy in ((0, 0), (4, 0))}
    between = match_cross_entropy(matches, translation(1, 0)).item()
    assert between == pytest.approx(0.75 * by_candidate[0, 0] + 0.25 * by_candidate[4, 0], rel=1e-5)


def test_only_what_is_left_to_do_is_asked_of_a_matcher() -> None:
    before = torch.tensor([[[0.7, 0.5, 1.0], [-0.5, 0.8, 6.0]]])
    to_do = translation(5, -3)
    # The matcher's own step comes first, on the depth's grid; then what was known before.
    truth = torch.from_numpy((square(before) @ square(to_do))[:2].astype(np.float32))[None]
    later, fresh = make_matches((4.0, 0.0))._replace(affine_before=before), make_matches((4.0, 0.0))
    torch.testing.assert_close(match_cross_entropy(later, truth), match_cross_entropy(fresh, to_do), atol=1e-4, rtol=0)


def test_a_displacement_beyond_the_candidates_teaches_nothing() -> None:
    matches = make_matches((0.0, 0.0))
    scores = matches.scores.clone().requires_grad_()
    match_cross_entropy(matches._replace(scores=scores), translation(60, 0)).backward()
    assert scores.grad.abs().max() == 0


def test_learning_by_cross_entropy_finds_a_turned_and_shifted_truth() -> None:
    matches = make_matches((0.0, 0.0))
    truth = torch.tensor([[[1.0, -0.05, 3.0], [0.05, 1.0, -2.0]]])
    scores = torch.zeros(1, 3, 25, requires_grad=True)
    optimizer = torch.optim.Adam([scores], lr=0.3)
    for _ in range(80):
        optimizer.zero_grad()
        match_cross_entropy(matches._replace(scores=scores), truth).backward()
        optimizer.step()
    found = scores.detach().softmax(-1) @ matches.offsets_px
    wanted = transform_points(truth, matches.points_px) - matches.points_px
    torch.testing.assert_close(found, wanted, atol=0.1, rtol=0)


def test_the_total_is_the_weighted_sum_of_its_terms() -> None:
    case = make_case(SHIFT, SHIFT + 0.5, [make_matches((0.0, 0.0)), make_matches((4.0, 0.0))])
    weights = {"depth": 0.3, "ssim": 0.2, "corner": 1.5, "match": 0.7}
    kinds = {"depth": DepthL1, "ssim": Dissimilarity, "corner": CornerError, "match": MatchCrossEntropy}
    losses = JointLoss(**{name: kinds[name](weight) for name, weight in weights.items()})(*case)
    assert losses.keys() == {"total", *weights}
    expected = sum(weight * losses[name].item() for name, weight in weights.items())
    assert losses["total"].item() == pytest.approx(expected, rel=1e-5)
    mean = np.mean([match_cross_entropy(m, SHIFT + 0.5).item() for m in case[0].matches])
    assert losses["match"].item() == pytest.approx(mean, rel=1e-5)


def test_the_papers_loss_is_composed_with_the_papers_weights() -> None:
    loss = hydra.utils.instantiate(compose_config("train", ["loss=paper"]).loss)
    assert {name: term.weight for name, term in loss.terms.items()} == {"depth": 0.9, "ssim": 0.02}


def test_a_batch_costs_the_mean_of_its_images_however_many_pixels_have_truth() -> None:
    cases = [make_case(SHIFT, SHIFT), make_case(SHIFT + 0.5, SHIFT)]
    cases[1][1]["truth_depth_m"][..., 5:, :] = 0
    cases[1] = (cases[1][0]._replace(depth_m=cases[1][0].depth_m + 7), cases[1][1])
    together = (
        JointOutput(
            *(torch.cat([output[i] for output, _ in cases]) for i in range(3)), [], torch.ones(len(cases)), None
        ),
        Measurement(**{key: torch.cat([measurement[key] for _, measurement in cases]) for key in cases[0][1]}),
    )
    loss = JointLoss(depth=DepthL1(0.9), ssim=Dissimilarity(0.5), corner=CornerError(2), match=MatchCrossEntropy(1))
    alone = [loss(*case)["total"].item() for case in cases]
    assert alone[0] != pytest.approx(alone[1], rel=0.1)
    assert loss(*together)["total"].item() == pytest.approx(np.mean(alone), rel=1e-5)


@pytest.mark.parametrize("weights", [{"depth": -1.0}, {"depth": 0.0}, {}])
def test_a_loss_that_teaches_nothing_or_the_wrong_way_is_refused(weights: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="weights must be"):
        JointLoss(**{name: DepthL1(weight) for name, weight in weights.items()})


def test_depth_on_the_way_costs_the_mean_of_what_it_was() -> None:
    output, measurement = make_case(SHIFT, SHIFT)
    measurement["depth_m"] = torch.ones_like(output.depth_m)
    loss = JointLoss(log=LogDepthL1(1), earlier=EarlierDepth(0.5))
    assert loss(output, measurement)["earlier"].item() == 0  # of a network that doesn't say
    halves = output._replace(earlier_m=(output.depth_m, torch.full_like(output.depth_m, 5.0)))  # 8 and 5 m for 10 m
    assert loss(halves, measurement)["earlier"].item() == pytest.approx((np.log(10 / 8) + 0.2 + np.log(2) + 0.5) / 2)


def test_depth_errors_without_a_unit_are_those_of_the_formula() -> None:
    output, measurement = make_case(SHIFT, SHIFT)  # 8 m predicted for 10 m
    measurement["depth_m"] = torch.ones_like(output.depth_m)
    terms = {"log": LogDepthL1(1), "l1": RelativeL1(1), "rmse": RelativeRmse(1)}
    losses = JointLoss(**terms)(output, measurement)
    assert losses["log"].item() == pytest.approx(np.log(10 / 8), rel=1e-5)
    assert losses["l1"].item() == pytest.approx(0.2, rel=1e-5)
    assert losses["rmse"].item() == pytest.approx(0.2, rel=1e-5)
    for key in ("truth_depth_m", "depth_m"):
        measurement[key] = 1000 * measurement[key]
    in_millimetres = JointLoss(**terms)(output._replace(depth_m=1000 * output.depth_m), measurement)
    torch.testing.assert_close(in_millimetres, losses, rtol=1e-4, atol=0)


def test_squares_count_around_returns_alone() -> None:
    output, measurement = make_case(SHIFT, SHIFT)
    measurement["truth_depth_m"] = torch.full((1, 1, *SIZE), 10.0)
    measurement["depth_m"] = torch.zeros(1, 1, *SIZE)
    measurement["depth_m"][..., 20, 30] = 10.0
    depth_m = torch.full((1, 1, *SIZE), 90.0)
    depth_m[..., 17:24, 27:34] = 11.0  # within 3 px of the return
    output = output._replace(depth_m=depth_m)
    assert RelativeRmse(1, reach_px=3)(output, measurement).item() == pytest.approx(0.1, rel=1e-4)
    assert RelativeRmse(1, reach_px=4)(output, measurement).item() > 1


def test_sky_costs_what_it_lacks_to_the_farthest_return() -> None:
    output, measurement = make_case(SHIFT, SHIFT)  # 90 m in the sky
    measurement["depth_m"] = torch.zeros(1, 1, *SIZE)
    measurement["depth_m"][..., 20, 30] = 180.0
    assert NearSky(1)(output, measurement).item() == pytest.approx(np.log(2), rel=1e-5)
    measurement["depth_m"][..., 20, 30] = 60.0
    assert NearSky(1)(output, measurement).item() == 0


def test_trust_is_taught_by_whether_the_corners_are_right() -> None:
    output, measurement = make_case(SHIFT, SHIFT)
    trusting = output._replace(trust=torch.tensor([0.9]))
    term = TrustCrossEntropy(1, right_pct=1.0)  # 0.57 px here
    assert term(trusting, measurement).item() == pytest.approx(-np.log(0.9), rel=1e-5)
    wrong = make_case(SHIFT + torch.tensor([[[0.0, 0, 1], [0, 0, 0]]]), SHIFT)[0]
    assert term(wrong._replace(trust=torch.tensor([0.9])), measurement).item() == pytest.approx(-np.log(0.1), rel=1e-5)
    measurement["paired"] = torch.tensor([False])
    assert term(trusting, measurement).item() == pytest.approx(-np.log(0.1), rel=1e-5)


def test_nothing_is_learned_about_registration_from_colour_of_another_place() -> None:
    output, measurement = make_case(SHIFT, torch.eye(2, 3)[None])
    terms = JointLoss(ssim=Dissimilarity(1), corner=CornerError(1))
    assert terms(output, measurement)["total"] > 1
    measurement["paired"] = torch.tensor([False])
    assert terms(output, measurement)["total"] == 0


@pytest.mark.parametrize("claimed", [0.05, 0.2, 0.7])
def test_a_claimed_error_is_scored_by_the_laplace_density(claimed: float) -> None:
    output, measurement = make_case(SHIFT, SHIFT)  # 8 m predicted for 10 m
    measurement["truth_depth_m"] = torch.full((1, 1, *SIZE), 10.0)
    depth_m = torch.full((1, 1, *SIZE), 8.0, requires_grad=True)
    claim = torch.full((1, 1, *SIZE), claimed, requires_grad=True)
    loss = ErrorLikelihood(1)(output._replace(depth_m=depth_m, log_error=claim), measurement)
    assert loss.item() == pytest.approx(-stats.laplace.logpdf(np.log(10 / 8), scale=claimed), rel=1e-4)
    loss.sum().backward()
    assert depth_m.grad is None and (claim.grad.sum() > 0) == (claimed > np.log(10 / 8))  # towards what it is
