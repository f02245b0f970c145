"""Saves within an epoch: every few steps, and when the run is asked to end."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Checkpoint

# SIGTERM is what a scheduler sends before it kills; Slurm's --signal and submitit send the other two ahead of that.
SIGNALS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


class Interruption(Checkpoint):  # callbacks of this kind come last, when all others have their state
    """Saves the run, and ends it, soon after a signal: at the end of a step, or of the epoch's validation.

    A checkpoint within an epoch holds how many batches of it are done. None is written after an epoch's last step: a
    run that was resumed from there would leave out the validation.

    After SIGUSR1, which Slurm sends some time before its limit where `sbatch --signal=USR1@120` asks it to, the job is
    queued again. A preempted job is queued again by Slurm itself, one that submitit started by submitit.

    Args:
        path: The checkpoint.
        every_steps: Save every so many optimizer steps too; None for only once an epoch.

    Raises:
        ValueError: `every_steps` isn't positive.
    """

    def __init__(self, path: Path, every_steps: int | None = None) -> None:
        if every_steps is not None and every_steps < 1:
            raise ValueError(f"checkpoint_every_steps must be at least 1, got {every_steps}")
        self.path, self.every_steps = path, every_steps
        self.received: signal.Signals | None = None
        self.earlier: dict[signal.Signals, Any] = {signum: signal.getsignal(signum) for signum in SIGNALS}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Listen in place of Lightning, which would end within an epoch without saving; it restores the handlers."""
        if threading.current_thread() is threading.main_thread():
            for signum in SIGNALS:
                signal.signal(signum, self._note)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self.received = signal.Signals(signum)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Save where it is time, between two steps of the optimizer."""
        if trainer.is_last_batch or (batch_idx + 1) % trainer.accumulate_grad_batches:
            return
        ending = self._is_ending(trainer)
        if ending or (self.every_steps and trainer.global_step % self.every_steps == 0):
            trainer.save_checkpoint(self.path)
        if ending:
            self._end(trainer)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save at the end of every epoch."""
        trainer.save_checkpoint(self.path)
        if self._is_ending(trainer):
            self._end(trainer)

    def _is_ending(self, trainer: L.Trainer) -> bool:
        """Whether any process of the run got a signal: all of them save together."""
        return trainer.strategy.reduce_boolean_decision(self.received is not None, all=False)

    def _end(self, trainer: L.Trainer) -> None:
        received, self.received = self.received or signal.SIGTERM, None
        if trainer.is_global_zero:
            print(f"{received.name}: saved {self.path}", file=sys.stderr)
        job = os.environ.get("SLURM_JOB_ID")
        if trainer.is_global_zero and received == signal.SIGUSR1 and job:
            subprocess.run(["scontrol", "requeue", job], check=False)
        handler: Callable[[int, FrameType | None], Any] | Any = self.earlier[received]
        if callable(handler):
            handler(received, None)  # submitit's: queues the job again, or goes on after a signal that it ignores
        else:
            raise SystemExit(128 + received)
