"""When pictures are drawn, and of what."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import lightning as L
import pytest
import torch
from lightning.pytorch.loggers.logger import DummyLogger
from torch.utils.data import DataLoader

from depthreg.callbacks import FreezeSchedule, Panels
from depthreg.losses import DepthL1, JointLoss
from depthreg.sensors import Clean, SensorSimulator
from depthreg.stage import Stage


def fit(
    folder: Path, epochs: int, network: Any, loader: DataLoader, *callbacks: L.Callback, logger: Any = False
) -> None:
    stage = Stage(
        name="full",
        network=network,
        loss=JointLoss(depth=DepthL1(1)),
        simulator=SensorSimulator(Clean()),
        learning_rate=1e-3,
    )
    trainer = L.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        default_root_dir=folder,
        callbacks=[FreezeSchedule(), *callbacks],
        logger=logger,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(stage, loader, loader)


def test_fixed_frames_are_drawn_every_few_epochs_and_after_the_last(
    tmp_path: Path, make_network: Callable[..., Any], make_loader: Callable[..., DataLoader]
) -> None:
    fit(tmp_path, 6, make_network(), make_loader(4), Panels(every_epochs=2, count=1))
    names = sorted(path.name for path in (tmp_path / "panels").iterdir())
    assert names == [f"epoch_{epoch:03d}_frame_0.png" for epoch in (0, 2, 4, 5)]
    first, last = (cv2.imread(str(tmp_path / "panels" / name)) for name in (names[0], names[-1]))
    assert first.shape == last.shape and min(first.shape[:2]) >= 64
    assert first.std() > 10 and (first != last).any()


def test_no_more_frames_are_drawn_than_there_are(
    tmp_path: Path, make_network: Callable[..., Any], make_loader: Callable[..., DataLoader]
) -> None:
    fit(tmp_path, 1, make_network(), make_loader(2), Panels(count=9))
    assert len(list((tmp_path / "panels").iterdir())) == 2


def test_loggers_that_show_pictures_get_them(
    tmp_path: Path, make_network: Callable[..., Any], make_loader: Callable[..., DataLoader]
) -> None:
    class Shower(DummyLogger):
        def __init__(self) -> None:
            super().__init__()
            self.shown: list[tuple[str, list[str], int]] = []

        def log_image(self, key: str, images: list[str], step: int) -> None:
            self.shown.append((key, images, step))

    shower = Shower()
    fit(tmp_path, 2, make_network(), make_loader(4), Panels(every_epochs=1, count=1), logger=[shower, DummyLogger()])
    paths = sorted(str(path) for path in (tmp_path / "panels").iterdir())
    assert shower.shown == [("panels/frame_0", [path], step) for path, step in zip(paths, (1, 3), strict=True)]


def test_drawing_does_not_disturb_training(
    tmp_path: Path, make_network: Callable[..., Any], make_loader: Callable[..., DataLoader]
) -> None:
    drawn, plain = make_network(), make_network()
    fit(tmp_path / "drawn", 2, drawn, make_loader(2), Panels(every_epochs=1))
    fit(tmp_path / "plain", 2, plain, make_loader(2))
    for ours, theirs in zip(drawn.state_dict().values(), plain.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("option", [{"every_epochs": 0}, {"count": -1}])
def test_a_count_below_one_is_refused(option: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        Panels(**option)
