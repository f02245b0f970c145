"""Registration with a known answer: random affines put on real frames, and rendered frames never trained on."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import nn

from depthreg.baselines.registration import Registrar
from depthreg.config import compose_config
from depthreg.data.sample import Measurement
from depthreg.evaluate import build_dataset
from depthreg.evaluation.scores import run_network
from depthreg.evaluation.settings import misalign
from depthreg.geometry import compose_affines, corner_errors_px, identity_affine
from depthreg.report import OURS
from depthreg.sensors.misalignment import REFERENCE_WIDTH_PX
from depthreg.sensors.simulator import seeded_generator
from depthreg.viz import to_picture
from judging.readers import as_batch
from judging.table import Row

Progress = Callable[[Iterable, str], Iterable]

IDENTITY = "identity"
CONSISTENCY = "ours, against its answer on the untouched frame"
LIDAR_SHIFT_PX = 24.0  # of the worst corner, for 1242 px of width
ROOM_SHIFT_PX = 0.05 * REFERENCE_WIDTH_PX
LARGE, ANY = (0.85, 1.0), (0.0, 1.0)  # shares of the largest shift; LARGE ones leave the identity 16 px off on KITTI
NEAR_PX = 3.0
SEED = 7


@dataclass
class Errors:
    """Mean corner errors in pixels, by method; frame by frame, in one order."""

    px: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(
        self,
        sample: Measurement,
        method: str,
        affine: torch.Tensor | np.ndarray | None,
        before: torch.Tensor | None = None,
    ) -> None:
        """Add an estimate; None, no answer, leaves the colour where it is.

        Args:
            sample: With the affine that was put on it.
            method: Whose estimate.
            affine: The estimate.
            before: What aligned the frame before that affine was put on it; nothing had to, where not given.
        """
        estimate = identity_affine(1) if affine is None else torch.as_tensor(affine).float().reshape(1, 2, 3)
        height, width = sample["rgb"].shape[-2:]
        truth = sample["truth_affine_rgb_from_depth"]
        error_px = corner_errors_px(
            estimate, truth if before is None else compose_affines(truth, before), (height, width)
        )
        self.px[method].append(error_px.mean().item())

    def medians(self, methods: Iterable[str] | None = None) -> dict[str, float]:
        """Over the frames that each method saw."""
        return {method: float(np.median(self.px[method])) for method in methods or self.px}


def known_affines(
    frames: Sequence[Measurement], max_shift_px: float, shares: tuple[float, float], draws: int
) -> list[Measurement]:
    """Each frame with so many random affines put on it, all first draws first."""
    samples = []
    for draw in range(draws):
        for index, frame in enumerate(frames):
            seed = (SEED, index, draw)
            shift_px = max_shift_px * np.random.default_rng(seed).uniform(*shares)
            samples.append(misalign(frame, max_shift_px, seeded_generator(*seed), shift_px))
    return samples


def rendered(count: int) -> list[Measurement]:
    """Streets and rooms that no training has seen, measured and misaligned as training's are."""
    samples = []
    for overrides in (
        ["world=driving", "sensor=hdl64"],
        ["world=household", "sensor=kinect", "data.width=640", "data.height=480", "data.camera.focal_px=[460,620]"],
    ):
        config = compose_config("evaluate", ["data=synthetic", f"data.val_count={count}", "seed=31337", *overrides])
        dataset = build_dataset(config)
        samples += [as_batch(dataset[index]) for index in range(len(dataset))]
    return samples


def measure(
    network: nn.Module,
    samples: Sequence[Measurement],
    progress: Progress,
    doing: str,
    methods: dict[str, Registrar],
    compared: int = 0,
    untouched: Sequence[Measurement] = (),
) -> Errors:
    """Corner errors of the network and the identity on all samples, of other methods on the first `compared`.

    Args:
        network: Ours.
        samples: Frames with known affines put on them.
        progress: Counts them.
        doing: What it says.
        methods: The others.
        compared: How many samples those see.
        untouched: The frames before that, in the samples' order, over and over. A frame whose colour and depth don't
            line up to begin with, as a moving car's scan, makes any answer wrong that aligns them; how well answers
            follow the affine shows beside their answers on these.
    """
    errors = Errors()
    before = [run_network(network, frame).affine_rgb_from_depth for frame in untouched]
    for index, sample in enumerate(progress(samples, doing)):
        affine = run_network(network, sample).affine_rgb_from_depth
        errors.add(sample, OURS, affine)
        errors.add(sample, IDENTITY, None)
        if before:
            errors.add(sample, CONSISTENCY, affine, before[index % len(before)])
        if index < compared:
            rgb, depth_m = to_picture(sample["rgb"][0]), sample["depth_m"][0, 0].numpy()
            for name, register in methods.items():
                errors.add(sample, name, register(rgb, depth_m))
    return errors


def rows_of(errors: Errors, what: str, bar_px: float, aim_px: float, of: str) -> list[Row]:
    """Median corner error and the share under 3 px, the identity beside."""
    part, both = "registration", {name: np.array(errors.px[name]) for name in (OURS, IDENTITY)}
    median = {name: float(np.median(px)) for name, px in both.items()}
    under = {name: float(np.mean(px < NEAR_PX)) for name, px in both.items()}
    beside = {IDENTITY: median[IDENTITY]}
    return [
        Row(part, f"corner error (px), median, {what}", median[OURS], beside, median[OURS], bar_px, aim_px, of=of),
        Row(
            part,
            f"share under 3 px, {what}",
            under[OURS],
            {IDENTITY: under[IDENTITY]},
            under[OURS],
            0.7,
            0.95,
            most=False,
            of=of,
        ),
    ]


def consistency(errors: Errors, what: str, of: str) -> Row:
    """How far answers are from following the affine that was put on a frame."""
    median = float(np.median(errors.px[CONSISTENCY]))
    return Row("registration", f"corner error (px), median, {what}: {CONSISTENCY}", median, value=median, of=of)


def beside_classical(errors: Errors, what: str, compared: int) -> Row:
    """Our median beside the best of the methods that learn nothing, on the same frames: 5 times better is the bar."""
    ours = float(np.median(errors.px[OURS][:compared]))
    theirs = errors.medians(name for name in errors.px if name not in (OURS, IDENTITY, CONSISTENCY))
    best = min(theirs.values())
    absent = "" if "elastix" in theirs else "; elastix isn't installed"
    return Row(
        "registration",
        f"corner error (px), median, {what}: share of the best classical",
        ours,
        theirs,
        ours / best,
        1 / 5,
        1 / 15,
        of=f"{compared} frames{absent}",
    )
