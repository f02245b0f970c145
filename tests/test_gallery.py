"""The gallery: a picture for each stage, and what each of its cells shows."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from torch.utils.data import DataLoader

from depthreg.cli import main
from depthreg.gallery import draw_scene
from depthreg.sensors import Holes, SensorSimulator

SMALL = ["data.width=80", "data.height=64", "data.train_count=4", "data.workers=0", "data.cache_dir=null"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_stage_gets_a_picture_of_scenes_by_difficulties(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gallery", *SMALL, "scenes=2", "difficulties=[0,1]"]) == 0
    (folder,) = (here / "runs").iterdir()
    printed = capsys.readouterr().out
    for stage in ("joint", "completion", "full"):
        assert str(folder / f"{stage}.png") in printed
        image = cv2.imread(str(folder / f"{stage}.png"))
        height, width = image.shape[:2]
        assert width > 3 * 6 * 80 and height > 2 * 2 * 6 * 64  # truth and two columns; two pictures a row, six times
    assert {path.name for path in folder.glob("*.png")} == {"joint.png", "completion.png", "full.png"}


def test_nothing_changes_from_the_truth_to_difficulty_zero_and_all_does_to_one(
    make_loader: Callable[..., DataLoader],
) -> None:
    batch = next(iter(make_loader(count=1)))
    truth, easy, hard = draw_scene(SensorSimulator(Holes(), 80.0), batch, [0.0, 1.0], seed=0)
    caption_px = 32
    np.testing.assert_array_equal(truth[caption_px : truth.shape[0] // 2], easy[caption_px : easy.shape[0] // 2])
    assert (truth[caption_px:] != hard[caption_px:]).any(axis=-1).mean() > 0.2


@pytest.mark.parametrize("override", ["scenes=0", "difficulties=[0,2]", "difficulties=[]", "stages.full.epochs=0"])
def test_bad_overrides_are_one_sentence_and_write_nothing(
    override: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gallery", override]) == 2
    said = capsys.readouterr().err
    assert override.split("=")[0] in said and said.count("\n") == 1
    assert not list(here.iterdir())
