"""TensorBoard; a run is a folder of event files, with one for each stage in it."""

from typing import Any

import numpy as np
import yaml
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from depthreg.report import Results, markdown
from depthreg.trackers.base import Run, Tracker, final_scores


class StageTensorBoardLogger(TensorBoardLogger):
    """Lightning's logger, which shows pictures too."""

    @rank_zero_only
    def log_image(self, key: str, images: list[str], step: int) -> None:
        """Show picture files."""
        for path in images:
            self.experiment.add_image(key, np.asarray(Image.open(path)), step, dataformats="HWC")


class TensorBoardTracker(Tracker):
    """Event files in `tensorboard/` of the run's folder; checkpoints stay where they are.

    Args:
        run: What it shows.
    """

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self.folder = run.folder / "tensorboard"
        with self._writer() as writer:
            writer.add_text("run", f"```yaml\n{yaml.safe_dump(dict(run.record), sort_keys=False)}```")

    def _writer(self) -> SummaryWriter:
        return SummaryWriter(str(self.folder))

    @property
    def hint(self) -> str:
        """Shows the run beside all others of the folder."""
        return f"tensorboard --logdir {self.run.folder.parent}"

    def stage_logger(self, stage: str, first_step: int) -> Logger:
        """Events of a folder of its own, as taking back steps takes them back for a whole folder."""
        purge: dict[str, Any] = {"purge_step": first_step} if first_step else {}
        return StageTensorBoardLogger(self.folder, name=stage, version="", **purge)

    def log_results(self, results: Results) -> None:
        """As text, and with the configuration for the tab of hyperparameters."""
        with self._writer() as writer:
            writer.add_text("final", markdown(results))
        logger = TensorBoardLogger(self.folder, name="", version="")
        logger.log_hyperparams(self.run.parameters, final_scores(results))
        logger.finalize("finished")

    def close(self, succeeded: bool) -> None:
        """There is nothing to end; what was logged is on disk."""
