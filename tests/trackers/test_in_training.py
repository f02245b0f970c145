"""What `depthreg train` leaves in its trackers."""

import csv
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from depthreg.cli import main
from depthreg.stage import Stage

TINY = [
    "data.width=80",
    "data.height=64",
    "data.train_count=4",
    "data.val_count=2",
    "data.batch_size=2",
    "data.workers=0",
    "model.completion_widths=[16,16]",
    "trainer.accelerator=cpu",
    "curriculum=[joint]",
    "epochs.joint=3",
    "callbacks.panels=null",
]
TIMES = ("train/frames_per_s", "train/wait_share")

Train = Callable[..., Path]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where rendered frames are kept."""
    return tmp_path_factory.mktemp("frames")


@pytest.fixture
def train(frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Train:
    """Runs the command and gives the folder that it was given."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, *overrides: str) -> Path:
        command = ["train", *TINY, f"data.cache_dir={frames}", f"hydra.run.dir={name}", *overrides]
        assert main(command) == 0
        return tmp_path / name

    return run


def curves(folder: Path) -> list[dict[str, str]]:
    """The rows of a stage's log, without how long things took."""
    with (folder / "metrics.csv").open(newline="") as file:
        return [{key: row[key] for key in row if key not in TIMES} for row in csv.DictReader(file)]


def interrupt(monkeypatch: pytest.MonkeyPatch, at_epoch: int, at_batch: int = 1) -> None:
    """Training fails at a step of an epoch."""
    step = Stage.training_step

    def failing(self: Stage, batch: object, batch_idx: int) -> object:
        if self.trainer.current_epoch == at_epoch and batch_idx == at_batch:
            raise RuntimeError("out of power")
        return step(self, batch, batch_idx)

    monkeypatch.setattr(Stage, "training_step", failing)


@pytest.fixture(scope="module")
def undisturbed(frames: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    """The log of a run that nothing happened to."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert main(["train", *TINY, f"data.cache_dir={frames}", f"hydra.run.dir={folder}", "logger=csv"]) == 0
    return curves(folder / "joint")


@pytest.mark.parametrize(("at_epoch", "at_batch", "rows"), [(0, 1, 1), (1, 1, 4), (2, 0, 7)])
def test_the_log_of_a_resumed_run_is_that_of_an_undisturbed_one(
    at_epoch: int,
    at_batch: int,
    rows: int,
    undisturbed: list[dict[str, str]],
    train: Train,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        interrupt(patch, at_epoch, at_batch)
        with pytest.raises(RuntimeError, match="out of power"):
            train("stopped", "logger=csv", "checkpoint_every_steps=1")  # so it goes on within the epoch
    log = tmp_path / "stopped" / "joint" / "metrics.csv"
    assert len(curves(log.parent)) == rows
    assert main(["train", f"resume={tmp_path / 'stopped'}"]) == 0
    assert curves(log.parent) == undisturbed


def test_a_row_that_was_not_written_before_a_process_was_killed_comes_back(
    undisturbed: list[dict[str, str]], train: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        interrupt(patch, at_epoch=2, at_batch=0)
        with pytest.raises(RuntimeError, match="out of power"):
            train("stopped", "logger=csv")
    log = tmp_path / "stopped" / "joint" / "metrics.csv"
    *written, of_training, _ = log.read_text().splitlines(keepends=True)  # the last one is the third epoch's
    assert of_training.startswith("1,")
    log.write_text("".join(written))
    assert main(["train", f"resume={tmp_path / 'stopped'}"]) == 0
    assert curves(log.parent) == undisturbed


@pytest.mark.parametrize("choice", ["csv", "[csv,wandb]"])
def test_csv_is_there_whatever_else_is_chosen(choice: str, train: Train) -> None:
    folder = train("run", f"logger={choice}", "epochs.joint=1")
    assert curves(folder / "joint")
    assert (folder / "wandb").exists() == ("wandb" in choice)
    if "wandb" in choice:
        (run,) = (folder / "wandb").glob("offline-run-*")
        assert run.name.endswith(yaml.safe_load((folder / "run.yaml").read_text())["id"])


@pytest.mark.parametrize("name", ["wandb", "mlflow", "tensorboard"])
def test_a_tracker_that_is_not_installed_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, name, None)
    assert main(["train", *TINY, f"logger={name}"]) == 2
    message = capsys.readouterr().err
    assert f"logger={name} needs a package" in message and len(message.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
