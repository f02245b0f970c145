"""The curriculum: which stages follow each other, and what each one is made of."""

from pathlib import Path
from typing import Any, NamedTuple, cast

import lightning as L
from omegaconf import DictConfig, OmegaConf

from depthreg.callbacks import DifficultyRamp, FreezeSchedule, Patience
from depthreg.config import build, build_simulator
from depthreg.data.datamodule import FramesDataModule, RenderedDataModule, SyntheticDataModule
from depthreg.data.rendered import FolderStore, Store, folders_in, of_world
from depthreg.data.streaming import TarStore, urls_in
from depthreg.errors import InputError
from depthreg.networks import Network
from depthreg.sensors import SensorSimulator
from depthreg.stage import Stage
from depthreg.walk import Entry


class StageParts(NamedTuple):
    """What a stage is made of."""

    module: Stage
    data: FramesDataModule
    callbacks: list[L.Callback]  # that say what happens in an epoch


def build_stage(config: DictConfig, entry: Entry, network: Network) -> StageParts:
    """The module, the data and the schedules of one step of the curriculum, from the composed configuration.

    Raises:
        InputError: A value of the configuration can't be meant.
    """
    stage = config.stages[entry.stage]
    try:
        simulator = build_simulator(stage)
        freeze, ramp = FreezeSchedule(**stage.freeze), DifficultyRamp(**stage.difficulty)
        freeze.check(network)
        patience = [Patience(stage.patience)] if stage.patience is not None else []
    except (ValueError, TypeError) as error:
        raise InputError(f"stages.{entry.stage}: {error}") from error
    module = build(
        stage.module, name=entry.label, network=network, loss=build(config.loss), simulator=simulator, seed=config.seed
    )
    return StageParts(module, DATA_MODULES[config.data.name](config, stage, simulator), [freeze, ramp, *patience])


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


DATA_MODULES = {"synthetic": _synthetic_data, "rendered": _stored_data, "streaming": _stored_data}
