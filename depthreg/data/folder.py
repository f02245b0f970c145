"""A plain folder of colour and depth files, and how one such pair is read, for other data sets too."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from depthreg.data.io import read_depth_m, read_intrinsics, read_rgb
from depthreg.errors import InputError


def read_pair(
    name: str,
    image: Path,
    depth: Path,
    depth_scale: float,
    truth: Path | None = None,
    intrinsics: np.ndarray | None = None,
) -> dict[str, Any]:
    """Read one `Measurement` without its batch axis; the default collate function adds it.

    Args:
        name: For messages and pictures.
        image: Colour, PNG or JPEG.
        depth: Sparse depth, in any format that `read_depth_m` knows, of the colour's size.
        depth_scale: Stored value per metre, of `depth` and `truth` alike.
        truth: True depth of the same size; None where unknown.
        intrinsics: K, (3, 3); None where unknown.

    Raises:
        InputError: A file can't be read, or the sizes differ.
    """
    rgb = read_rgb(image)
    item: dict[str, Any] = {"name": name, "rgb": torch.from_numpy(rgb).permute(2, 0, 1).float() / 255}
    for key, path in {"depth_m": depth, "truth_depth_m": truth}.items():
        if path is None:
            continue
        depth_m = read_depth_m(path, depth_scale)
        if depth_m.shape != rgb.shape[:2]:
            sizes = ["x".join(map(str, array.shape[1::-1])) for array in (depth_m, rgb)]
            raise InputError(f"{path} is {sizes[0]} but {image} is {sizes[1]}: equal sizes were expected")
        item[key] = torch.from_numpy(depth_m)[None]
    if intrinsics is not None:
        item["intrinsics"] = torch.from_numpy(intrinsics)
    return item


class FolderDataset(Dataset[dict[str, Any]]):
    """Pairs of files whose names agree, from the sub-folders of one folder.

    A pattern holds at most one star; files with the same text in the star's place belong together. After a
    final star, the suffix doesn't count: `image/*` and `depth/*` pair `image/7.jpg` with `depth/7.png`. A
    pattern without a star names one file: the only pair's, or, for the intrinsics, those of all pairs.

    Args:
        root: The folder.
        depth_scale: Stored value per metre: 256 for KITTI, 1000 for millimetres, 1 for metres.
        image, depth: Patterns of colour and sparse depth.
        truth: Pattern of the true depth, in the same scale; `truth/*`, if it is there, where not given.
        intrinsics: Pattern of text files with the 9 numbers of K; `intrinsics/*` and `intrinsics.txt`, as far
            as they are there, where not given.

    Raises:
        InputError: A pattern that matches nothing, a file without its partner, or a senseless scale.
    """

    def __init__(
        self,
        root: str | Path,
        depth_scale: float,
        image: str = "image/*",
        depth: str = "depth/*",
        truth: str | None = None,
        intrinsics: str | None = None,
    ) -> None:
        if not isinstance(depth_scale, int | float) or not depth_scale > 0:
            raise InputError(f"depth_scale={depth_scale}: expected a positive number of stored units per metre")
        self.root, self.depth_scale = Path(root), depth_scale
        self.images, self.depths = self._need(image), self._need(depth)
        self.truths = self._need(truth) if truth else match_files(self.root, "truth/*")
        if intrinsics:
            self.intrinsics = self._need(intrinsics)
        else:
            self.intrinsics = match_files(self.root, "intrinsics.txt") | match_files(self.root, "intrinsics/*")
        alone = sorted(self.images.keys() ^ self.depths.keys())
        if alone:
            path = self.images.get(alone[0]) or self.depths[alone[0]]
            raise InputError(f"{path} has no partner: {self.root / image} and {self.root / depth} must match")
        self.stems = sorted(self.images)

    def _need(self, pattern: str) -> dict[str, Path]:
        found = match_files(self.root, pattern)
        if not found:
            raise InputError(f"{self.root} holds no {pattern}: at least one such file was expected")
        return found

    def __len__(self) -> int:
        return len(self.stems)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """One `Measurement` without its batch axis; truth and intrinsics are absent where unknown."""
        stem = self.stems[index]
        intrinsics = self.intrinsics.get(stem) or self.intrinsics.get("")
        return read_pair(
            stem or self.root.name,
            self.images[stem],
            self.depths[stem],
            self.depth_scale,
            self.truths.get(stem),
            read_intrinsics(intrinsics) if intrinsics else None,
        )


def match_files(root: Path, pattern: str) -> dict[str, Path]:
    """Files under `root` that a pattern with at most one star matches, by what the star stands for.

    Hidden files are left out. After a final star, the suffix isn't part of what it stands for.
    """
    before, star, after = pattern.partition("*")
    if "*" in after:
        raise InputError(f"the pattern {pattern} must hold one star at most")
    if not star:
        return {"": root / pattern} if (root / pattern).is_file() else {}
    files = [path for path in root.glob(pattern) if path.is_file() and not path.name.startswith(".")]
    found: dict[str, Path] = {}
    for path in sorted(files):
        stem = path.relative_to(root).as_posix()[len(before) :]
        stem = stem.removesuffix(after if after else path.suffix)
        if stem in found:
            raise InputError(f"{found[stem]} and {path} have one name: one file for each name was expected")
        found[stem] = path
    return found
