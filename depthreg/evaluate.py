"""`depthreg evaluate`: how good a network is, beside what a user would do without it."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from torch import Tensor, nn
from torch.utils.data import Dataset, Subset, default_collate
from torchmetrics import MeanMetric

from depthreg.baselines import COMPLETION_BASELINES, registration_baselines
from depthreg.checkpoint import find_checkpoint, load_network
from depthreg.config import build_simulator
from depthreg.data import io
from depthreg.data.datamodule import VALIDATION_SEED_OFFSET
from depthreg.data.sample import Measurement
from depthreg.data.synthetic import SyntheticFrames, SyntheticMeasurements
from depthreg.errors import InputError
from depthreg.geometry import identity_affine, warp_affine
from depthreg.metrics import DepthMetrics, RegistrationMetrics, masked_ssim
from depthreg.networks import JointOutput
from depthreg.report import ALIGNED, MISALIGNED, OURS, REGISTRATION, Results, rich_table, write_report
from depthreg.sensors.misalignment import REFERENCE_WIDTH_PX, margin_for, misalign_rgb, random_affines
from depthreg.sensors.simulator import seeded_generator
from depthreg.viz import sample_panel, to_picture

MIN_SIDE_PX = 64  # of the smallest image that a network takes

T = TypeVar("T")


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
    (out / "panels").mkdir()
    dataset = build_dataset(config)
    results = evaluate(
        load_network(_checkpoint(config)).to("cuda" if torch.cuda.is_available() else "cpu"),
        dataset,
        max_corner_shift_px=config.max_corner_shift_px,
        seed=config.seed,
        panel_dir=out / "panels",
        panels=config.panels,
    )
    write_report(results, out)
    source = config.data.get("root", "unseen synthetic scenes")
    total = len(cast(Any, dataset.dataset))
    console = Console()
    console.print(rich_table(results, f"{len(dataset)} of {total} frames of {source}"))
    console.print(
        f"weights  {_checkpoint(config)}\ntable    {out / 'metrics.md'}\npictures {out / 'panels'}", soft_wrap=True
    )
    return results[MISALIGNED][OURS]["rmse_m"]


def _checkpoint(config: DictConfig) -> Path:
    return find_checkpoint(Path(config.checkpoint) if config.checkpoint else None)


def build_dataset(config: DictConfig) -> Subset[Any]:
    """The frames that the composed configuration asks for; synthetic ones were never trained on."""
    data = config.data
    dataset: Any
    if data.name == "synthetic":
        simulator = build_simulator(config)
        frames = SyntheticFrames(
            instantiate(config.world),
            instantiate(data.camera, max_corner_shift_px=config.max_corner_shift_px, _convert_="all"),
            simulator.rig,
            seed=config.seed + VALIDATION_SEED_OFFSET,
            count=data.val_count,
            max_depth_m=data.max_depth_m,
            cache_dir=Path(data.cache_dir) if data.cache_dir else None,
            renderer=instantiate(config.rendering),
        )
        dataset = SyntheticMeasurements(frames, simulator, config.difficulty, config.seed)
    else:
        options = {key: value for key, value in data.items() if key != "name"}
        # Partial, because Hydra would hide an InputError that is raised while it instantiates.
        dataset = instantiate(options, _partial_=True)()
    count = min(config.limit or len(dataset), len(dataset))
    return Subset(dataset, np.linspace(0, len(dataset) - 1, count).round().astype(int).tolist())


def misalign(frame: Measurement, max_corner_shift_px: float, generator: torch.Generator) -> Measurement:
    """Put a known misalignment on a frame whose colour and depth line up.

    The result is a crop: its rim serves as the margin, since black borders would give the answer away.

    Args:
        frame: A batch of any size.
        max_corner_shift_px: Largest shift of an image corner for an image 1242 pixels wide; it scales with
            the width.
        generator: Source of randomness, on the CPU.

    Raises:
        InputError: The crop would be smaller than what a network takes.
    """
    batch, _, height, width = frame["rgb"].shape
    shift_px = max_corner_shift_px * width / REFERENCE_WIDTH_PX
    margin_px = margin_for(shift_px)
    if min(height, width) - 2 * margin_px < MIN_SIDE_PX:
        least = MIN_SIDE_PX + 2 * margin_px
        raise InputError(
            f"{frame.get('name', ['a frame'])[0]} is {width}x{height}: at least {least}x{least} was expected"
        )
    inner = np.s_[..., margin_px : height - margin_px, margin_px : width - margin_px]
    truth_rgb = frame["rgb"][inner]
    affine = random_affines(batch, (truth_rgb.shape[-2], truth_rgb.shape[-1]), shift_px, generator)
    out = Measurement(**frame)
    out["rgb"], out["truth_rgb"] = misalign_rgb(frame["rgb"], affine, margin_px), truth_rgb
    out["truth_affine_rgb_from_depth"] = affine
    out["depth_m"] = frame["depth_m"][inner]
    if "truth_depth_m" in frame:
        out["truth_depth_m"] = frame["truth_depth_m"][inner]
    if "intrinsics" in frame:
        out["intrinsics"] = frame["intrinsics"] - margin_px * torch.tensor([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    return out


def both_settings(
    frame: Measurement, max_corner_shift_px: float, generator: torch.Generator
) -> tuple[Measurement, Measurement]:
    """The frame with aligned colour, and with colour that is off by a known affine.

    A simulated frame brings its own misalignment and truth; a real one is taken as aligned, then misaligned.
    """
    if "truth_affine_rgb_from_depth" not in frame:
        return frame, misalign(frame, max_corner_shift_px, generator)
    aligned = Measurement(**frame)
    aligned["rgb"] = frame["truth_rgb"]
    return aligned, frame


class Scores:
    """Running metrics of all methods on all tasks, of this process alone: others may have left by now."""

    def __init__(self) -> None:
        alone = {"sync_on_compute": False}
        self.depth: dict[tuple[str, str], DepthMetrics] = defaultdict(partial(DepthMetrics, **alone))
        self.registration: dict[tuple[str, str], RegistrationMetrics] = defaultdict(
            partial(RegistrationMetrics, **alone)
        )
        self.means: dict[tuple[str, str], dict[str, MeanMetric]] = defaultdict(
            partial(defaultdict, partial(MeanMetric, **alone))
        )

    def score_depth(self, task: str, sample: Measurement, output: JointOutput, seconds: float) -> None:
        """Score a batch of one, that the network completed in `seconds`, and the baselines on it."""
        self._add_depth(task, OURS, sample, output.depth_m, seconds)
        for method, complete in COMPLETION_BASELINES.items():
            dense_m, seconds = _timed(complete, sample["depth_m"][0, 0].numpy())
            self._add_depth(task, method, sample, torch.from_numpy(dense_m)[None, None], seconds)

    def score_registration(self, sample: Measurement, output: JointOutput, seconds: float) -> None:
        """Score a batch of one, that the network registered in `seconds`, and the baselines on it."""
        self._add_affine(OURS, sample, output.affine_rgb_from_depth, seconds)
        rgb, depth_m = to_picture(sample["rgb"][0]), sample["depth_m"][0, 0].numpy()
        for method, register in registration_baselines().items():
            affine, seconds = _timed(register, rgb, depth_m)
            self._add_affine(method, sample, None if affine is None else torch.from_numpy(affine)[None], seconds)

    def _add_depth(self, task: str, method: str, sample: Measurement, pred_m: Tensor, seconds: float) -> None:
        truth_m = sample.get("truth_depth_m", torch.zeros_like(pred_m))
        self.depth[task, method].update(pred_m, truth_m)
        self.means[task, method]["seconds"].update(seconds)

    def _add_affine(self, method: str, sample: Measurement, affine: Tensor | None, seconds: float) -> None:
        """An affine of None, no answer, leaves the colour where it is."""
        estimate = identity_affine(1) if affine is None else affine.float()
        height, width = sample["rgb"].shape[-2:]
        truth = sample["truth_affine_rgb_from_depth"]
        self.registration[REGISTRATION, method].update(estimate, truth, (height, width))
        rgb_aligned, seen = warp_affine(sample["rgb"], estimate)
        means = self.means[REGISTRATION, method]
        means["ssim"].update(masked_ssim(rgb_aligned, sample["truth_rgb"], seen))
        means["no_answer"].update(float(affine is None))
        means["seconds"].update(seconds)

    def results(self) -> Results:
        """Everything so far, by task, method and metric."""
        table: dict[str, dict[str, dict[str, float]]] = defaultdict(dict)
        for (task, method), metric in {**self.depth, **self.registration}.items():
            means = {name: mean.compute() for name, mean in self.means[task, method].items()}
            table[task][method] = {name: float(value) for name, value in {**metric.compute(), **means}.items()}
        return table


def _timed(function: Callable[..., T], *args: Any) -> tuple[T, float]:
    start = time.perf_counter()
    result = function(*args)
    return result, time.perf_counter() - start


@torch.inference_mode()
def evaluate(
    network: nn.Module,
    dataset: Dataset[Mapping[str, Any]],
    *,
    max_corner_shift_px: float = 24.0,
    seed: int = 0,
    panel_dir: Path | None = None,
    panels: int = 8,
) -> Results:
    """Score a network and the baselines on a data set, frame by frame, so that sizes may differ.

    Depth is scored with aligned and with misaligned colour; registration against the known misalignment.

    Args:
        network: A `JointNetwork`, on whatever device.
        dataset: Gives `Measurement` items without the batch axis; see `both_settings`.
        max_corner_shift_px: Largest misalignment put on real frames, for an image 1242 pixels wide.
        seed: First number of every misalignment, the second one being the frame's index.
        panel_dir: Existing folder for pictures of the first frames, `<index>.png`; None for none.
        panels: How many pictures at most.

    Returns:
        Task -> method -> metric -> value; NaN where no frame had truth.
    """
    network.eval()
    scores = Scores()
    for index in _progress(len(cast(Any, dataset)), "Evaluating"):
        frame = _batch_of_one(dataset[index])
        aligned, misaligned = both_settings(frame, max_corner_shift_px, seeded_generator(seed, index))
        scores.score_depth(ALIGNED, aligned, *_timed(_run, network, aligned))
        output, seconds = _timed(_run, network, misaligned)
        scores.score_depth(MISALIGNED, misaligned, output, seconds)
        scores.score_registration(misaligned, output, seconds)
        if panel_dir and index < panels:
            truth_m = misaligned.get("truth_depth_m")
            picture = sample_panel(misaligned["rgb"], misaligned["depth_m"], output, truth_m)
            io.write_png(panel_dir / f"{index:06d}.png", picture)
    return scores.results()


def _run(network: nn.Module, sample: Measurement) -> JointOutput:
    """The network's results, on the CPU."""
    device = next(network.parameters()).device
    output = network(sample["rgb"].to(device), sample["depth_m"].to(device))
    results = ("depth_m", "rgb_aligned", "affine_rgb_from_depth")
    return output._replace(**{name: getattr(output, name).cpu() for name in results})


def _batch_of_one(item: Mapping[str, Any]) -> Measurement:
    return cast(Measurement, default_collate([item]))


def _progress(count: int, doing: str) -> Iterable[int]:
    return track(range(count), doing, console=Console(stderr=True), transient=True)
