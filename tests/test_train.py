"""`depthreg train` as a user runs it, with the smallest of everything."""

import csv
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
import torch
import yaml

from depthreg.checkpoint import load_network
from depthreg.cli import main
from depthreg.comparison.runs import read_run

STAGES = ("joint", "completion", "full")
TINY = [
    "data.width=80",
    "data.height=64",
    "data.train_count=4",
    "data.val_count=2",
    "data.batch_size=2",
    "data.workers=0",
    "model.completion_widths=[16,16]",
    "trainer.accelerator=cpu",
    *(f"epochs.{name}=1" for name in STAGES),
]

Train = Callable[..., Path]


@pytest.fixture(scope="module")
def train(tmp_path_factory: pytest.TempPathFactory) -> Train:
    """Runs the command in a folder of its own and gives the run's folder; rendered frames are shared."""
    frames = tmp_path_factory.mktemp("frames")

    def run(*overrides: str) -> Path:
        folder = tmp_path_factory.mktemp("here")
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            assert main(["train", *TINY, f"data.cache_dir={frames}", "logger=csv", *overrides]) == 0
        assert [path.name for path in folder.iterdir()] == ["runs"]
        (run_folder,) = (folder / "runs").iterdir()
        return run_folder

    return run


@pytest.fixture(scope="module")
def curriculum(train: Train) -> Path:
    """The run's folder of a whole curriculum."""
    return train()


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["state_dict"]


@pytest.mark.parametrize("name", STAGES)
def test_each_stage_leaves_checkpoints_a_log_and_pictures(name: str, curriculum: Path) -> None:
    folder = curriculum / name
    for checkpoint in ("last.ckpt", "best.ckpt"):
        network = load_network(folder / checkpoint)
        assert network.config["completion_widths"] == [16, 16]
    header = (folder / "metrics.csv").read_text().splitlines()[0].split(",")
    assert {"train/loss", "train/difficulty", "val/loss", "val/rmse_m", "val/corner_error_px"} <= set(header)
    pictures = list((folder / "panels").glob("*.png"))
    assert len(pictures) == 2 and all(cv2.imread(str(path)) is not None for path in pictures)


def test_the_run_ends_with_a_table_and_pictures(curriculum: Path) -> None:
    table = (curriculum / "metrics.md").read_text()
    assert all(word in table for word in ("ours", "nearest", "identity", "RMSE (m)", "corner mean (px)"))
    assert (curriculum / "metrics.csv").read_text().count("\n") > 10
    assert len(list((curriculum / "panels").glob("*.png"))) == 2


def test_what_a_run_leaves_is_what_a_comparison_reads(curriculum: Path, tmp_path: Path) -> None:
    run = read_run(curriculum)
    assert run.state == "finished" and list(run.stages) == list(STAGES)
    assert run.steps == 3 * 2 and run.frames == 3 * 4  # one epoch of two batches of two, in each stage
    frozen = {column for column, curve in run.stages["completion"].curves.items() if "frozen/" in column and curve[0]}
    assert frozen == {"frozen/first_rgb", "frozen/first_depth", "frozen/registration"}
    assert main(["compare", str(curriculum), "--out", str(tmp_path / "out")]) == 0
    ours = next(csv.DictReader((curriculum / "metrics.csv").open()))["ours"]
    assert f"| {float(ours):.3f} |" in (tmp_path / "out" / "compare.md").read_text()


def test_the_stages_follow_each_other_in_the_papers_order(curriculum: Path) -> None:
    times = [(curriculum / name / "last.ckpt").stat().st_mtime_ns for name in STAGES]
    assert times == sorted(times)
    stages = [torch.load(curriculum / name / "last.ckpt", weights_only=True)["depthreg"]["stage"] for name in STAGES]
    assert stages == list(STAGES)


def test_completion_starts_from_the_first_stage_and_keeps_its_registration(curriculum: Path) -> None:
    joint, completion, full = (weights(curriculum / name / "last.ckpt") for name in STAGES)
    registration = [key for key in joint if not key.startswith("network.completion.")]
    assert registration
    assert all(torch.equal(joint[key], completion[key]) for key in registration)
    assert any(not torch.equal(completion[key], full[key]) for key in registration)


def test_one_stage_starts_from_the_weights_it_is_given(curriculum: Path, train: Train) -> None:
    start = curriculum / "joint" / "last.ckpt"
    alone = train("curriculum=[completion]", f"init_from={start}")
    assert not (alone / "joint").exists()
    given, ours = weights(start), weights(alone / "completion" / "last.ckpt")
    in_the_walk = weights(curriculum / "completion" / "last.ckpt")
    registration = [key for key in given if not key.startswith("network.completion.")]
    assert all(torch.equal(given[key], ours[key]) for key in registration)
    assert all(torch.equal(in_the_walk[key], ours[key]) for key in given)  # as if it had walked there


def test_the_run_says_how_it_was_made(curriculum: Path) -> None:
    record = yaml.safe_load((curriculum / "run.yaml").read_text())
    assert "logger=csv" in record["overrides"] and record["config"]["data"]["width"] == 80
    assert record["config"]["curriculum"] == list(STAGES)
    assert record["versions"]["torch"] == torch.__version__
    revision = subprocess.run(["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True)
    if revision.returncode == 0:
        assert record["git"]["revision"] == revision.stdout.strip()


def test_what_was_frozen_and_how_hard_it_was_is_in_the_log(train: Train) -> None:
    folder = train("curriculum=[joint]", "epochs.joint=4", "callbacks.panels=null")
    with (folder / "joint" / "metrics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["train/loss"]]
    assert [float(row["frozen/completion"]) for row in rows] == [0, 1, 0, 1]
    assert [float(row["frozen/registration"]) for row in rows] == [0] * 4
    difficulties = [float(row["train/difficulty"]) for row in rows]
    assert difficulties == sorted(difficulties) and difficulties[0] == pytest.approx(0.3) and difficulties[-1] == 1


def test_stages_may_come_in_any_order_and_more_than_once(train: Train) -> None:
    again = "+stage@stages.again=joint", "stages.again.epochs=2"
    folder = train("curriculum=[full,again,full]", *again, "callbacks.panels=null")
    assert {path.name for path in folder.iterdir() if path.is_dir()} == {".hydra", "full", "again", "full_2", "panels"}
    full, joint, last = (weights(folder / name / "last.ckpt") for name in ("full", "again", "full_2"))
    assert not any(torch.equal(full[key], joint[key]) for key in full if key.endswith("conv.weight"))
    assert not any(torch.equal(full[key], last[key]) for key in full if key.endswith("conv.weight"))


def test_two_runs_of_one_seed_are_one(curriculum: Path, train: Train) -> None:
    again = weights(train("curriculum=[joint]") / "joint" / "last.ckpt")
    assert all(torch.equal(value, again[key]) for key, value in weights(curriculum / "joint" / "last.ckpt").items())


def test_stored_frames_teach_what_frames_rendered_anew_do(curriculum: Path, train: Train, tmp_path: Path) -> None:
    """Depth in bins is stored without loss, so that the weights are the same to the last bit."""
    camera = ["camera=random", "camera.width=80", "camera.height=64", "camera.focal_px=[186,500]"]
    frames = ["world=blocks", "sensor=clean", *camera, "count=6", "workers=1", f"out={tmp_path / 'blocks'}"]
    assert main(["render", *frames]) == 0
    stored = train("curriculum=[joint]", "data=rendered", f"data.root={tmp_path}", "data.val_share=0.34")
    ours, theirs = (weights(folder / "joint" / "last.ckpt") for folder in (stored, curriculum))
    assert [key for key in theirs if not torch.equal(ours[key], theirs[key])] == []


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["data=rendered"], "data.root is missing"),
        (["data=rendered", "data.root=nowhere"], "nowhere holds no dataset.json"),
        (["data=streaming", "data.url=nowhere"], "nowhere holds no dataset.json"),
        (["data=kitti", "data.root=x"], "expected data=synthetic, data=rendered, data=streaming"),
    ],
)
def test_data_that_cannot_be_trained_on_is_refused(
    overrides: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", *overrides]) == 2
    message = capsys.readouterr().err
    assert said in message and len(message.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_papers_preset_trains(train: Train) -> None:
    """At the size of `TINY`'s frames; the network and the loss are the paper's."""
    widths = "model.completion_widths=[64,128,256,512]"  # TINY narrows them
    folder = train("preset=paper", "curriculum=[full]", widths, "data.val_count=1", "data.train_count=2")
    network = load_network(folder / "full" / "last.ckpt")
    assert sum(parameter.numel() for parameter in network.parameters()) == pytest.approx(5.2e6, rel=0.05)
    header = (folder / "full" / "metrics.csv").read_text().splitlines()[0].split(",")
    assert {"train/depth_loss", "train/ssim_loss"} <= set(header) and "train/corner_loss" not in header


@pytest.mark.parametrize("name", ["no_rgb", "no_registration"])
def test_a_network_without_registration_leaves_colour_where_it_was(name: str, train: Train) -> None:
    folder = train(f"experiment=ablation/{name}", "callbacks.panels=null", "seed=1")
    with (folder / "metrics.csv").open() as file:
        corner = next(row for row in csv.DictReader(file) if row["metric"] == "corner_error_px")
    assert corner["ours"] == corner["identity"]


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["curriculum=[ful]"], "expected some of joint, completion, full"),
        (["curriculum=[]"], "expected some of joint, completion, full"),
        (
            ["stages.joint.freeze.modules=[completoin]"],
            "stages.joint: freeze.modules has 'completoin': expected completion",
        ),
        (["stages.full.difficulty.shape=cubic"], "stages.full.difficulty.shape=cubic: expected one of linear"),
        (["stages.full.patience=0"], "stages.full.patience=0: expected a whole number, at least 1"),
        (["loss.depth.weight=-1"], "loss.depth.weight=-1: expected a number, at least 0"),
    ],
)
def test_a_curriculum_that_cannot_be_walked_is_refused(
    overrides: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", *TINY, *overrides]) == 2
    message = capsys.readouterr().err
    assert said in message and len(message.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
