"""`depthreg train`: walk the curriculum, each stage starting from the last one's weights."""

import logging
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import lightning as L
import torch
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import ModelCheckpoint, WeightAveraging
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from depthreg.callbacks import Interruption, KeptRow, StageProgress, Throughput
from depthreg.checkpoint import AtomicCheckpointIO, load_weights, steps_done
from depthreg.config import build, one_line
from depthreg.curriculum import DATA_MODULES, build_stage
from depthreg.data.synthetic import SyntheticMeasurements
from depthreg.devices import check_devices, device_count, is_first_process, strategy
from depthreg.errors import InputError, RunError
from depthreg.evaluate import evaluate
from depthreg.networks import Network
from depthreg.report import MISALIGNED, OURS, SCORES, Results, read_report, rich_table, write_report
from depthreg.resume import was_requeued
from depthreg.run_folder import RECORD, finish_stage, is_finished, read_record, start_record, write_record
from depthreg.trackers import Trackers, check_trackers, open_trackers
from depthreg.walk import Entry, walk


def check(config: DictConfig) -> None:
    """Refuse what can't be meant, before any work.

    Raises:
        InputError: In one sentence.
    """
    if config.data.name not in DATA_MODULES:
        choices = ", ".join(f"data={name}" for name in DATA_MODULES)
        raise InputError(f"data={config.data.name}: depthreg learns from synthetic scenes alone, expected {choices}")
    check_devices(config)
    check_trackers(config)
    _check_trainer(config)
    network = build(config.model)
    for entry in walk(config):
        build_stage(config, entry, network).data.require_frames(device_count(config.trainer) or 1)
    if config.init_from:
        load_weights(network, Path(config.init_from))


def _check_trainer(config: DictConfig) -> None:
    _quieten()
    try:
        L.Trainer(**_trainer_options(config), logger=False, enable_checkpointing=False)
    except (MisconfigurationException, ValueError, TypeError, RuntimeError) as error:  # in Lightning's own words
        raise InputError(f"trainer: {one_line(error)}") from error
    _build_callbacks(config)


def _quieten() -> None:
    """Silence what Lightning and wandb say about a run that is as it should be."""
    for package in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(package).setLevel(logging.WARNING)
    expected = (
        "`srun` command is available",
        *("exists and is not empty", "logging interval", "num_workers", "LeafSpec", "eval mode"),
        *("sync_dist", "dataloader is not resumable", "`broadcast_buffers` is deprecated"),
        "overridden `on_(before|after)_batch_transfer`",  # on purpose: the simulator is there
    )
    for message in expected:
        warnings.filterwarnings("ignore", f".*{message}.*")


def run(config: DictConfig) -> float:
    """Train the stages, evaluate, draw; returns the last stage's validation RMSE in metres, for sweeps."""
    out = Path(HydraConfig.get().runtime.output_dir).resolve()
    with _alone_in(out) if is_first_process() else nullcontext():
        return _run(config, out)


@contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    """Keep other processes from training the same run; the system drops the lock of a process that was killed.

    Raises:
        InputError: Another one does.
    """
    try:
        with FileLock(out / ".lock", blocking=False):
            yield
    except Timeout as error:
        raise InputError(f"{out} is being trained by another process: expected that one to end first") from error


def _run(config: DictConfig, out: Path) -> float:
    _quieten()
    L.seed_everything(config.seed, workers=True, verbose=False)
    network: Network = build(config.model)
    if config.compile:
        network.compile()  # in place: `torch.compile(network)` would rename every weight
    console = Console(quiet=not is_first_process())
    if config.init_from:
        console.print(f"init_from {load_weights(network, Path(config.init_from))}", soft_wrap=True)
    if is_first_process():
        _note_start(config, out)
    if HydraConfig.get().mode == RunMode.MULTIRUN and (out / SCORES).exists():  # of a sweep that is started again
        console.print(f"run      {out} has ended already", soft_wrap=True)
        return read_report(out)[MISALIGNED][OURS]["rmse_m"]
    entries = walk(config)
    with open_trackers(config, out, [entry.label for entry in entries], HydraConfig.get().runtime.choices) as trackers:
        for entry in entries:
            train_stage(config, entry, network, out / entry.label, trackers)
        if not is_first_process():
            return math.nan
        frames, results = evaluate_stage(config, entries[-1], network, out)
        trackers.log_results(results)
    console.print(rich_table(results, f"{frames} synthetic frames never trained on"))
    lines = [f"run      {out}", f"picture  {out / 'panels' / '000000.png'}"]
    console.print("\n".join([*lines, *(f"curves   {hint}" for hint in trackers.hints)]), soft_wrap=True)
    return results[MISALIGNED][OURS]["rmse_m"]


def _note_start(config: DictConfig, out: Path) -> None:
    """Write `run.yaml`, unless this run goes on.

    Raises:
        InputError: The folder holds a run that nobody asked to resume.
    """
    overrides = list(HydraConfig.get().overrides.task)
    if not (out / RECORD).exists():
        write_record(out, start_record(config, overrides))
        return
    same_job = HydraConfig.get().mode == RunMode.MULTIRUN and read_record(out)["overrides"] == overrides
    if not (config.resume or was_requeued() or same_job):
        raise InputError(f"{out} holds a run: expected resume={out}, or another folder")


def train_stage(config: DictConfig, entry: Entry, network: Network, folder: Path, trackers: Trackers) -> None:
    """Fit one stage, or the rest of it; its checkpoints, logs and pictures go to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    last = folder / "last.ckpt"
    if is_finished(folder):
        load_weights(network, last)
        return
    for partial in folder.glob(".*.ckpt"):  # a process was killed while it wrote them
        partial.unlink(missing_ok=True)
    module, datamodule, schedules = build_stage(config, entry, network)
    schedules = [*schedules, *_pruning(config, entry)]
    trainer = make_trainer(config, entry, folder, schedules, trackers)
    try:
        trainer.fit(module, datamodule, ckpt_path=last if last.exists() else None, weights_only=True)
    except Exception as error:
        if sentence := _in_a_sentence(error):
            raise sentence from error
        raise
    if is_first_process():
        trackers.log_checkpoints(entry.label, folder)
        finish_stage(folder, trainer.current_epoch, trainer.global_step)


def make_trainer(
    config: DictConfig, entry: Entry, folder: Path, schedules: Sequence[L.Callback], trackers: Trackers
) -> L.Trainer:
    """What fits a stage, and writes to `folder` and the trackers while it does."""
    last, throughput = folder / "last.ckpt", Throughput()
    callbacks = _build_callbacks(config)
    progress, interruption = StageProgress(throughput), Interruption(last, config.checkpoint_every_steps)
    return L.Trainer(
        **_trainer_options(config),
        max_epochs=config.stages[entry.stage].epochs,
        default_root_dir=folder,
        callbacks=[*callbacks, *schedules, throughput, KeptRow(), progress, _best(folder, callbacks), interruption],
        logger=trackers.stage_loggers(entry.label, folder, steps_done(last)),
        plugins=[AtomicCheckpointIO()],
    )


def _build_callbacks(config: DictConfig) -> list[L.Callback]:
    return [build(callback) for callback in (config.callbacks or {}).values() if callback]


def _trainer_options(config: DictConfig) -> dict[str, Any]:
    options: Any = OmegaConf.to_container(config.trainer, resolve=True)
    return options | {"strategy": strategy(config.trainer)}


def _pruning(config: DictConfig, entry: Entry) -> list[L.Callback]:
    """What lets Optuna's sweeper stop a job in its last stage, the one by which jobs are compared."""
    hydra = HydraConfig.get()
    if hydra.mode != RunMode.MULTIRUN or "pruner" not in hydra.sweeper or entry != walk(config)[-1]:
        return []
    from depthreg.study import Pruning, current_trial  # Optuna is an extra

    return [Pruning(current_trial())]


def _best(folder: Path, callbacks: Sequence[L.Callback]) -> ModelCheckpoint:
    """Keeps the weights of the lowest validation loss; `=` in a name would break Hydra overrides.

    Where weights are averaged, only a whole checkpoint holds the average, which is what was validated.
    """
    averaged = any(isinstance(callback, WeightAveraging) for callback in callbacks)
    return ModelCheckpoint(
        folder, filename="best", monitor="val/loss", enable_version_counter=False, save_weights_only=not averaged
    )


def _in_a_sentence(error: Exception) -> InputError | RunError | None:
    """What happened in a process that loads frames, without that process's traceback; None for all other errors."""
    text = str(error).strip()
    if "in DataLoader worker process" in text:  # an error of its own, whose last line names it
        said = text.splitlines()[-1].partition(": ")[2]
        return InputError(said) if isinstance(error, InputError) else RunError(f"while loading frames: {said}")
    if text.startswith("DataLoader worker"):
        return RunError(f"{text.splitlines()[0]} Out of memory? Expected fewer data.workers or smaller frames")
    return None


def evaluate_stage(config: DictConfig, entry: Entry, network: Network, out: Path) -> tuple[int, Results]:
    """Score the network on a stage's validation frames beside the baselines; table and pictures go to `out`.

    Returns:
        How many frames, and their scores.
    """
    module, datamodule, _ = build_stage(config, entry, network)
    frames = SyntheticMeasurements(datamodule.val_frames, module.simulator, module.val_difficulty, config.seed)
    panels = out / "panels"
    panels.mkdir(exist_ok=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    results = evaluate(network.to(device), frames, panel_dir=panels)
    write_report(results, out)
    return len(frames), results
