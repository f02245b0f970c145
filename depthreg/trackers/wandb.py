"""Weights & Biases; offline it needs no account."""

import math
from pathlib import Path

import wandb
from lightning.pytorch.loggers import Logger, WandbLogger

from depthreg.errors import InputError
from depthreg.report import Results, method_names, table_rows
from depthreg.trackers.base import Run, Tracker, final_scores

_STEP = "trainer/global_step"  # Lightning's name for it


class StageWandbLogger(WandbLogger):
    """Groups curves by stage, which wandb does by what is before the first slash."""

    LOGGER_JOIN_CHAR = "/"


class WandbTracker(Tracker):
    """A run of wandb; a resumed one is a second folder of the same id when offline, which `wandb sync` joins.

    Args:
        run: What it shows.
        project: Where on the server.
        offline: Keep everything in the run's folder until `wandb sync` sends it.
        checkpoints: Keep each stage's checkpoints as an artifact; the files aren't copied before they are sent.
        entity: Whose project; the account's own where not given.

    Raises:
        InputError: wandb refuses to start, such as without an account.
    """

    def __init__(
        self, run: Run, project: str, offline: bool = True, checkpoints: bool = True, entity: str | None = None
    ) -> None:
        super().__init__(run)
        self.offline, self.checkpoints = offline, checkpoints
        try:
            self.wandb_run = wandb.init(
                project=project,
                entity=entity,
                dir=run.folder,
                id=run.id,
                name=run.name[:128],
                group=run.group,
                job_type=run.job_type,
                tags=[tag[:64] for tag in run.tags],
                config=run.parameters,
                mode="offline" if offline else None,  # None: as WANDB_MODE says
                resume="allow",
                reinit="create_new",  # two runs in one process are two runs
                settings=wandb.Settings(console="off", silent=True),
            )
        except wandb.Error as error:
            raise InputError(f"logger.wandb: {error}") from error
        self.wandb_run.define_metric(_STEP)
        self.wandb_run.define_metric("*", step_metric=_STEP, step_sync=True)

    @property
    def hint(self) -> str:
        """The terminal's viewer, or the run's page."""
        return f"wandb leet {self.run.folder / 'wandb'}" if self.offline else str(self.wandb_run.url)

    def stage_logger(self, stage: str, first_step: int) -> Logger:
        """wandb can't take back what is logged: steps after a resumed run's last checkpoint are in it twice."""
        return StageWandbLogger(experiment=self.wandb_run, prefix=stage)

    def log_checkpoints(self, stage: str, paths: list[Path]) -> None:
        """As an artifact of the run's and the stage's name."""
        if not self.checkpoints:
            return
        artifact = wandb.Artifact(f"{self.run.id}-{stage}", type="model", metadata={"stage": stage})
        for path in paths:
            artifact.add_file(str(path), policy="immutable")  # it stays, so that wandb needs no copy
        self.wandb_run.log_artifact(artifact)

    def log_results(self, results: Results) -> None:
        """As a table, and the network's scores as the run's summary."""
        rows = [
            [task, metric, *(None if math.isnan(value) else value for value in values)]
            for task, metric, values in table_rows(results)
        ]
        table = wandb.Table(columns=["task", "metric", *method_names(results)], data=rows)
        self.wandb_run.log({"final/table": table})
        self.wandb_run.summary.update(final_scores(results))

    def close(self, succeeded: bool) -> None:
        """Finish the run, or mark it as failed."""
        self.wandb_run.finish(exit_code=0 if succeeded else 1)
