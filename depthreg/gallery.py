"""`depthreg gallery`: what each stage of the curriculum measures, one scene a row, harder from column to column."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from torch import Tensor

from depthreg import train
from depthreg.config import build
from depthreg.curriculum import build_stage
from depthreg.data import io
from depthreg.data.sample import FrameBatch, Measurement
from depthreg.data.synthetic import collate_frames
from depthreg.errors import InputError
from depthreg.geometry import corner_errors_px, identity_affine
from depthreg.sensors import SensorSimulator
from depthreg.sensors.simulator import frame_generators, simulate_each
from depthreg.viz import depth_limits_m, depth_tile, edges_overlay, enlarge, grid, panel, to_picture
from depthreg.walk import walk

_CELL_WIDTH_PX = 480  # of each picture, larger ones are shrunk


def check(config: DictConfig) -> None:
    """Refuse what can't be meant, before any work.

    Raises:
        InputError: In one sentence.
    """
    if not config.difficulties:
        raise InputError("difficulties=[]: expected numbers from 0 to 1")
    train.check(config)


def run(config: DictConfig) -> None:
    """Draw one picture a stage and say where they are."""
    out = Path(HydraConfig.get().runtime.output_dir)
    network = build(config.model)
    for entry in walk(config):
        module, datamodule, _ = build_stage(config, entry, network)
        frames = datamodule.train_frames
        scenes = range(min(config.scenes, len(frames)))
        rows = [
            draw_scene(module.simulator, collate_frames([frames[i]]), config.difficulties, config.seed)
            for i in track(scenes, entry.label, console=Console(stderr=True), transient=True)
        ]
        path = out / f"{entry.label}.png"
        io.write_png(path, grid(rows))
        Console().print(f"{entry.label:<12}{path}", soft_wrap=True)


def draw_scene(
    simulator: SensorSimulator, batch: FrameBatch, difficulties: Sequence[float], seed: int
) -> list[np.ndarray]:
    """Pictures of one frame, (H, W, 3) uint8 each: first the truth, then a measurement at each difficulty.

    Args:
        simulator: What measures.
        batch: A batch of one frame.
        difficulties: In [0, 1].
        seed: First number of every draw, which is the same at all difficulties.
    """
    measured = [
        simulate_each(simulator, batch, difficulty, frame_generators(batch, seed)) for difficulty in difficulties
    ]
    truth_m = measured[0]["truth_depth_m"]
    limits_m = depth_limits_m(_plane(truth_m))
    truth = _cell("true colour", measured[0]["truth_rgb"], "true depth", truth_m, truth_m, limits_m)
    return [truth] + [
        _cell(
            f"difficulty {difficulty:g}: colour moved {_shift_px(measurement):.1f} px",
            measurement["rgb"],
            f"depth in {(measurement['depth_m'] > 0).float().mean().item():.1%} of the pixels",
            measurement["depth_m"],
            truth_m,
            limits_m,
        )
        for difficulty, measurement in zip(difficulties, measured, strict=True)
    ]


def _cell(
    rgb_caption: str, rgb: Tensor, depth_caption: str, depth_m: Tensor, truth_m: Tensor, limits_m: tuple[float, float]
) -> np.ndarray:
    """Colour under the outlines of the true depth, above the depth."""
    factor = max(1, round(_CELL_WIDTH_PX / rgb.shape[-1]))
    colour = enlarge(edges_overlay(to_picture(rgb[0]), _plane(truth_m)), factor)
    depth = depth_tile(_plane(depth_m), limits_m, factor)
    return panel([(rgb_caption, _shrunk(colour, colour.shape[1])), (depth_caption, _shrunk(depth, colour.shape[1]))])


def _shrunk(picture: np.ndarray, width: int) -> np.ndarray:
    """A picture scaled so that `width` pixels become a cell's width, where they are more."""
    scale = min(1.0, _CELL_WIDTH_PX / width)
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _plane(depth_m: Tensor) -> np.ndarray:
    return depth_m[0, 0].cpu().numpy()


def _shift_px(measurement: Measurement) -> float:
    """How far the true affine moves the image corner that it moves most."""
    affine = measurement["truth_affine_rgb_from_depth"]
    height, width = measurement["rgb"].shape[-2:]
    return corner_errors_px(affine, identity_affine(1), (height, width)).max().item()
