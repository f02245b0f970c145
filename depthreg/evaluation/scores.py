"""Running scores of the network and of the baselines on the same frames."""

import math
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric

from depthreg.baselines import COMPLETION_BASELINES, registration_baselines
from depthreg.data.sample import Measurement
from depthreg.geometry import identity_affine, warp_affine
from depthreg.metrics import DepthMetrics, RegistrationMetrics, depth_errors, masked_ssim
from depthreg.networks import JointOutput
from depthreg.report import OURS, REGISTRATION, Results
from depthreg.viz import to_picture

T = TypeVar("T")


@torch.inference_mode()
def run_network(network: nn.Module, sample: Measurement, **options: Any) -> JointOutput:
    """The network's results on a batch, on the CPU; `register=False` takes the colour as it comes."""
    device = next(network.parameters()).device
    output = network(sample["rgb"].to(device), sample["depth_m"].to(device), **options)
    return output._replace(
        **{name: value.cpu() for name, value in output._asdict().items() if isinstance(value, Tensor)}
    )


def timed(function: Callable[..., T], *args: Any) -> tuple[T, float]:
    """What a function returns, and the seconds that it took."""
    start = time.perf_counter()
    result = function(*args)
    return result, time.perf_counter() - start


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
        self.rmse_m: dict[tuple[str, str], list[float]] = defaultdict(list)  # frame by frame, NaN without truth

    def score_depth(self, task: str, sample: Measurement, output: JointOutput, seconds: float) -> None:
        """Score a batch of one, that the network completed in `seconds`, and the baselines on it."""
        self._add_depth(task, OURS, sample, output.depth_m, seconds)
        for method, complete in COMPLETION_BASELINES.items():
            dense_m, seconds = timed(complete, sample["depth_m"][0, 0].numpy())
            self._add_depth(task, method, sample, torch.from_numpy(dense_m)[None, None], seconds)

    def score_registration(self, sample: Measurement, output: JointOutput, seconds: float) -> None:
        """Score a batch of one, that the network registered in `seconds`, and the baselines on it."""
        self._add_affine(OURS, sample, output.affine_rgb_from_depth, seconds)
        rgb, depth_m = to_picture(sample["rgb"][0]), sample["depth_m"][0, 0].numpy()
        for method, register in registration_baselines().items():
            affine, seconds = timed(register, rgb, depth_m)
            self._add_affine(method, sample, None if affine is None else torch.from_numpy(affine)[None], seconds)

    def _add_depth(self, task: str, method: str, sample: Measurement, pred_m: Tensor, seconds: float) -> None:
        truth_m = sample.get("truth_depth_m", torch.zeros_like(pred_m))
        self.depth[task, method].update(pred_m, truth_m)
        self.rmse_m[task, method].append(depth_errors(pred_m, truth_m)[0, 0].item() if truth_m.any() else math.nan)
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
