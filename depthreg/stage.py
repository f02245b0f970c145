"""A stage of the curriculum: one network, one step, one way to measure."""

import time
from collections.abc import Sequence
from typing import Any, cast

import lightning as L
import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torchmetrics import MeanMetric, MetricCollection

from depthreg.checkpoint import described
from depthreg.data.sample import FrameBatch, Measurement
from depthreg.distractors import add_distractors
from depthreg.losses import JointLoss
from depthreg.metrics import DepthMetrics, RegistrationMetrics
from depthreg.networks import JointOutput, Network
from depthreg.sensors.simulator import SensorSimulator, augment, frame_generators, simulate_each


class Stage(L.LightningModule):
    """Trains the network that all stages share on measurements of one difficulty an epoch.

    What makes a stage is its configuration: world and sensors through the simulator, and what the callbacks
    `DifficultyRamp` and `FreezeSchedule` derive from the epoch.

    Validation always measures at `val_difficulty`, with draws seeded by the sample, so that its figures can be compared
    between epochs, batch sizes and machines.

    Args:
        name: Of the stage; part of the seed, the folder and the log.
        network: Shared by all stages.
        loss: The training loss.
        simulator: Turns frames into measurements on the device.
        learning_rate: Adam's.
        weight_decay: Adam's.
        warmup_steps: Steps over which the learning rate rises; without them registration doesn't start to learn.
        lr_milestones: Shares of the stage's steps after which the learning rate is divided by `lr_divisor`.
        lr_divisor: See `lr_milestones`.
        brightness: Largest relative change of brightness in training.
        impostor_share: Share of training samples whose colour belongs to another place; see `augment`.
        distractor_share: Share of training samples with shadows, and with reflections; see `add_distractors`.
        val_difficulty: Difficulty of validation, in [0, 1].
        seed: First number of every random draw.
    """

    difficulty: float = 0.0  # of training, in [0, 1]; set by the difficulty callback each epoch
    batch_came_s: float = 0.0  # when the loader had the newest batch, by time.perf_counter

    def __init__(
        self,
        name: str,
        network: Network,
        loss: JointLoss,
        simulator: SensorSimulator,
        learning_rate: float,
        weight_decay: float = 1e-5,
        warmup_steps: int = 40,
        lr_milestones: Sequence[float] = (),
        lr_divisor: float = 3.0,
        brightness: float = 0.2,
        impostor_share: float = 0.0,
        distractor_share: float = 0.0,
        val_difficulty: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        shares = {
            "val_difficulty": val_difficulty,
            "impostor_share": impostor_share,
            "distractor_share": distractor_share,
        }
        if learning_rate <= 0 or weight_decay < 0 or not all(0 <= share <= 1 for share in shares.values()):
            raise ValueError(
                f"expected learning_rate > 0, weight_decay >= 0, {' and '.join(shares)} in [0, 1], "
                f"got {learning_rate}, {weight_decay}, {', '.join(map(str, shares.values()))}"
            )
        self.name, self.network, self.loss, self.simulator = name, network, loss, simulator
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self.warmup_steps, self.lr_milestones, self.lr_divisor = warmup_steps, tuple(lr_milestones), lr_divisor
        self.brightness, self.impostor_share, self.distractor_share = brightness, impostor_share, distractor_share
        self.val_difficulty, self.seed = val_difficulty, seed
        self.depth_metrics, self.registration_metrics = DepthMetrics(), RegistrationMetrics()
        # Lightning's own means over an epoch are wrong where processes have unequally many frames.
        names = [_logged(name) for name in ("total", *loss.terms)]
        self.val_losses = MetricCollection({name: MeanMetric() for name in names}, compute_groups=False)
        # Of an epoch; looking for NaN would make a GPU wait for every step.
        self.train_means = nn.ModuleDict({name: MeanMetric(nan_strategy="disable") for name in (*names, "grad_norm")})

    def on_before_batch_transfer(
        self, batch: FrameBatch | Measurement, dataloader_idx: int
    ) -> FrameBatch | Measurement:
        """Note the time, for `Throughput`."""
        self.batch_came_s = time.perf_counter()
        return batch

    def on_after_batch_transfer(self, batch: FrameBatch | Measurement, dataloader_idx: int) -> Measurement:
        """Simulate sensors on the device; a batch that is measured already passes through."""
        if "lidar" not in batch:
            return batch
        frames = cast(FrameBatch, batch)
        if not self.trainer.training:
            return simulate_each(self.simulator, frames, self.val_difficulty, frame_generators(frames, self.seed))
        generators = frame_generators(frames, self.seed, *self.name.encode(), self.trainer.current_epoch)
        measured = simulate_each(self.simulator, frames, self.difficulty, generators)
        augmented = augment(measured, generators, self.brightness, self.impostor_share)
        return add_distractors(augmented, generators, self.distractor_share)

    def _step(self, batch: Measurement) -> tuple[JointOutput, dict[str, Tensor]]:
        """What the network says, and the losses by the names under which they are logged."""
        output = self.network(batch["rgb"], batch["depth_m"])
        losses = self.loss(output, batch)
        return output, {_logged(name): value for name, value in losses.items()}

    def training_step(self, batch: Measurement, batch_idx: int) -> Tensor:
        """The loss of a batch."""
        _, losses = self._step(batch)
        for name, value in losses.items():
            self._log_mean(name, value.detach())
        return losses["loss"]

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Log the gradient's 2-norm over all that learns, before it is clipped."""
        gradients = [parameter.grad for parameter in self.network.parameters() if parameter.grad is not None]
        norms = [torch.linalg.vector_norm(gradient) for gradient in gradients]
        self._log_mean("grad_norm", torch.linalg.vector_norm(torch.stack(norms)))

    def on_train_epoch_start(self) -> None:
        """Begin the epoch's means; a run that is resumed within an epoch goes on with those of its checkpoint."""
        for mean in self.train_means.values():
            cast(MeanMetric, mean).reset()

    def _log_mean(self, name: str, value: Tensor) -> None:
        """Add a step to an epoch's mean."""
        mean = cast(MeanMetric, self.train_means[name])
        mean.update(value)
        self.log(f"train/{name}", mean, on_step=False, on_epoch=True)

    def validation_step(self, batch: Measurement, batch_idx: int) -> None:
        """Add a batch to the epoch's metrics."""
        output, losses = self._step(batch)
        for name, value in losses.items():
            cast(MeanMetric, self.val_losses[name]).update(value, len(batch["rgb"]))
        self.depth_metrics.update(output.depth_m, batch["truth_depth_m"])
        height, width = batch["rgb"].shape[-2:]
        truth = batch["truth_affine_rgb_from_depth"]
        self.registration_metrics.update(output.affine_rgb_from_depth, truth, (height, width))

    def on_validation_epoch_end(self) -> None:
        """Log losses, depth and registration metrics over all validation frames."""
        for metrics in (self.val_losses, self.depth_metrics, self.registration_metrics):
            self.log_dict({f"val/{name}": value for name, value in metrics.compute().items()})
            metrics.reset()

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Adam over every parameter: frozen ones have no gradient, so it leaves them alone."""
        optimizer = torch.optim.Adam(self.network.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._learning_rate_factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _learning_rate_factor(self, step: int) -> float:
        share_done = step / max(float(self.trainer.estimated_stepping_batches), 1)
        drops = sum(share_done >= milestone for milestone in self.lr_milestones)
        return min((step + 1) / max(self.warmup_steps, 1), 1) / self.lr_divisor**drops

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Record which network and stage these weights belong to, and the epoch's means so far."""
        means = {name: cast(MeanMetric, mean).metric_state for name, mean in self.train_means.items()}
        checkpoint["depthreg"] = {**described(self.network), "stage": self.name, "train_means": means}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on with the epoch's means."""
        for name, state in checkpoint["depthreg"]["train_means"].items():
            for key, value in state.items():
                setattr(self.train_means[name], key, value.to(self.device))


def _logged(name: str) -> str:
    """The name under which a part of the loss is logged."""
    return "loss" if name == "total" else f"{name}_loss"
