import csv
import sys

import cv2
import numpy as np
import pytest
import torch

from depthreg.checkpoint import described
from depthreg.cli import main
from depthreg.errors import InputError
from depthreg.evaluate import evaluate
from depthreg.evaluation import scores as module
from depthreg.evaluation.settings import misalign
from depthreg.geometry import identity_affine
from depthreg.networks import JointNetwork, JointOutput
from depthreg.report import ALIGNED, MISALIGNED, OURS, REGISTRATION

SIZE = (117, 163)
SHIFT_PX = 60.0  # for 1242 px of width, so about 8 px here


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def ramps(height, width):
    """An image whose red and green tell where a pixel came from; bilinear sampling keeps ramps exact."""
    y, x = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, 0.5)])


def real_frame(seed=0, size=SIZE):
    """A frame that lines up, as a data set of real frames gives it."""
    depth_m = 2 + 20 * torch.rand(1, *size, generator=generator(seed))
    rgb = torch.from_numpy(cv2.GaussianBlur(depth_m[0].numpy(), (0, 0), 3) / 30)[None].repeat(3, 1, 1)
    sparse_m = depth_m * (torch.rand(depth_m.shape, generator=generator(seed + 1)) < 0.3)
    K = torch.tensor([[80.0, 0, 81], [0, 80, 58], [0, 0, 1]])
    return {"name": "frame", "rgb": rgb, "depth_m": sparse_m, "truth_depth_m": depth_m, "intrinsics": K}


def simulated_frame(shift_px=(3.0, 4.0)):
    """A frame that brings its own misalignment, as the simulator gives it."""
    frame = real_frame()
    affine = identity_affine(1)[0]
    affine[:, 2] = torch.tensor(shift_px)
    return {**frame, "truth_rgb": frame["rgb"], "truth_affine_rgb_from_depth": affine}


class Oracle(torch.nn.Module):
    """Answers with the truth of the one frame that it is asked about."""

    def __init__(self, frame, error_m=0.0):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.depth_m = frame["truth_depth_m"][None] + error_m
        self.affine = frame.get("truth_affine_rgb_from_depth", torch.eye(2, 3))[None]

    def forward(self, rgb, depth_m):
        rows, columns = ((ours - asked) // 2 for ours, asked in zip(SIZE, depth_m.shape[-2:], strict=True))
        inner = self.depth_m[..., rows : SIZE[0] - rows, columns : SIZE[1] - columns]
        return JointOutput(inner, rgb, self.affine, matches=[], trust=torch.ones(1), log_error=0 * inner)


def test_a_misaligned_frame_shows_at_a_of_x_what_the_depth_has_at_x():
    height, width = SIZE
    out = misalign({"rgb": ramps(*SIZE)[None], "depth_m": torch.ones(1, 1, *SIZE)}, SHIFT_PX, generator())
    margin_px = (height - out["rgb"].shape[-2]) // 2
    x, y = 60, 40
    u, v = (out["truth_affine_rgb_from_depth"][0] @ torch.tensor([x, y, 1.0])).tolist()
    patch = cv2.getRectSubPix(out["rgb"][0].permute(1, 2, 0).numpy(), (1, 1), (u, v))[0, 0]
    assert abs(u - x) + abs(v - y) > 0.5
    np.testing.assert_allclose(patch[:2], [(x + margin_px) / width, (y + margin_px) / height], atol=1e-3)
    np.testing.assert_array_equal(out["truth_rgb"][0, :, y, x], ramps(*SIZE)[:, y + margin_px, x + margin_px])


def test_a_misaligned_frame_has_no_black_border():
    for seed in range(20):
        frame = {"rgb": torch.ones(1, 3, *SIZE), "depth_m": torch.ones(1, 1, *SIZE)}
        assert misalign(frame, SHIFT_PX, generator(seed))["rgb"].min() > 0.999


def test_everything_follows_the_crop():
    frame = {key: value[None] for key, value in real_frame().items() if key != "name"}
    frame["depth_m"] = frame["truth_depth_m"]
    out = misalign(frame, SHIFT_PX, generator())
    margin_px = (SIZE[0] - out["depth_m"].shape[-2]) // 2
    assert margin_px > 0
    assert out["depth_m"][0, 0, 5, 7] == frame["depth_m"][0, 0, 5 + margin_px, 7 + margin_px]
    np.testing.assert_array_equal(out["depth_m"], out["truth_depth_m"])
    # A point in space keeps its place on the sensor, which is now counted from the crop's corner.
    point = torch.tensor([0.3, -0.2, 2.0])
    before, after = (k[0] @ point / 2 for k in (frame["intrinsics"], out["intrinsics"]))
    np.testing.assert_allclose(before - after, [margin_px, margin_px, 0], atol=1e-4)


def test_a_frame_that_is_too_small_is_named():
    frame = {"rgb": torch.ones(1, 3, 66, 90), "depth_m": torch.ones(1, 1, 66, 90), "name": ["tiny"]}
    with pytest.raises(InputError, match="tiny is 90x66"):
        misalign(frame, SHIFT_PX, generator())


def test_the_truth_scores_perfectly_and_the_identity_is_off_by_the_shift():
    frame = simulated_frame(shift_px=(3.0, 4.0))
    results = evaluate(Oracle(frame), [frame])
    assert results[ALIGNED][OURS]["rmse_m"] == results[MISALIGNED][OURS]["rmse_m"] == 0
    assert results[REGISTRATION][OURS]["corner_error_px"] == 0
    assert results[REGISTRATION][OURS]["share_under_1px"] == 1
    assert results[REGISTRATION]["identity"]["corner_error_px"] == pytest.approx(5)


def test_a_constant_error_is_the_rmse():
    frame = real_frame()
    results = evaluate(Oracle(frame, error_m=0.25), [frame], max_corner_shift_px=SHIFT_PX)
    assert results[ALIGNED][OURS]["rmse_m"] == pytest.approx(0.25, rel=1e-4)
    assert results[MISALIGNED][OURS]["mae_m"] == pytest.approx(0.25, rel=1e-4)


def test_baselines_see_what_the_network_sees():
    frame = {**real_frame(), "depth_m": real_frame()["truth_depth_m"]}  # nothing is left to complete
    results = evaluate(Oracle(frame), [frame], max_corner_shift_px=SHIFT_PX)
    for task in (ALIGNED, MISALIGNED):
        assert results[task]["nearest"]["rmse_m"] == 0


def test_the_identity_is_right_where_nothing_is_misaligned():
    frame = real_frame()
    results = evaluate(Oracle(frame), [frame], max_corner_shift_px=0.0)
    assert results[REGISTRATION]["identity"]["corner_error_px"] == 0
    assert results[REGISTRATION]["identity"]["ssim"] == pytest.approx(1, abs=1e-5)


def test_depth_is_completed_with_both_the_true_and_the_misaligned_colour():
    class Brightness(Oracle):
        def forward(self, rgb, depth_m):
            return super().forward(rgb, depth_m)._replace(depth_m=self.depth_m + rgb.mean())

    frame = simulated_frame()
    frame["truth_rgb"], frame["rgb"] = (
        torch.full_like(frame["rgb"], 0.25),
        torch.full_like(frame["rgb"], 0.75),
    )
    results = evaluate(Brightness(frame), [frame])
    assert results[ALIGNED][OURS]["mae_m"] == pytest.approx(0.25, rel=1e-4)
    assert results[MISALIGNED][OURS]["mae_m"] == pytest.approx(0.75, rel=1e-4)


def test_each_frame_and_each_seed_has_a_misalignment_of_its_own():
    frame = real_frame()
    shifts_px = [
        evaluate(Oracle(frame), [frame] * count, max_corner_shift_px=SHIFT_PX, seed=seed)
        for count, seed in ((1, 0), (1, 0), (2, 0), (1, 1))
    ]
    again, same, two, other = (r[REGISTRATION]["identity"]["corner_error_px"] for r in shifts_px)
    assert again == same
    assert len({again, two, other}) == 3


def test_scores_do_not_depend_on_what_else_is_evaluated():
    frame = real_frame()
    first, second = (
        evaluate(Oracle(frame), frames, max_corner_shift_px=SHIFT_PX)
        for frames in ([frame], [frame, simulated_frame()])
    )
    one, both = (r[REGISTRATION]["identity"]["corner_error_px"] for r in (first, second))
    assert both == pytest.approx((one + 5) / 2)


def test_without_truth_the_depth_scores_are_unknown_and_registration_is_scored():
    frame = real_frame()
    blind = {key: value for key, value in frame.items() if key not in ("truth_depth_m", "intrinsics")}
    results = evaluate(Oracle(frame), [blind], max_corner_shift_px=SHIFT_PX)
    assert np.isnan(results[ALIGNED]["nearest"]["rmse_m"])
    assert results[REGISTRATION]["identity"]["corner_error_px"] > 0


def test_a_method_without_an_answer_counts_as_the_identity(monkeypatch):
    monkeypatch.setattr(module, "registration_baselines", lambda: {"mute": lambda rgb, depth_m: None})
    frame = simulated_frame()
    mute = evaluate(Oracle(frame), [frame])[REGISTRATION]["mute"]
    assert mute["no_answer"] == 1
    assert mute["corner_error_px"] == pytest.approx(5)


def test_pictures_are_written_for_the_first_frames(tmp_path):
    frame = real_frame()
    evaluate(Oracle(frame), [frame] * 3, panel_dir=tmp_path, panels=2)
    pictures = sorted(tmp_path.iterdir())
    assert [path.name for path in pictures] == ["000000.png", "000001.png"]
    assert cv2.imread(str(pictures[0])).std() > 10


def test_the_worst_frames_are_those_of_the_largest_multiple_of_the_rivals_error(tmp_path):
    easy, hard = real_frame(seed=0), real_frame(seed=1)
    blind = {key: value for key, value in hard.items() if key != "truth_depth_m"}
    evaluate(Oracle(easy), [easy, hard, blind], max_corner_shift_px=SHIFT_PX, worst_dir=tmp_path, worst=5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1_frame_000001.png", "2_frame_000000.png"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with a checkpoint of a tiny untrained network and a folder of two pairs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["depthreg"])  # Hydra reads it, so the command sets it
    network = JointNetwork(first_channels=8, completion_widths=(16, 16, 16, 16))
    state = {f"network.{key}": value for key, value in network.state_dict().items()}
    torch.save({"depthreg": described(network), "state_dict": state}, "net.ckpt")
    for folder in ("image", "depth", "truth"):
        (tmp_path / "pairs" / folder).mkdir(parents=True)
        for seed, stem in enumerate(["a", "b"]):
            channels, kind = ((3,), np.uint8) if folder == "image" else ((), np.uint16)
            values = np.random.default_rng(seed).integers(1, 256, (*SIZE, *channels)).astype(kind)
            cv2.imwrite(str(tmp_path / "pairs" / folder / f"{stem}.png"), values)
    return tmp_path


FOLDER = ["checkpoint=net.ckpt", "data=folder", "data.root=pairs", "data.depth_scale=10"]


def test_the_command_prints_and_writes_one_table(here, capsys):
    assert main(["evaluate", *FOLDER, "panels=1"]) == 0
    (run,) = (here / "runs").iterdir()
    rows = list(csv.DictReader((run / "metrics.csv").open()))
    assert {row["task"] for row in rows} == {ALIGNED, MISALIGNED, REGISTRATION}
    assert float(rows[0]["nearest"]) == 0  # the pairs' depth is dense, and equals their truth
    assert "| depth, aligned | RMSE (m) |" in (run / "metrics.md").read_text()
    assert len(list((run / "panels").iterdir())) == 1
    assert len(list((run / "worst").iterdir())) == 2
    assert next(csv.DictReader((run / "curves.csv").open()))["curve"] == "returns"
    assert "plotly" in (run / "curves.html").read_text(encoding="utf-8")
    printed = capsys.readouterr().out
    assert "2 of 2 frames of pairs" in printed and str(run / "metrics.md") in printed


def test_the_command_scores_synthetic_frames(here, capsys):
    size = ["data.width=96", "data.height=64", "data.camera.focal_px=[60,60]", "world=mixed"]
    assert main(["evaluate", "checkpoint=net.ckpt", "data=synthetic", "data.val_count=3", "limit=2", *size]) == 0
    assert "2 of 3 frames of unseen synthetic scenes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (FOLDER[:-1], "data.depth_scale is missing"),
        ([*FOLDER, "limit=0"], "limit=0"),
        ([*FOLDER, "curves=-1"], "curves=-1"),
        ([*FOLDER, "max_corner_shift_px=-1"], "max_corner_shift_px=-1"),
        ([*FOLDER, "difficulty=2"], "difficulty=2"),
        ([*FOLDER, "max_corner_shift_px=much"], "max_corner_shift_px=much"),
        ([*FOLDER[:-1], "data.depth_scale=mm"], "depth_scale=mm"),
        ([*FOLDER, "data.truth=elsewhere/*.png"], "pairs holds no elsewhere/*.png"),
        (["checkpoint=net.ckpt", "data=kitti", "data.root=pairs"], "isn't a KITTI depth folder"),
        ([*FOLDER, "data.depth=image/*"], "one depth channel"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing_behind(here, capsys, overrides, complaint):
    assert main(["evaluate", *overrides]) == 2
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith("depthreg evaluate: ") and complaint in message
    assert not (here / "runs").exists()
