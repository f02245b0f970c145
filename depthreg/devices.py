"""Training on several devices, with a process for each: what has to agree between them."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.distributed
from hydra.types import RunMode
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from omegaconf import DictConfig
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.optim import Optimizer

from depthreg.errors import InputError


class DataParallel(DDPStrategy):
    """Lightning's DDP, with networks that are the same to the bit in every process after every step.

    What learns changes with the epoch, after DDP has looked at it, so DDP has to look for unused parameters in each
    step. BatchNorm's statistics are averaged: DDP itself would copy the first process's before the next forward pass,
    too late for a checkpoint, and would wait for ever in a validation where another process has a batch less.
    """

    def __init__(self) -> None:
        super().__init__(find_unused_parameters=True, broadcast_buffers=False)

    def optimizer_step(
        self,
        optimizer: Optimizer,
        closure: Callable[[], Any],
        model: nn.Module | None = None,
        **kwargs: Any,
    ) -> Any:
        """Step, then average what forward passes left behind."""
        output = super().optimizer_step(optimizer, closure, model, **kwargs)
        assert self.model is not None
        average_statistics(self.model)
        return output


@torch.no_grad()
def average_statistics(network: nn.Module) -> None:
    """Replace BatchNorm's running statistics by their mean over all processes; frozen ones are left alone.

    They are moving averages and so linear: the mean of the means is that of all the batches together. Of the variances
    it is the mean within a process's batch, as each process normalises by its own batch.
    """
    norms = [module for module in network.modules() if isinstance(module, _BatchNorm) and module.training]
    pairs = [(norm.running_mean, norm.running_var) for norm in norms]
    statistics = [statistic for pair in pairs for statistic in pair if statistic is not None]
    if not statistics:
        return
    mean = torch.cat(statistics)  # one message for all
    torch.distributed.all_reduce(mean)
    mean /= torch.distributed.get_world_size()
    for statistic, shared in zip(statistics, mean.split([len(statistic) for statistic in statistics]), strict=True):
        statistic.copy_(shared)


def is_first_process() -> bool:
    """Whether this process is the one that writes and prints."""
    return rank_zero_only.rank == 0  # type: ignore[attr-defined]


def device_count(trainer: DictConfig) -> int | None:
    """Processes of a run; None where that is left to the machine."""
    devices = trainer.devices
    if not isinstance(devices, int):
        devices = -1 if isinstance(devices, str) else len(devices)
    return devices * trainer.num_nodes if devices > 0 else None


def strategy(trainer: DictConfig) -> str | DataParallel:
    """What `trainer.strategy` means here: Lightning's choice for one device, `DataParallel` for several."""
    return "auto" if trainer.strategy == "auto" and device_count(trainer) == 1 else DataParallel()


def outside_processes() -> int:
    """How many processes torchrun or srun started; 1 where neither did."""
    if torch.distributed.is_torchelastic_launched():
        return int(os.environ["WORLD_SIZE"])
    interactive = os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive")  # as Lightning tells srun from a shell
    return 1 if interactive else int(os.environ.get("SLURM_NTASKS", 1))


def check_devices(config: DictConfig) -> None:
    """Refuse devices that can't train together.

    Raises:
        InputError: In one sentence.
    """
    trainer, outside, count = config.trainer, outside_processes(), device_count(config.trainer)
    if outside > 1 and count not in (None, outside):
        raise InputError(
            f"{outside} processes were started for trainer.devices={trainer.devices} on each of "
            f"trainer.num_nodes={trainer.num_nodes}: expected one process for each device"
        )
    if outside > 1 and "TORCHELASTIC_RUN_ID" not in os.environ and "SLURM_NTASKS_PER_NODE" not in os.environ:
        raise InputError("srun --ntasks doesn't say how many tasks a node has: expected srun --ntasks-per-node")


def check_start(config: DictConfig, settings: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a start by which several processes wouldn't find each other, or would each do everything.

    Args:
        config: The composed configuration.
        settings: Hydra's own part of it.
        overrides: As given.

    Raises:
        InputError: In one sentence.
    """
    trainer, outside = config.trainer, outside_processes()
    tasks = settings.launcher.get("tasks_per_node", 1) * settings.launcher.get("nodes", 1)  # Slurm's, of each job
    if settings.mode == RunMode.MULTIRUN and device_count(trainer) != 1 and max(outside, tasks) == 1:
        raise InputError(
            f"trainer.devices={trainer.devices} in a sweep would start the whole sweep again for each device: "
            "expected torchrun --nproc-per-node, or hydra/launcher=submitit_slurm with hydra.launcher.tasks_per_node"
        )
    if outside > 1 and not any(item.startswith(("hydra.run.dir=", "hydra.sweep.dir=")) for item in overrides):
        raise InputError(f"{outside} processes have to share a folder: expected hydra.run.dir=runs/NAME beside them")
