"""Pictures of fixed validation frames through the epochs."""

from pathlib import Path

import lightning as L
import torch

from depthreg.data.io import write_png
from depthreg.data.sample import Measurement
from depthreg.stage import Stage
from depthreg.viz import sample_panel


class Panels(L.Callback):
    """Draws the first validation frames every few epochs and after the last, into `<stage>/panels/`.

    Loggers that show pictures, by a method `log_image`, get them too.

    Args:
        every_epochs: Epochs between pictures.
        count: Frames drawn, one file each.
    """

    def __init__(self, every_epochs: int = 5, count: int = 3) -> None:
        if min(every_epochs, count) < 1:
            raise ValueError(f"every_epochs and count must be positive, got {every_epochs}, {count}")
        self.every_epochs, self.count = every_epochs, count

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: object,
        batch: Measurement,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw from the first batch, where this epoch's turn has come."""
        epoch, last = trainer.current_epoch, (trainer.max_epochs or 1) - 1
        if batch_idx or not trainer.is_global_zero or (epoch % self.every_epochs and epoch != last):
            return
        assert isinstance(pl_module, Stage)
        folder = Path(trainer.default_root_dir) / "panels"
        folder.mkdir(parents=True, exist_ok=True)
        for i in range(min(self.count, len(batch["rgb"]))):
            rgb, depth_m, truth_m = (batch[key][i : i + 1] for key in ("rgb", "depth_m", "truth_depth_m"))
            with torch.inference_mode():
                output = pl_module.network(rgb, depth_m)
            path = folder / f"epoch_{epoch:03d}_frame_{i}.png"
            write_png(path, sample_panel(rgb, depth_m, output, truth_m))
            for logger in trainer.loggers:
                if log_image := getattr(logger, "log_image", None):
                    log_image(f"panels/frame_{i}", [str(path)], step=trainer.global_step - 1)  # as epochs' metrics
