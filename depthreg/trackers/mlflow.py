"""MLflow; its runs are in a database, by default an SQLite file, which needs no server."""

import os
from contextlib import nullcontext
from pathlib import Path

from filelock import FileLock
from lightning.pytorch.loggers import Logger, MLFlowLogger
from lightning.pytorch.utilities import rank_zero_only
from PIL import Image

from depthreg.errors import InputError
from depthreg.report import Results
from depthreg.trackers.base import Run, Tracker, final_scores

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")  # it asks the network
os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
from mlflow import MlflowClient
from mlflow.entities import Metric
from mlflow.exceptions import MlflowException
from mlflow.utils.time import get_current_time_millis

_ID = "depthreg_id"  # the tag by which a resumed run is found
_SQLITE = "sqlite:///"
DEFAULT_URI = f"{_SQLITE}runs/mlflow.db"


class StageMLFlowLogger(MLFlowLogger):
    """Lightning's logger, which shows pictures too, and doesn't end the run with the stage."""

    LOGGER_JOIN_CHAR = "/"

    @rank_zero_only
    def log_image(self, key: str, images: list[str], step: int) -> None:
        """Show picture files."""
        for path in images:
            self.experiment.log_image(self.run_id, Image.open(path), key=f"{self._prefix}/{key}", step=step)

    def finalize(self, status: str = "success") -> None:
        """The tracker ends the run."""


class MLflowTracker(Tracker):
    """A run of MLflow, which a resumed run goes on with.

    Args:
        run: What it shows.
        experiment: MLflow's name for what holds runs.
        tracking_uri: A database or a server; where not given, that of `MLFLOW_TRACKING_URI`, or else an SQLite file.
        checkpoints: Keep each stage's checkpoints, as copies.

    Raises:
        InputError: There is no such place.
    """

    def __init__(self, run: Run, experiment: str, tracking_uri: str | None = None, checkpoints: bool = True) -> None:
        super().__init__(run)
        self.checkpoints = checkpoints
        tracking_uri = tracking_uri or os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_URI
        database = Path(tracking_uri.removeprefix(_SQLITE)).absolute() if tracking_uri.startswith(_SQLITE) else None
        self.uri = f"{_SQLITE}{database}" if database else tracking_uri
        try:
            if database:
                database.parent.mkdir(parents=True, exist_ok=True)
            # Of two processes that make a database at the same time, one fails.
            with FileLock(f"{database}.lock") if database else nullcontext():
                self.client = MlflowClient(self.uri)
                experiment_id = self._experiment_id(experiment, database)
            self.run_id = self._run_id(experiment_id)
        except (MlflowException, OSError) as error:
            raise InputError(f"logger.mlflow.tracking_uri={tracking_uri}: {error}") from error

    def _experiment_id(self, name: str, database: Path | None) -> str:
        if found := self.client.get_experiment_by_name(name):
            return found.experiment_id
        files = (database.parent / "mlartifacts").as_uri() if database else None
        return self.client.create_experiment(name, artifact_location=files)

    def _run_id(self, experiment_id: str) -> str:
        """Of the run that is resumed, or of a new one."""
        if found := self.client.search_runs([experiment_id], f"tags.{_ID} = '{self.run.id}'"):
            self.client.update_run(found[0].info.run_id, status="RUNNING")
            return found[0].info.run_id
        tags = {_ID: self.run.id, "group": self.run.group, "job_type": self.run.job_type}
        tags |= {tag: "true" for tag in self.run.tags}
        new = self.client.create_run(experiment_id, run_name=self.run.name, tags=tags).info.run_id
        logger = MLFlowLogger(run_id=new, tracking_uri=self.uri)
        logger.log_hyperparams(self.run.parameters)
        self.client.log_artifact(new, str(self.run.folder / "run.yaml"))
        return new

    @property
    def hint(self) -> str:
        """Starts the pages that show all runs."""
        return f"mlflow ui --backend-store-uri {self.uri}" if self.uri.startswith(_SQLITE) else self.uri

    def stage_logger(self, stage: str, first_step: int) -> Logger:
        """MLflow can't take back what is logged: steps after a resumed run's last checkpoint are in it twice."""
        return StageMLFlowLogger(run_id=self.run_id, tracking_uri=self.uri, prefix=stage)

    def log_checkpoints(self, stage: str, paths: list[Path]) -> None:
        """As artifacts."""
        if self.checkpoints:
            for path in paths:
                self.client.log_artifact(self.run_id, str(path), f"checkpoints/{stage}")

    def log_results(self, results: Results) -> None:
        """As metrics, and the whole table as artifacts."""
        now_ms = get_current_time_millis()
        metrics = [Metric(name, value, now_ms, 0) for name, value in final_scores(results).items()]
        self.client.log_batch(self.run_id, metrics)
        for name in ("metrics.csv", "metrics.md"):
            self.client.log_artifact(self.run_id, str(self.run.folder / name), "final")

    def close(self, succeeded: bool) -> None:
        """Finish the run, or mark it as failed."""
        self.client.set_terminated(self.run_id, "FINISHED" if succeeded else "FAILED")
