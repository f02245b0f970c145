"""`depthreg train`: walk the curriculum, each stage starting from the last one's weights."""

import logging
import math
import warnings
from pathlib import Path

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from omegaconf import DictConfig
from rich.console import Console

from depthreg.checkpoint import load_weights, steps_done
from depthreg.config import build
from depthreg.curriculum import DATA_MODULES, Entry, build_stage, walk
from depthreg.data.synthetic import SyntheticMeasurements
from depthreg.devices import check_devices, device_count, is_first_process, strategy
from depthreg.errors import InputError
from depthreg.evaluate import MISALIGNED, OURS, evaluate
from depthreg.networks import JointNetwork
from depthreg.report import Results, rich_table, write_report
from depthreg.run_folder import finish_stage, is_finished, start_record, write_record
from depthreg.trackers import Trackers, check_trackers, open_trackers


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
    network = build(config.model)
    for entry in walk(config):
        build_stage(config, entry, network).data.require_frames(device_count(config.trainer) or 1)
    if config.init_from:
        load_weights(network, Path(config.init_from))


def _quieten() -> None:
    """Silence what Lightning and wandb say about a run that is as it should be."""
    for package in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(package).setLevel(logging.WARNING)
    expected = (
        *("exists and is not empty", "logging interval", "num_workers", "LeafSpec", "eval mode"),
        *("sync_dist", "dataloader is not resumable", "`broadcast_buffers` is deprecated"),
        "overridden `on_after_batch_transfer`",  # on purpose: the simulator is there
    )
    for message in expected:
        warnings.filterwarnings("ignore", f".*{message}.*")


def run(config: DictConfig) -> float:
    """Train the stages, evaluate, draw; returns the last stage's validation RMSE in metres, for sweeps."""
    out = Path(HydraConfig.get().runtime.output_dir).resolve()
    _quieten()
    L.seed_everything(config.seed, workers=True, verbose=False)
    network: JointNetwork = build(config.model)
    if config.init_from:
        load_weights(network, Path(config.init_from))
    if not config.resume and is_first_process():
        write_record(out, start_record(config, HydraConfig.get().overrides.task))
    entries = walk(config)
    with open_trackers(config, out, [entry.label for entry in entries]) as trackers:
        for entry in entries:
            train_stage(config, entry, network, out / entry.label, trackers)
        if not is_first_process():
            return math.nan
        frames, results = evaluate_stage(config, entries[-1], network, out)
        trackers.log_results(results)
    console = Console()
    console.print(rich_table(results, f"{frames} synthetic frames never trained on"))
    lines = [f"run      {out}", f"picture  {out / 'panels' / '000000.png'}"]
    console.print("\n".join([*lines, *(f"curves   {hint}" for hint in trackers.hints)]), soft_wrap=True)
    return results[MISALIGNED][OURS]["rmse_m"]


def train_stage(config: DictConfig, entry: Entry, network: JointNetwork, folder: Path, trackers: Trackers) -> None:
    """Fit one stage, or the rest of it; its checkpoints, logs and pictures go to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    last = folder / "last.ckpt"
    if is_finished(folder):
        load_weights(network, last)
        return
    module, datamodule, schedules = build_stage(config, entry, network)
    callbacks = [build(callback) for callback in config.callbacks.values() if callback]
    trainer = L.Trainer(
        **{**config.trainer, "strategy": strategy(config.trainer)},
        max_epochs=config.stages[entry.stage].epochs,
        default_root_dir=folder,
        callbacks=[*callbacks, *schedules, *_checkpoints(folder), RichProgressBar()],
        logger=trackers.stage_loggers(entry.label, folder, steps_done(last)),
    )
    trainer.fit(module, datamodule, ckpt_path=last if last.exists() else None, weights_only=True)
    if is_first_process():
        trackers.log_checkpoints(entry.label, folder)
        finish_stage(folder, trainer.current_epoch, trainer.global_step)


def _checkpoints(folder: Path) -> list[ModelCheckpoint]:
    """The newest and the best weights; `=` in a name would break Hydra overrides."""
    last = ModelCheckpoint(folder, filename="last", enable_version_counter=False)
    best = ModelCheckpoint(
        folder, filename="best", monitor="val/loss", enable_version_counter=False, save_weights_only=True
    )
    return [last, best]


def evaluate_stage(config: DictConfig, entry: Entry, network: JointNetwork, out: Path) -> tuple[int, Results]:
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
