"""Where Hydra looks for sweepers; what this one does is in `depthreg.study`.

The plugin hydra-optuna-sweeper wants Optuna 2, whose storage, which pruning needs, doesn't work with SQLAlchemy 2.
"""

from pathlib import Path
from typing import Any

from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf


class OptunaSweeper(Sweeper):
    """Optuna's choice of values: `hydra/sweeper=optuna`, with the options of conf/hydra/sweeper/optuna.yaml."""

    def __init__(
        self, n_trials: int, n_jobs: int, storage: str, sampler: Any, pruner: Any, params: dict[str, str] | None
    ) -> None:
        self.n_trials, self.n_jobs, self.storage = n_trials, n_jobs, storage
        self.sampler, self.pruner, self.params = sampler, pruner, params or {}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Hydra calls this before `sweep`."""
        self.folder: Path = Path(config.hydra.sweep.dir)
        self.record = config
        self.launcher: Launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        """Run `n_trials` jobs, in batches of `n_jobs`; returns what the launcher returned, batch by batch."""
        from depthreg.study import open_study, save_best, search  # Optuna only where it is asked for

        self.folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.record, self.folder / "multirun.yaml")
        study = open_study(self.storage, self.sampler, self.pruner)
        overrides = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        batches = search(study, self.launcher, overrides, self.n_trials, self.n_jobs)
        save_best(study, self.folder / "best.yaml")
        return batches
