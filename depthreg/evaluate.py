"""`depthreg evaluate`: how good a network is, beside what a user would do without it."""

from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from torch import nn
from torch.utils.data import Dataset, Subset, default_collate

from depthreg.baselines import COMPLETION_BASELINES
from depthreg.checkpoint import RELEASED, load_network
from depthreg.config import build, build_simulator
from depthreg.data import io
from depthreg.data.datamodule import VALIDATION_SEED_OFFSET
from depthreg.data.sample import Measurement
from depthreg.data.synthetic import SyntheticFrames, SyntheticMeasurements
from depthreg.errors import InputError
from depthreg.evaluation.curve_page import write_page
from depthreg.evaluation.curves import CurveError, frame_errors, pool, write_csv
from depthreg.evaluation.scores import Scores, run_network, timed
from depthreg.evaluation.settings import both_settings
from depthreg.evaluation.worst import error_panel
from depthreg.report import ALIGNED, MISALIGNED, OURS, Results, rich_table, write_report
from depthreg.sensors.simulator import seeded_generator
from depthreg.viz import sample_panel, to_picture

RIVAL = "IP-Basic"  # by whose error a frame is called bad


def check(config: DictConfig) -> None:
    """Refuse what can't be meant, before any work.

    Raises:
        InputError: A value can't be meant, or the checkpoint or the data set can't be read.
    """
    if config.data.name in ("rendered", "streaming"):
        raise InputError(f"data={config.data.name} is to train on: expected one of synthetic, kitti, folder, ...")
    load_network(_checkpoint(config))
    dataset = build_dataset(config)
    if config.data.name != "synthetic":  # every file is tried before anything is written
        for index in _progress(len(dataset), "Checking"):
            both_settings(_batch_of_one(dataset[index]), config.max_corner_shift_px, seeded_generator(0))


def run(config: DictConfig) -> float:
    """Evaluate, print the table, write it; returns the RMSE in metres with misaligned colour."""
    out = Path(HydraConfig.get().runtime.output_dir).resolve()
    for folder in ("panels", "worst"):
        (out / folder).mkdir()
    dataset = build_dataset(config)
    network = load_network(_checkpoint(config)).to("cuda" if torch.cuda.is_available() else "cpu")
    results = evaluate(
        network,
        dataset,
        max_corner_shift_px=config.max_corner_shift_px,
        seed=config.seed,
        panel_dir=out / "panels",
        panels=config.panels,
        worst_dir=out / "worst",
        worst=config.worst,
    )
    if config.curves:
        shift_px, seed = config.max_corner_shift_px, config.seed
        draw_curves(network, dataset, out, max_corner_shift_px=shift_px, seed=seed, count=config.curves)
    write_report(results, out)
    source = config.data.get("root", "unseen synthetic scenes")
    total = len(cast(Any, dataset.dataset))
    console = Console()
    console.print(rich_table(results, f"{len(dataset)} of {total} frames of {source}"))
    console.print(f"weights  {_checkpoint(config)}", soft_wrap=True)
    console.print(f"table    {out / 'metrics.md'}\npictures {out / 'panels'}", soft_wrap=True)
    if config.worst:
        console.print(f"worst    {out / 'worst'}", soft_wrap=True)
    if config.curves:
        console.print(f"curves   {out / 'curves.html'}", soft_wrap=True)
    return results[MISALIGNED][OURS]["rmse_m"]


def _checkpoint(config: DictConfig) -> Path:
    return Path(config.checkpoint) if config.checkpoint else RELEASED


def build_dataset(config: DictConfig) -> Subset[Any]:
    """The frames that the composed configuration asks for; synthetic ones were never trained on."""
    data = config.data
    dataset: Any
    if data.name == "synthetic":
        simulator = build_simulator(config)
        frames = SyntheticFrames(
            build(config.world),
            build(data.camera, max_corner_shift_px=config.max_corner_shift_px),
            simulator.rig,
            seed=config.seed + VALIDATION_SEED_OFFSET,
            count=data.val_count,
            max_depth_m=data.max_depth_m,
            cache_dir=Path(data.cache_dir) if data.cache_dir else None,
            renderer=build(config.rendering),
        )
        dataset = SyntheticMeasurements(frames, simulator, config.difficulty, config.seed)
    else:
        options = {key: value for key, value in data.items() if key != "name"}
        # Partial, because Hydra would hide an InputError that is raised while it instantiates.
        dataset = instantiate(options, _partial_=True)()
    return Subset(dataset, _spread(len(dataset), config.limit or len(dataset)))


def evaluate(
    network: nn.Module,
    dataset: Dataset[Mapping[str, Any]],
    *,
    max_corner_shift_px: float = 24.0,
    seed: int = 0,
    panel_dir: Path | None = None,
    panels: int = 8,
    worst_dir: Path | None = None,
    worst: int = 4,
) -> Results:
    """Score a network and the baselines on a data set, frame by frame, so that sizes may differ.

    Depth is scored with aligned and with misaligned colour; registration against the known misalignment.

    Args:
        network: Any of `depthreg.networks`, on whatever device.
        dataset: Gives `Measurement` items without the batch axis; see `both_settings`.
        max_corner_shift_px: Largest misalignment put on real frames, for an image 1242 pixels wide.
        seed: First number of every misalignment, the second one being the frame's index.
        panel_dir: Existing folder for pictures of the first frames, `<index>.png`; None for none.
        panels: How many pictures at most.
        worst_dir: Existing folder for pictures of the frames with the largest RMSE beside IP-Basic's, with aligned
            colour, `<rank>_frame_<index>.png`; None for none.
        worst: How many of these at most.

    Returns:
        Task -> method -> metric -> value; NaN where no frame had truth.
    """
    network.eval()
    scores = Scores()
    settings = partial(_settings, dataset, max_corner_shift_px, seed)
    for index in _progress(len(cast(Any, dataset)), "Evaluating"):
        aligned, misaligned = settings(index)
        scores.score_depth(ALIGNED, aligned, *timed(run_network, network, aligned))
        output, seconds = timed(run_network, network, misaligned)
        scores.score_depth(MISALIGNED, misaligned, output, seconds)
        scores.score_registration(misaligned, output, seconds)
        if panel_dir and index < panels:
            truth_m = misaligned.get("truth_depth_m")
            picture = sample_panel(misaligned["rgb"], misaligned["depth_m"], output, truth_m)
            io.write_png(panel_dir / f"{index:06d}.png", picture)
    if worst_dir:
        for rank, index in enumerate(worst_frames(scores, worst), start=1):
            io.write_png(worst_dir / f"{rank}_frame_{index:06d}.png", _error_picture(network, settings(index)[0]))
    return scores.results()


def worst_frames(scores: Scores, count: int) -> list[int]:
    """Indices of the frames whose RMSE is the largest multiple of IP-Basic's, the worst first; those with truth."""
    ours, theirs = (np.array(scores.rmse_m[ALIGNED, method]) for method in (OURS, RIVAL))
    ratio = ours / np.maximum(theirs, 1e-6)
    return [int(index) for index in np.argsort(-ratio, kind="stable")[:count] if np.isfinite(ratio[index])]


def _error_picture(network: nn.Module, aligned: Measurement) -> np.ndarray:
    sparse_m, truth_m = (aligned[key][0, 0].numpy() for key in ("depth_m", "truth_depth_m"))
    ours_m = run_network(network, aligned).depth_m[0, 0].numpy()
    rival_m = COMPLETION_BASELINES[RIVAL](sparse_m)
    return error_panel(to_picture(aligned["rgb"][0]), sparse_m, {OURS: ours_m, RIVAL: rival_m}, truth_m)


def draw_curves(
    network: nn.Module,
    dataset: Dataset[Mapping[str, Any]],
    out: Path,
    *,
    max_corner_shift_px: float = 24.0,
    seed: int = 0,
    count: int = 20,
) -> None:
    """Write `curves.csv` and `curves.html` of `count` frames, spread evenly over the data set."""
    errors: list[CurveError] = []
    indices = _spread(len(cast(Any, dataset)), count)
    for number in _progress(len(indices), "Drawing curves"):
        aligned, _ = _settings(dataset, max_corner_shift_px, seed, indices[number])
        errors += frame_errors(network, aligned, max_corner_shift_px, (seed, indices[number]))
    pooled = pool(errors)
    write_page(pooled, out / "curves.html", f"{len(indices)} frames")
    write_csv(pooled, out / "curves.csv")


def _settings(
    dataset: Dataset[Mapping[str, Any]], max_corner_shift_px: float, seed: int, index: int
) -> tuple[Measurement, Measurement]:
    """A frame as a batch of one, aligned and misaligned."""
    return both_settings(_batch_of_one(dataset[index]), max_corner_shift_px, seeded_generator(seed, index))


def _spread(length: int, count: int) -> list[int]:
    """Indices of at most `count` items, spread evenly over all of them."""
    return np.linspace(0, length - 1, min(count, length)).round().astype(int).tolist()


def _batch_of_one(item: Mapping[str, Any]) -> Measurement:
    return cast(Measurement, default_collate([item]))


def _progress(count: int, doing: str) -> Iterable[int]:
    return track(range(count), doing, console=Console(stderr=True), transient=True)
