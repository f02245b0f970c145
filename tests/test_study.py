"""Optuna's sweeper: what it asks for, what it is told, and which jobs it stops."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
import yaml
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher

from depthreg.cli import main
from depthreg.errors import InputError
from depthreg.sweeps import Failure, Pruned

optuna = pytest.importorskip(
    "optuna", minversion="4", reason="Optuna 4 isn't installed: pip install 'depthreg[sweeps]'"
)
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution  # noqa: E402
from optuna.trial import TrialState  # noqa: E402

from depthreg.study import Pruning, open_study, save_best, search, split_overrides  # noqa: E402


@pytest.mark.parametrize(
    ("override", "distribution"),
    [
        ("x=1,2,a", CategoricalDistribution(["1", "2", "a"])),
        ("x=range(0,6,2)", CategoricalDistribution(["0", "2", "4"])),
        ("x=int(interval(1,5))", IntDistribution(1, 5)),
        ("x=interval(1,5)", FloatDistribution(1, 5)),
        ("x=interval(0.5,1)", FloatDistribution(0.5, 1)),
        ("x=tag(log,interval(1e-4,1e-2))", FloatDistribution(1e-4, 1e-2, log=True)),
    ],
)
def test_what_sweeps_is_the_search_space(override: str, distribution: object) -> None:
    assert split_overrides([override, "y=[1,2]"]) == ({"y": "[1,2]"}, {"x": distribution})


def test_the_last_of_two_overrides_counts() -> None:
    assert split_overrides(["x=1,2", "x=3"]) == ({"x": "3"}, {})
    assert split_overrides(["x=3", "x=1,2"]) == ({}, {"x": CategoricalDistribution(["1", "2"])})


@pytest.mark.parametrize("override", ["x=interval(2.0,1.0)", "x=tag(log,interval(0.0,1.0))"])
def test_an_interval_without_values_is_refused(override: str) -> None:
    with pytest.raises(InputError, match="x="):
        split_overrides([override])


class Answers(Launcher):
    """Gives results instead of running jobs, and keeps what it was asked to run."""

    def __init__(self, results: Sequence[Any]) -> None:
        self.results, self.asked = list(results), []

    def setup(self, **_: Any) -> None: ...

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        self.asked += [(initial_job_idx + i, *overrides) for i, overrides in enumerate(job_overrides)]
        return [JobReturn(status=JobStatus.COMPLETED, _return_value=self.results.pop(0)) for _ in job_overrides]


def test_the_study_is_told_what_became_of_each_job(tmp_path: Path) -> None:
    study = open_study(str(tmp_path / "study"))
    launcher = Answers([3.0, Failure("error", "x"), Failure("pruned", "x"), 2.0, float("nan")])
    batches = search(study, launcher, ["a=interval(0.0,1.0)", "b=7"], n_trials=5, n_jobs=2)
    assert [len(batch) for batch in batches] == [2, 2, 1]
    states = [trial.state for trial in study.trials]
    assert states == [getattr(TrialState, name) for name in ("COMPLETE", "FAIL", "PRUNED", "COMPLETE", "FAIL")]
    assert launcher.asked == [(trial.number, "b=7", f"a={trial.params['a']}") for trial in study.trials]
    save_best(study, tmp_path / "best.yaml")
    best = yaml.safe_load((tmp_path / "best.yaml").read_text())
    assert (best["job"], best["value"], best["overrides"]) == (3, 2.0, study.trials[3].params)


def test_a_search_goes_on_with_the_study_in_its_file(tmp_path: Path) -> None:
    for first in (0, 2):
        launcher = Answers([1.0, 2.0])
        search(open_study(str(tmp_path / "study")), launcher, ["a=1,2"], n_trials=2, n_jobs=1)
        assert [number for number, _ in launcher.asked] == [first, first + 1]


def test_a_search_in_which_every_job_failed_has_no_best(tmp_path: Path) -> None:
    study = open_study(str(tmp_path / "study"))
    search(study, Answers([Failure("error", "x")]), ["a=1,2"], n_trials=1, n_jobs=1)
    save_best(study, tmp_path / "best.yaml")
    assert not (tmp_path / "best.yaml").exists()


class Worsening(L.LightningModule):
    """Its metric is 1, 2, 3, ... in the epochs."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def training_step(self, batch: torch.Tensor) -> torch.Tensor:
        return (self.weight * batch).sum()

    def validation_step(self, batch: torch.Tensor) -> None:
        self.log("val/rmse_m", float(self.current_epoch + 1))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), 0.1)


def test_a_job_that_falls_behind_is_stopped_in_the_epoch_in_which_it_does(tmp_path: Path) -> None:
    study = open_study(str(tmp_path / "study"), pruner=optuna.pruners.ThresholdPruner(upper=2.5))
    trial = study.ask()
    trainer = L.Trainer(
        accelerator="cpu",
        max_epochs=9,
        callbacks=[Pruning(trial)],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    loader = torch.utils.data.DataLoader(torch.ones(2, 1))
    with pytest.raises(Pruned, match=r"epoch 2 at val/rmse_m=3"):
        trainer.fit(Worsening(), loader, loader)
    assert study.trials[0].intermediate_values == {0: 1.0, 1: 2.0, 2: 3.0}


def test_training_is_pruned_by_the_study_of_its_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every job is behind a threshold that none can reach: each reports the first epoch of its last stage alone."""
    monkeypatch.chdir(tmp_path)
    pruner = ["_target_=optuna.pruners.ThresholdPruner", "upper=1.0e-6"]
    arguments = [
        *("hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "hydra.sweep.dir=sweep"),
        *(f"++hydra.sweeper.pruner.{option}" for option in pruner),
        "~hydra.sweeper.pruner.n_startup_trials",
        *("data.width=80", "data.height=64", "data.train_count=2", "data.val_count=1", "data.batch_size=2"),
        *("data.workers=0", "model.completion_widths=[16,16]", "trainer.accelerator=cpu", "logger=csv"),
        *("curriculum=[completion,joint]", "epochs.completion=1", "epochs.joint=3", "callbacks.panels=null"),
    ]
    assert main(["train", "-m", *arguments, "learning_rate=tag(log,interval(1e-4,1e-2))"]) == 0
    assert "job 1  pruned after epoch 0" in capsys.readouterr().out
    trials = open_study(str(tmp_path / "sweep" / "optuna.journal")).trials
    assert [trial.state for trial in trials] == [TrialState.PRUNED] * 2
    for trial in trials:
        assert list(trial.intermediate_values) == [0]
        run = tmp_path / "sweep" / str(trial.number)
        assert (run / "completion" / "finished.yaml").exists() and not (run / "joint" / "finished.yaml").exists()
        record = yaml.safe_load((run / "run.yaml").read_text())
        assert record["config"]["learning_rate"] == trial.params["learning_rate"]
