"""Fixtures shared by all tests."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from depthreg.data.synthetic import collate_frames
from depthreg.errors import InputError
from depthreg.networks import JointNetwork
from depthreg.rendering.blender import find_python


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real sensor frames, whose licences forbid committing them."""
    default = Path(__file__).resolve().parents[2] / "shared" / "real"
    folder = Path(os.environ.get("DEPTHREG_REAL_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"real sensor frames are not at {folder}: set DEPTHREG_REAL_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def blender_python() -> Path:
    """The Python that has Blender's bpy, which `make blender` brings."""
    try:
        return find_python()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def chromium() -> str:
    """The browser that judges pages; pip can't bring one."""
    found = [path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))]
    if not found:
        pytest.skip("no Chromium: apt-get install chromium, or Chrome, lets a browser judge the page")
    return found[0]


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Tensors as small as these lose more by threads than they gain."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def make_network() -> Callable[[], JointNetwork]:
    """The smallest network that has every part; always of the same weights."""

    def make() -> JointNetwork:
        torch.manual_seed(0)
        return JointNetwork(
            first_channels=8,
            completion_widths=(16,),
            registration_widths=(8, 8),
            registration_hidden=8,
            matchers=((4, 2, 5),),
            residual=True,
        )

    return make


class FormulaFrames(Dataset[dict[str, Any]]):
    """What `SyntheticFrames` gives, made of waves and ramps: nothing is rendered."""

    def __init__(self, count: int, first: int = 0, size: int = 64, margin_px: int = 4) -> None:
        self.count, self.first, self.size, self.margin_px = count, first, size, margin_px

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not 0 <= index < self.count:
            raise IndexError(index)
        phase = 0.7 * (self.first + index)
        y, x = np.mgrid[: self.size + 2 * self.margin_px, : self.size + 2 * self.margin_px] / self.size
        waves = [np.sin(9 * x + phase + k) * np.cos(7 * y - phase) for k in range(3)]
        inner = slice(self.margin_px, -self.margin_px)
        depth_m = (6 + 4 * waves[0] + 5 * y)[inner, inner].astype(np.float32)
        row, column = np.mgrid[: self.size : 4, : self.size : 3].reshape(2, -1)
        at_m, one = depth_m[row, column], np.ones(len(row))
        ray = np.stack([(column - 31.5) / 60, (row - 31.5) / 60, one])
        returns = [column, row, at_m, at_m, one, one, 0 * one, at_m, one, row, one, one, 0 * one]
        return {
            "rgb": np.rint(127.5 + 127.5 * np.stack(waves, axis=-1)).astype(np.uint8),
            "depth_m": depth_m,
            "intrinsics": np.array([[60, 0, 31.5], [0, 60, 31.5], [0, 0, 1]], np.float32),
            "lidar": np.column_stack([*returns, *ray / np.linalg.norm(ray, axis=0)]).astype(np.float32),
            "baseline_m": np.float32(0.54),
            "index": index,
        }


@pytest.fixture(scope="session")
def make_formula_frames() -> Callable[..., FormulaFrames]:
    """A data set of `FormulaFrames`."""
    return FormulaFrames


@pytest.fixture(scope="session")
def make_loader() -> Callable[..., DataLoader]:
    """Loads batches of two `FormulaFrames`, in order."""

    def make(count: int = 4, first: int = 0) -> DataLoader:
        return DataLoader(FormulaFrames(count, first), batch_size=2, collate_fn=collate_frames)

    return make
