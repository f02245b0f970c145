"""Which frames a process sees, in which order, and after an interruption."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import BatchSampler

from depthreg.data.datamodule import EpochShuffle, FramesDataModule
from depthreg.errors import InputError


def batches(shuffle: EpochShuffle, size: int) -> list[list[int]]:
    return list(BatchSampler(shuffle, size, drop_last=True))


@pytest.mark.parametrize("ranks", [2, 3])
def test_the_batches_of_all_processes_together_are_those_of_one(ranks: int) -> None:
    alone = batches(EpochShuffle(26, seed=3), 4 * ranks)
    each = [batches(EpochShuffle(26, 3, rank, ranks), 4) for rank in range(ranks)]
    together = [[index for batch in step for index in batch] for step in zip(*each, strict=True)]
    assert [sorted(batch) for batch in together] == [sorted(batch) for batch in alone]
    seen = [index for batch in together for index in batch]
    assert len(seen) == len(set(seen)) == 26 // (4 * ranks) * 4 * ranks


def test_two_batches_in_a_row_are_one_of_double_size() -> None:
    """So that gradients accumulated over two steps are those of the doubled batch."""
    small, large = batches(EpochShuffle(16, 0), 2), batches(EpochShuffle(16, 0), 4)
    assert [first + second for first, second in list(pairwise(small))[::2]] == large


def test_every_process_has_as_many_items_whatever_their_number() -> None:
    shuffles = [EpochShuffle(11, 0, rank, 3) for rank in range(3)]
    assert [len(list(shuffle)) for shuffle in shuffles] == [len(shuffle) for shuffle in shuffles] == [3, 3, 3]


def test_an_epoch_goes_on_after_the_items_that_were_done_and_the_next_one_is_whole() -> None:
    whole, resumed = EpochShuffle(10, 0), EpochShuffle(10, 0, done=(2, 6))
    for epoch, left in ((2, 4), (3, 10), (0, 10)):
        whole.set_epoch(epoch)
        resumed.set_epoch(epoch)
        assert list(resumed) == list(whole)[-left:]
        assert list(resumed) == list(resumed)  # asking twice changes nothing
        assert len(resumed) == 10


class Listener(L.LightningModule):
    """Learns nothing and remembers the frames that it was shown, epoch by epoch."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[tuple[int, list[int]]] = []

    def training_step(self, batch: dict[str, torch.Tensor], batch_idx: int) -> torch.Tensor:
        self.seen.append((self.current_epoch, batch["index"].tolist()))
        return self.weight.sum()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1.0)


@pytest.fixture
def show(make_formula_frames: Callable[..., Any], tmp_path: Path) -> Callable[..., list[tuple[int, list[int]]]]:
    """Shows 3 epochs of 4 batches, all or from a checkpoint on; a checkpoint is kept after each batch and epoch."""

    def run(workers: int, resume: Path | None = None) -> list[tuple[int, list[int]]]:
        data = FramesDataModule(make_formula_frames(9), make_formula_frames(1), batch_size=2, workers=workers, seed=0)
        every = {"save_top_k": -1, "filename": "{step}"}
        keep = [
            ModelCheckpoint(tmp_path / "batch", every_n_train_steps=1, **every),
            ModelCheckpoint(tmp_path / "epoch", every_n_epochs=1, save_on_train_epoch_end=True, **every),
        ]
        listener = Listener()
        trainer = L.Trainer(
            accelerator="cpu",
            max_epochs=3,
            logger=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            callbacks=keep,
            default_root_dir=tmp_path,
        )
        trainer.fit(listener, data, ckpt_path=resume, weights_only=True)
        return listener.seen

    return run


@pytest.mark.parametrize("workers", [0, 1])
def test_a_resumed_run_is_shown_the_frames_that_were_left(
    workers: int, show: Callable[..., list[tuple[int, list[int]]]], tmp_path: Path
) -> None:
    whole = show(workers=0)
    assert len(whole) == 12 and len({tuple(indices) for _, indices in whole}) > 8  # epochs differ
    for place, steps in [("batch", 6), ("batch", 3), ("batch", 8), ("epoch", 8)][: 4 if workers == 0 else 2]:
        assert show(workers, tmp_path / place / f"step={steps}.ckpt") == whole[steps:], (place, steps)


@pytest.mark.parametrize(
    ("train_count", "val_count", "said"),
    [
        (5, 2, "5 training frames: expected at least one batch of 3 in each of 2 processes"),
        (6, 1, "1 validation frames: expected at least one for each of 2 processes"),
    ],
)
def test_too_few_frames_for_so_many_processes_are_refused(
    train_count: int, val_count: int, said: str, make_formula_frames: Callable[..., Any]
) -> None:
    data = FramesDataModule(make_formula_frames(train_count), make_formula_frames(val_count), 3, workers=0, seed=0)
    data.trainer = type("Trainer", (), {"global_rank": 0, "world_size": 2})
    with pytest.raises(InputError, match=said):
        data.train_dataloader()


@pytest.mark.parametrize("count", [1, 5, 6])
def test_validation_frames_are_shared_out_once_each(count: int, make_formula_frames: Callable[..., Any]) -> None:
    seen = []
    for rank in range(2):
        data = FramesDataModule(make_formula_frames(2), make_formula_frames(count), batch_size=2, workers=0, seed=0)
        data.trainer = type("Trainer", (), {"global_rank": rank, "world_size": 2})
        seen += [index for batch in data.val_dataloader() for index in batch["index"].tolist()]
    assert sorted(seen) == list(range(count))
