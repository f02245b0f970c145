"""What Lightning and PyTorch do by configuration alone."""

import csv
from collections.abc import Callable
from pathlib import Path

import lightning as L
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from depthreg.cli import main
from depthreg.config import compose_config
from depthreg.networks import JointNetwork

TINY = [
    *("data.width=80", "data.height=64", "data.train_count=4", "data.val_count=2", "data.batch_size=2"),
    *("data.workers=0", "model.completion_widths=[16]", "model.registration_widths=[8,8]"),
    *("model.registration_hidden=8", "model.matchers=[[4,2,5]]", "trainer.accelerator=cpu", "logger=csv"),
    *("curriculum=[full]", "epochs.full=1", "epochs.joint=1", "epochs.completion=1", "hydra.run.dir=run"),
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
            assert main(["train", *TINY, f"data.cache_dir={frames}", *overrides]) == 0
        return folder / "run"

    return run


@pytest.fixture(scope="module")
def plain(train: Train) -> Path:
    """A run with nothing special."""
    return train()


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["state_dict"]


def last_value(run: Path, name: str) -> float:
    with (run / "full" / "metrics.csv").open() as file:
        return [float(row[name]) for row in csv.DictReader(file) if row[name]][-1]


def test_half_precision_computes_nearly_the_same_and_keeps_whole_weights(plain: Path, train: Train) -> None:
    half = train("trainer.precision=bf16-mixed")
    assert last_value(half, "train/loss") == pytest.approx(last_value(plain, "train/loss"), rel=0.05)
    ours, theirs = weights(half / "full/last.ckpt"), weights(plain / "full/last.ckpt")
    assert {value.dtype for value in ours.values()} == {torch.float32, torch.int64}
    assert any(not torch.equal(ours[key], theirs[key]) for key in theirs)  # bfloat16 has 8 bits of precision


def test_a_compiled_network_learns_the_same_under_the_same_names(
    plain: Path, train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PyTorch traces and guards as always, and then runs its usual operators: generating code would take minutes."""
    compiled, compile_network = [], nn.Module.compile

    def trace(network: nn.Module) -> None:
        compiled.append(type(network))
        compile_network(network, backend="eager")

    monkeypatch.setattr(nn.Module, "compile", trace)
    torch._dynamo.reset()
    run = train("compile=true", "callbacks.panels=null")
    assert compiled == [JointNetwork] and torch._dynamo.utils.counters["stats"]["unique_graphs"] >= 2
    assert torch._dynamo.utils.counters["graph_break"] == {}
    ours, theirs = weights(run / "full/last.ckpt"), weights(plain / "full/last.ckpt")
    assert ours.keys() == theirs.keys()
    assert [key for key in theirs if not torch.equal(ours[key], theirs[key])] == []


def test_averaged_weights_are_kept_validated_and_handed_on(train: Train) -> None:
    run = train("callbacks=ema", "curriculum=[joint,completion]")
    joint, best, completion = (
        weights(run / path) for path in ("joint/last.ckpt", "joint/best.ckpt", "completion/last.ckpt")
    )
    assert all(torch.equal(joint[key], best[key]) for key in joint)
    whole = torch.load(run / "joint/last.ckpt", weights_only=True)["current_model_state"]
    assert any(not torch.equal(joint[key], whole[key]) for key in joint)  # the average of two steps isn't the second
    registration = [key for key in joint if not key.startswith("network.completion.")]
    assert registration and all(torch.equal(joint[key], completion[key]) for key in registration)


class Steep(L.LightningModule):
    """One parameter of four numbers, whose gradient is 100 everywhere; every step subtracts it."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(4))

    def training_step(self, batch: torch.Tensor, batch_idx: int) -> torch.Tensor:
        return 100 * self.weight.sum()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1.0)


@pytest.mark.parametrize(
    ("overrides", "moved"),
    [
        (["trainer.gradient_clip_val=0.5"], 0.5 / 2),  # the norm of (100, 100, 100, 100) is 200
        (["trainer.gradient_clip_val=null"], 100.0),
        (["trainer.gradient_clip_val=7", "+trainer.gradient_clip_algorithm=value"], 7.0),
    ],
)
def test_gradients_are_clipped_as_configured(overrides: list[str], moved: float, tmp_path: Path) -> None:
    options = compose_config("train", ["trainer.accelerator=cpu", *overrides]).trainer
    trainer = L.Trainer(
        **options,
        max_steps=1,
        logger=False,
        default_root_dir=tmp_path,
        enable_checkpointing=False,
        enable_progress_bar=False,
    )
    module = Steep()
    trainer.fit(module, DataLoader(torch.zeros(1)))
    assert module.weight.tolist() == pytest.approx([-moved] * 4, rel=1e-4)
