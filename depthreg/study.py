"""Optuna's part in a sweep: a study in a file that the sweeper and its jobs share, wherever they run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning as L
import optuna
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.utils import instantiate
from omegaconf import OmegaConf
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from depthreg.data import io
from depthreg.errors import InputError
from depthreg.sweeps import Failure, Pruned

Batches = list[Sequence[JobReturn]]


def split_overrides(overrides: Sequence[str]) -> tuple[dict[str, str], dict[str, BaseDistribution]]:
    """Overrides that hold one value, and the search space that the others span, both by their keys.

    Raises:
        InputError: An interval has no values.
    """
    fixed: dict[str, str] = {}
    space: dict[str, BaseDistribution] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if override.is_sweep_override():
            try:
                space[key] = _distribution(override)
            except ValueError as error:
                raise InputError(f"{override.input_line}: {error}") from error
            fixed.pop(key, None)
        else:
            fixed[key] = override.get_value_element_as_str()
            space.pop(key, None)
    return fixed, space


def _distribution(override: Override) -> BaseDistribution:
    value = override.value()
    if isinstance(value, IntervalSweep):
        assert value.start is not None and value.end is not None
        log = "log" in value.tags
        if isinstance(value.start, int) and isinstance(value.end, int):
            return IntDistribution(value.start, value.end, log=log)
        return FloatDistribution(value.start, value.end, log=log)
    return CategoricalDistribution(list(override.sweep_string_iterator()))


def open_study(storage: str, sampler: BaseSampler | None = None, pruner: BasePruner | None = None) -> optuna.Study:
    """The study in a file, which is made where it isn't there."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    backend = JournalFileBackend(storage)  # unlike SQLite, safe on network file systems
    return optuna.create_study(
        study_name="depthreg", storage=JournalStorage(backend), sampler=sampler, pruner=pruner, load_if_exists=True
    )


def search(study: optuna.Study, launcher: Launcher, overrides: Sequence[str], n_trials: int, n_jobs: int) -> Batches:
    """Ask a study for values, run jobs with them, and tell it what came out; a job has its trial's number.

    Args:
        study: Perhaps of an earlier search, which goes on.
        launcher: Runs `n_jobs` jobs at a time.
        overrides: Of all jobs; those that sweep are the search space.
        n_trials: How many jobs.
        n_jobs: Jobs in a batch; the next batch waits for the last one's results.

    Returns:
        What the launcher returned, batch by batch.

    Raises:
        InputError: An interval has no values.
    """
    fixed, space = split_overrides(overrides)
    batches: Batches = []
    for start in range(0, n_trials, n_jobs):
        trials = [study.ask(space) for _ in range(min(n_jobs, n_trials - start))]
        jobs = [[f"{key}={value}" for key, value in (fixed | trial.params).items()] for trial in trials]
        batches.append(launcher.launch(jobs, initial_job_idx=trials[0].number))
        for trial, job in zip(trials, batches[-1], strict=True):
            _tell(study, trial, job.return_value)
    return batches


def _tell(study: optuna.Study, trial: optuna.Trial, result: Any) -> None:
    if isinstance(result, Failure):
        study.tell(trial, state=TrialState.PRUNED if result.kind == "pruned" else TrialState.FAIL)
    else:
        study.tell(trial, result)  # a failure, too, where it isn't a finite number


def save_best(study: optuna.Study, path: Path) -> None:
    """Write which job was best, and by which overrides, if any ended."""
    if not study.get_trials(states=(TrialState.COMPLETE,)):
        return
    best = study.best_trial
    with io.atomic_write(path) as partial:
        OmegaConf.save({"job": best.number, "value": best.value, "overrides": best.params}, partial)


def current_trial() -> optuna.Trial:
    """The trial that this job of a sweep is."""
    hydra = HydraConfig.get()
    study = open_study(hydra.sweeper.storage, pruner=instantiate(hydra.sweeper.pruner))
    (number,) = (trial._trial_id for trial in study.get_trials(deepcopy=False) if trial.number == hydra.job.num)
    return optuna.Trial(study, number)


class Pruning(L.Callback):
    """Tells the study a metric after each epoch, and ends the job where the study's pruner has seen enough.

    Args:
        trial: Of the study.
        monitor: A metric that is logged in validation; less is better.

    Raises:
        Pruned: From within training.
    """

    def __init__(self, trial: optuna.Trial, monitor: str = "val/rmse_m") -> None:
        self.trial, self.monitor = trial, monitor

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Lightning calls this after each epoch's validation, in every process."""
        if trainer.sanity_checking:
            return
        value = float(trainer.callback_metrics[self.monitor])
        behind = False
        if trainer.is_global_zero:
            self.trial.report(value, trainer.current_epoch)
            behind = self.trial.should_prune()
        if trainer.strategy.broadcast(behind):
            raise Pruned(f"pruned after epoch {trainer.current_epoch} at {self.monitor}={value:.4g}")
