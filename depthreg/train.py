"""`depthreg train`: walk the curriculum, each stage starting from the last one's weights."""

import logging
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import lightning as L
import torch
import wandb
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from depthreg.callbacks import DifficultyRamp
from depthreg.checkpoint import load_weights, read_checkpoint
from depthreg.config import build, build_simulator, require_counts, require_positive, run_application
from depthreg.data.datamodule import FramesDataModule, RenderedDataModule, SyntheticDataModule
from depthreg.data.rendered import FolderStore, Store, folders_in, of_world
from depthreg.data.streaming import TarStore, urls_in
from depthreg.data.synthetic import SyntheticMeasurements
from depthreg.errors import InputError
from depthreg.evaluate import MISALIGNED, OURS, evaluate
from depthreg.networks import JointNetwork
from depthreg.report import Results, rich_table, write_report
from depthreg.sensors import SensorSimulator
from depthreg.stages import Stage


def main(argv: Sequence[str]) -> int:
    """Run `depthreg train OVERRIDES`."""
    return run_application("train", run, argv, check)


def check(config: DictConfig) -> None:
    """Refuse what can't be meant, before any work.

    Raises:
        InputError: In one sentence.
    """
    counts = [
        "data.train_count",
        "data.val_count",
        "data.batch_size",
        *(f"stages.{name}.epochs" for name in config.stages),
    ]
    require_counts(config, counts)
    require_counts(config, ["seed", "data.workers"], at_least=0)
    require_counts(config, ["data.width", "data.height"], at_least=64)
    if config.data.name not in _DATA_MODULES:
        choices = ", ".join(f"data={name}" for name in _DATA_MODULES)
        raise InputError(f"data={config.data.name}: depthreg learns from synthetic scenes alone, expected {choices}")
    if config.resume and config.init_from:
        raise InputError("resume and init_from exclude each other: resume takes everything, init_from the weights only")
    if missing := OmegaConf.missing_keys(config):
        raise InputError(f"{min(missing)} is missing: expected {min(missing)}=... on the command line")
    require_positive(config, ["learning_rate"])
    network = build(config.model)
    for name in config.stages:
        build_stage(config, name, network)
    if weights := config.resume or config.init_from:
        load_weights(network, Path(weights))
    if config.resume:
        _resumed_stage(config)


def _resumed_stage(config: DictConfig) -> str:
    checkpoint = read_checkpoint(Path(config.resume))
    if "optimizer_states" not in checkpoint:
        raise InputError(
            f"resume={config.resume} holds weights alone: expected a last.ckpt, or init_from={config.resume}"
        )
    stage = checkpoint["depthreg"]["stage"]
    if stage not in config.stages:
        raise InputError(f"resume={config.resume} is of stage {stage}: expected one of {', '.join(config.stages)}")
    return stage


def _quieten() -> None:
    """Silence what Lightning and wandb say about a run that is as it should be."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings(
        "ignore",
        module="lightning",
        message=".*(exists and is not empty|logging interval|num_workers|LeafSpec|eval mode).*",
    )
    warnings.filterwarnings(
        "ignore", message=".*overridden `on_after_batch_transfer`.*"
    )  # on purpose: the simulator is there
    os.environ.setdefault("WANDB_SILENT", "true")


def run(config: DictConfig) -> float:
    """Train the stages, evaluate, draw; returns the last stage's validation RMSE in metres, for sweeps."""
    out = Path(HydraConfig.get().runtime.output_dir).resolve()
    _quieten()
    L.seed_everything(config.seed, workers=True, verbose=False)
    network: JointNetwork = build(config.model)
    names = list(config.stages)
    if config.resume:
        load_weights(network, Path(config.resume))
        names = names[names.index(_resumed_stage(config)) :]
    elif config.init_from:
        load_weights(network, Path(config.init_from))
    for i, name in enumerate(names):
        train_stage(config, name, network, out / name, resume=config.resume if i == 0 else None)
    frames, results = evaluate_stage(config, names[-1], network, out)
    console = Console()
    console.print(rich_table(results, f"{frames} synthetic frames never trained on"))
    console.print(f"run      {out}\npicture  {out / 'panels' / '000000.png'}", soft_wrap=True)
    return results[MISALIGNED][OURS]["rmse_m"]


def build_stage(config: DictConfig, name: str, network: JointNetwork) -> tuple[Stage, FramesDataModule, DifficultyRamp]:
    """The module, the data and the difficulty of one stage, from the composed configuration.

    Raises:
        InputError: A value of the configuration can't be meant.
    """
    stage = config.stages[name]
    try:
        simulator = build_simulator(stage)
        ramp = DifficultyRamp(**stage.difficulty)
    except ValueError as error:
        raise InputError(f"stages.{name}: {error}") from error
    module = build(stage.module, network=network, loss=build(config.loss), simulator=simulator, seed=config.seed)
    return module, _DATA_MODULES[config.data.name](config, stage, simulator), ramp


def _synthetic_data(config: DictConfig, stage: DictConfig, simulator: SensorSimulator) -> FramesDataModule:
    data = config.data
    return SyntheticDataModule(
        world=build(stage.world),
        camera=build(data.camera),
        rig=simulator.rig,
        train_count=data.train_count,
        val_count=data.val_count,
        batch_size=data.batch_size,
        workers=data.workers,
        seed=config.seed,
        max_depth_m=data.max_depth_m,
        cache_dir=data.cache_dir,
        renderer=build(config.rendering),
    )


def _stored_data(config: DictConfig, stage: DictConfig, simulator: SensorSimulator) -> FramesDataModule:
    data = config.data
    world = cast(dict[str, Any], OmegaConf.to_container(stage.world, resolve=True))
    store: Store
    if data.name == "streaming":
        store = TarStore(of_world(urls_in(data.url), data.url, world))
    else:
        store = FolderStore(of_world(folders_in(Path(data.root)), data.root, world))
    return RenderedDataModule(
        store=store,
        rig=simulator.rig,
        max_corner_shift_px=simulator.max_corner_shift_px,
        val_share=data.val_share,
        batch_size=data.batch_size,
        workers=data.workers,
        seed=config.seed,
        max_depth_m=data.max_depth_m,
    )


_DATA_MODULES = {"synthetic": _synthetic_data, "rendered": _stored_data, "streaming": _stored_data}


def train_stage(config: DictConfig, name: str, network: JointNetwork, folder: Path, resume: str | None) -> None:
    """Fit one stage; its checkpoints, logs and pictures go to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    module, datamodule, ramp = build_stage(config, name, network)
    callbacks = [build(callback) for callback in config.callbacks.values() if callback]
    trainer = L.Trainer(
        **config.trainer,
        max_epochs=config.stages[name].epochs,
        default_root_dir=folder,
        callbacks=[
            *callbacks,
            ramp,
            *_checkpoints(folder),
            RichProgressBar(),
        ],
        logger=_loggers(config, name, folder),
    )
    try:
        trainer.fit(module, datamodule, ckpt_path=resume, weights_only=True)
    finally:
        wandb.finish()  # else the next stage would write into this stage's run


def _checkpoints(folder: Path) -> list[ModelCheckpoint]:
    """The newest and the best weights; `=` in a name would break Hydra overrides."""
    last = ModelCheckpoint(folder, filename="last", enable_version_counter=False)
    best = ModelCheckpoint(
        folder, filename="best", monitor="val/loss", enable_version_counter=False, save_weights_only=True
    )
    return [last, best]


def _loggers(config: DictConfig, name: str, folder: Path) -> list[Logger]:
    places: dict[str, dict[str, Any]] = {
        "csv": {"save_dir": folder},
        "wandb": {
            "save_dir": folder,
            "name": name,
            "group": folder.parent.name,
            "config": OmegaConf.to_container(config, resolve=True),
        },
    }
    chosen = {key: logger for key, logger in (config.logger or {}).items() if logger}
    return [instantiate(logger, _partial_=True)(**places[key]) for key, logger in chosen.items()]


def evaluate_stage(config: DictConfig, name: str, network: JointNetwork, out: Path) -> tuple[int, Results]:
    """Score the network on a stage's validation frames beside the baselines; table and pictures go to `out`.

    Returns:
        How many frames, and their scores.
    """
    module, datamodule, _ = build_stage(config, name, network)
    frames = SyntheticMeasurements(datamodule.val_frames, module.simulator, module.val_difficulty, config.seed)
    panels = out / "panels"
    panels.mkdir(exist_ok=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    results = evaluate(network.to(device), frames, panel_dir=panels)
    write_report(results, out)
    return len(frames), results
