"""Panels of every kind of real frame, to be looked at; they stay on this machine, as the frames' licences want."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from torch import nn

from depthreg.baselines import ip_basic
from depthreg.data import io
from depthreg.data.sample import Measurement
from depthreg.evaluation.scores import run_network
from depthreg.evaluation.worst import error_panel
from depthreg.report import OURS
from depthreg.viz import sample_panel, to_picture

Progress = Callable[[Iterable, str], Iterable]


def draw(network: nn.Module, kinds: Mapping[str, Measurement], folder: Path, progress: Progress) -> None:
    """A panel a kind: with truth, signed errors beside IP-Basic's; without, colour before and after, and depth."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, sample in progress(list(kinds.items()), "pictures"):
        output = run_network(network, sample)
        sparse_m = sample["depth_m"][0, 0].numpy()
        stem = "".join(letter if letter.isalnum() else "_" for letter in name)
        if "truth_depth_m" in sample:
            completed_m = {OURS: output.depth_m[0, 0].numpy(), "IP-Basic": ip_basic(sparse_m)}
            truth_m = sample["truth_depth_m"][0, 0].numpy()
            picture = error_panel(to_picture(sample["rgb"][0]), sparse_m, completed_m, truth_m)
            io.write_png(folder / f"{stem}_errors.png", picture)
        picture = sample_panel(sample["rgb"], sample["depth_m"], output, sample.get("truth_depth_m"))
        io.write_png(folder / f"{stem}.png", picture)
