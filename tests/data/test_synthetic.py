"""Synthetic frames: the same everywhere, cached or not, and different between training and validation."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from depthreg.data.datamodule import SyntheticDataModule
from depthreg.data.sample import Frame
from depthreg.data.synthetic import RandomCamera, SyntheticFrames, SyntheticMeasurements, collate_frames
from depthreg.rendering import Embree, Rig, hdl64
from depthreg.sensors import Lidar, SensorSimulator
from depthreg.worlds import BlocksWorld

CAMERA = RandomCamera(width=79, height=65, focal_px=(50.0, 90.0), center_jitter=0.05)


def make_frames(seed: int = 3, count: int = 3, cache_dir: Path | None = None, **options: Any) -> SyntheticFrames:
    return SyntheticFrames(
        BlocksWorld(),
        CAMERA,
        Rig(scans=(hdl64(),)),
        **{"seed": seed, "count": count, "max_depth_m": 80.0, "cache_dir": cache_dir, **options},
    )


def assert_same(first: Any, second: Any) -> None:
    assert first.keys() == second.keys()
    for key in first:
        np.testing.assert_array_equal(first[key], second[key], err_msg=key)


@pytest.fixture(scope="module")
def items() -> list[dict[str, Any]]:
    frames = make_frames()
    return [frames[i] for i in range(len(frames))]


def test_items_follow_the_contract(items: list[dict[str, Any]]) -> None:
    for item in items:
        margin_px = (item["rgb"].shape[0] - 65) // 2
        assert margin_px >= 24 * 79 / 1242
        assert item["rgb"].shape == (65 + 2 * margin_px, 79 + 2 * margin_px, 3) and item["rgb"].dtype == np.uint8
        assert item["depth_m"].shape == (65, 79) and item["depth_m"].dtype == np.float32
        assert item["depth_m"].min() >= 0 and 5 < item["depth_m"].max() <= 80
        assert item["lidar"].shape[1] == 16 and item["lidar"].dtype == np.float32
        focal_px = item["intrinsics"][0, 0]
        assert 50 <= focal_px <= 90 and abs(item["intrinsics"][0, 2] - 39) <= 0.05 * 79


def test_frames_differ_from_each_other_and_so_do_their_cameras(items: list[dict[str, Any]]) -> None:
    assert len({item["rgb"].tobytes() for item in items}) == len(items)
    assert len({float(item["intrinsics"][0, 0]) for item in items}) == len(items)


@pytest.mark.parametrize("workers", [0, 2])
def test_an_item_is_the_same_whatever_the_number_of_workers(workers: int, items: list[dict[str, Any]]) -> None:
    loader = DataLoader(make_frames(), batch_size=3, num_workers=workers, collate_fn=collate_frames)
    assert_same(next(iter(loader)), collate_frames(items))


def test_a_cached_item_is_the_rendered_one_and_only_whole_files_are_left(
    tmp_path: Path, items: list[dict[str, Any]]
) -> None:
    for _ in ("written", "read"):
        frames = make_frames(cache_dir=tmp_path)
        assert_same(frames[1], items[1])
    assert [path.name for path in tmp_path.glob("*/*")] == ["000001.npz"]


def test_a_cached_frame_is_not_rendered_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_frames(cache_dir=tmp_path)[0]
    monkeypatch.setattr(SyntheticFrames, "frame", lambda self, index: pytest.fail("rendered again"))
    make_frames(cache_dir=tmp_path)[0]


def test_an_interrupted_render_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(path: Path, **arrays: object) -> None:
        Path(path).write_bytes(b"half of a file")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_frames(cache_dir=tmp_path)[0]
    assert list(tmp_path.glob("*/*")) == []


@pytest.mark.parametrize("change", [{"seed": 4}, {"max_depth_m": 70.0}])
def test_another_recipe_does_not_share_a_cache(change: dict[str, float], tmp_path: Path) -> None:
    assert make_frames(cache_dir=tmp_path).folder != make_frames(cache_dir=tmp_path, **change).folder


def test_depth_beyond_the_scanners_range_is_unknown(items: list[dict[str, Any]]) -> None:
    near = make_frames(max_depth_m=30.0)[0]["depth_m"]
    far = items[0]["depth_m"]
    assert (far > 30).any()
    np.testing.assert_array_equal(near, np.where(far > 30, 0, far))


@pytest.mark.parametrize("index", [-1, 3])
def test_there_is_no_item_beyond_the_count(index: int) -> None:
    with pytest.raises(IndexError):
        make_frames()[index]


def test_collating_pads_returns_with_nothing(items: list[dict[str, Any]]) -> None:
    short = {**items[1], "lidar": items[1]["lidar"][:5]}
    batch = collate_frames([items[0], short])
    longest = len(items[0]["lidar"])
    assert batch["lidar"].shape == (2, longest, 16) and longest > 5
    np.testing.assert_array_equal(batch["lidar"][1, :5], short["lidar"])
    assert (batch["lidar"][1, 5:] == 0).all()
    np.testing.assert_array_equal(batch["rgb"][0].permute(1, 2, 0), items[0]["rgb"])
    assert batch["depth_m"].shape == (2, 1, 65, 79) and batch["index"].tolist() == [0, 1]


def make_datamodule(**options: Any) -> SyntheticDataModule:
    return SyntheticDataModule(
        BlocksWorld(), CAMERA, Rig(), **{"train_count": 5, "val_count": 3, "batch_size": 2, "workers": 0, **options}
    )


def test_training_and_validation_frames_differ() -> None:
    module = make_datamodule()
    train, val = ([frames[i]["rgb"].tobytes() for i in range(3)] for frames in (module.train_frames, module.val_frames))
    assert not set(train) & set(val)


def test_validation_comes_in_order_and_whole_training_shuffled_in_full_batches() -> None:
    module = make_datamodule()
    assert [batch["index"].tolist() for batch in module.val_dataloader()] == [[0, 1], [2]]
    batches = [batch["index"].tolist() for batch in module.train_dataloader()]
    assert [len(batch) for batch in batches] == [2, 2]
    assert len({index for batch in batches for index in batch}) == 4


def test_both_kinds_of_frames_end_at_the_same_range(tmp_path: Path) -> None:
    module = make_datamodule(max_depth_m=40.0, cache_dir=str(tmp_path))
    for frames in (module.train_frames, module.val_frames):
        assert 5 < frames[0]["depth_m"].max() <= 40
    assert len(list(tmp_path.glob("*/000000.npz"))) == 2


def test_a_measurement_is_a_function_of_its_index_alone() -> None:
    simulator = SensorSimulator(Lidar(), 50.0)
    first, second = (SyntheticMeasurements(make_frames(), simulator, 0.8, seed=2) for _ in range(2))
    last, again = first[2], [second[0], second[2]][-1]
    assert last.pop("name") == again.pop("name") == "000002"
    assert_same(last, again)
    assert last["rgb"].shape == (3, 65, 79) and last["depth_m"].shape == (1, 65, 79)
    assert not torch.equal(last["truth_affine_rgb_from_depth"], second[1]["truth_affine_rgb_from_depth"])


class _Negative(Embree):
    """A renderer whose pictures are negatives."""

    def __call__(self, *arguments: Any, **options: Any) -> Frame:
        frame = super().__call__(*arguments, **options)
        return replace(frame, rgb=255 - frame.rgb)


def test_another_renderer_draws_the_frames_and_keeps_them_apart(tmp_path: Path) -> None:
    usual = make_frames(count=1, cache_dir=tmp_path)
    other = make_frames(count=1, cache_dir=tmp_path, renderer=_Negative())
    np.testing.assert_array_equal(other[0]["rgb"], 255 - usual[0]["rgb"])
    assert other.folder != usual.folder
