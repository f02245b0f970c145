"""A tiny network that is told to separate two sets of sparse depth images; its AUC says how well it can."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn
from torchmetrics.functional.classification import binary_auroc

from likeness.frames import DepthImage, fill_nearest

PATCH_PX = (32, 64)
_LEAST_RETURNS = 20
_PATCHES_A_GROUP = 60
_MEDIAN_M = 12.0  # depth that the network sees as 0

CHANNELS: dict[str, tuple[bool, bool]] = {  # what it gets to see: where returns are, and how deep they are
    "validity and depth": (True, True),
    "validity only": (True, False),
    "depth only": (False, True),
}


@dataclass(frozen=True)
class PatchSet:
    """Patches of some frames: inputs (N, 2, 32, 64), and the group of each."""

    inputs: Tensor
    groups: np.ndarray


def small_network() -> nn.Sequential:
    """Two convolutions and a mean: 487 parameters.

    Normalisation is what makes it learn: means over patches where one pixel in twenty has a return are tiny numbers,
    and without it 400 steps end where they began, with an AUC that says nothing.
    """
    return nn.Sequential(
        nn.Conv2d(2, 6, 3, padding=1),
        nn.BatchNorm2d(6),
        nn.ReLU(),
        nn.AvgPool2d(2),
        nn.Conv2d(6, 6, 3, stride=2, padding=1),
        nn.BatchNorm2d(6),
        nn.ReLU(),
        nn.AdaptiveAvgPool2d(1),
        nn.Flatten(),
        nn.BatchNorm1d(6),
        nn.Linear(6, 1),
    )


def cut_patches(frames: Sequence[DepthImage], seed: int, channels: str = "validity and depth") -> PatchSet:
    """Patches at random places, as many of each group; those with fewer than 20 returns are drawn again.

    Args:
        frames: Where they are cut from.
        seed: Chooses the places.
        channels: A key of `CHANNELS`. The network sees whether a pixel has a return, and the logarithm of its depth;
            without validity, depth is filled from the nearest return, so that it can't tell where returns were.
    """
    rng = np.random.default_rng(seed)
    see_validity, see_depth = CHANNELS[channels]
    height, width = PATCH_PX
    names = [frame.group for frame in frames]
    inputs, groups = [], []
    for frame, name in zip(frames, names, strict=True):
        wanted = -(-_PATCHES_A_GROUP // names.count(name))
        depth_m, valid = frame.depth_m, frame.depth_m > 0
        shown_m = depth_m if see_validity or not see_depth else fill_nearest(depth_m)
        log_depth = np.where(shown_m > 0, np.log(np.maximum(shown_m, 0.1) / _MEDIAN_M), 0)
        while wanted:
            y, x = rng.integers(0, np.array(depth_m.shape) - PATCH_PX + 1)
            place = np.s_[y : y + height, x : x + width]
            if valid[place].sum() < _LEAST_RETURNS:
                continue
            inputs.append(np.stack([valid[place] * see_validity, log_depth[place] * see_depth]).astype(np.float32))
            groups.append(name)
            wanted -= 1
    return PatchSet(torch.from_numpy(np.stack(inputs)), np.array(groups))


def _split(groups: np.ndarray, rng: np.random.Generator, test_share: float = 0.35) -> np.ndarray:
    """Which patches are held out, bool (N,): whole groups."""
    names = rng.permutation(np.unique(groups))
    return np.isin(groups, names[: max(1, round(test_share * len(names)))])


def separability(first: PatchSet, second: PatchSet, seed: int, steps: int = 400) -> float:
    """Area under the ROC curve on patches of held-out groups: 0.5 = it can't tell, 1 = it always can.

    Args:
        first: One set, label 0.
        second: The other, label 1; a group is trained on or tested on as a whole.
        seed: Of the split, of the network's first weights and of its batches.
        steps: Of Adam, on 64 patches of each set.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    held_out = [torch.from_numpy(_split(patches.groups, rng)) for patches in (first, second)]
    train = [p.inputs[~out] for p, out in zip((first, second), held_out, strict=True)]
    test = [p.inputs[out] for p, out in zip((first, second), held_out, strict=True)]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = small_network()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-2, total_steps=steps)
    label = torch.cat([torch.zeros(64), torch.ones(64)])
    for _ in range(steps):
        batch = torch.cat([x[torch.randint(len(x), (64,), generator=generator)] for x in train])
        mirrored = torch.rand(len(batch), 1, 1, 1, generator=generator) < 0.5
        batch = torch.where(mirrored, batch.flip(-1), batch)
        loss = nn.functional.binary_cross_entropy_with_logits(network(batch)[:, 0], label)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        score = network.eval()(torch.cat(test))[:, 0].sigmoid()
    return float(binary_auroc(score, torch.cat([torch.zeros(len(test[0])), torch.ones(len(test[1]))]).long()))


def auc(
    first: Sequence[DepthImage], second: Sequence[DepthImage], seeds: int, channels: str = "validity and depth"
) -> tuple[float, float]:
    """Mean and standard deviation of the AUC over seeds, each with its own patches, split and weights."""
    found = [
        separability(cut_patches(first, 2 * s, channels), cut_patches(second, 2 * s + 1, channels), s)
        for s in range(seeds)
    ]
    return float(np.mean(found)), float(np.std(found))


def auc_within(
    frames: Sequence[DepthImage], seeds: int, spoil: Callable[[DepthImage, int], DepthImage] | None = None
) -> tuple[float, float]:
    """As `auc`, for random halves of one set, split by group: what an AUC of no difference looks like.

    Args:
        frames: The set.
        seeds: How many classifiers.
        spoil: What is done to each frame of the second half, with its number as seed: a difference that has to show.
    """
    names, found = sorted({frame.group for frame in frames}), []
    for s in range(seeds):
        chosen = set(np.random.default_rng(s).permutation(names)[: len(names) // 2].tolist())
        halves = [[f for f in frames if (f.group in chosen) is side] for side in (True, False)]
        if spoil:
            halves[1] = [spoil(frame, k) for k, frame in enumerate(halves[1])]
        found.append(separability(*(cut_patches(half, s, "validity and depth") for half in halves), s))
    return float(np.mean(found)), float(np.std(found))


def drop_a_tenth(frame: DepthImage, seed: int) -> DepthImage:
    """The frame without one return in ten, chosen by chance: a small flaw, to check that the classifier sees those."""
    kept = np.random.default_rng(seed).random(frame.depth_m.shape) >= 0.1
    return replace(frame, depth_m=frame.depth_m * kept)
