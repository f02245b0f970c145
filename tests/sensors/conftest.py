"""Frames made by formulas, so that no renderer is needed to try a sensor."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from depthreg.data.sample import FrameBatch, LidarColumns

MakeFrames = Callable[..., FrameBatch]


@pytest.fixture
def make_frames() -> MakeFrames:
    """Smooth colour with a margin, ramps of depth, and returns on every third pixel of every second row."""

    def make(batch: int = 2, height: int = 61, width: int = 93, margin_px: int = 9) -> FrameBatch:
        y, x = torch.meshgrid(
            torch.arange(-margin_px, height + margin_px) / height,
            torch.arange(-margin_px, width + margin_px) / width,
            indexing="ij",
        )
        waves = [0.5 + 0.4 * torch.sin(7 * x + k) * torch.cos(5 * y - k) for k in range(3 * batch)]
        rgb = (255 * torch.stack(waves)).round().to(torch.uint8).unflatten(0, (batch, 3))
        inner = slice(margin_px, -margin_px or None)
        depth_m = torch.stack([(5 + 20 * y + 3 * x + b)[inner, inner] for b in range(batch)])[:, None]
        rows, columns = torch.meshgrid(torch.arange(0, height, 2), torch.arange(0, width, 3), indexing="ij")
        at_m = depth_m[:, 0, rows, columns].flatten(1)
        columns, rows = columns.flatten().expand_as(at_m), rows.flatten().expand_as(at_m)
        ring = (rows * 64 // height).float()
        column, row = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
        matched_px = 80 * 0.54 / depth_m * (1 + 0.05 * torch.sin(0.9 * column + row))
        one = torch.ones_like(at_m)
        ray = torch.stack([(columns - 44) / 80, (rows - 31) / 80, one], dim=-1)
        range_m = at_m * ray.norm(dim=-1)
        lidar = LidarColumns(
            columns, rows, at_m, range_m, one, 0.5 * one, 0 * one, range_m, one, ring, one, 0.5 * one, 0 * one,
            *(ray / ray.norm(dim=-1, keepdim=True)).unbind(-1),
        )  # fmt: skip
        return FrameBatch(
            rgb=rgb,
            depth_m=depth_m,
            intrinsics=torch.tensor([[80.0, 0, 44], [0, 80, 31], [0, 0, 1]]).repeat(batch, 1, 1),
            lidar=torch.stack(lidar, dim=-1),
            baseline_m=torch.full((batch,), 0.54),
            index=torch.arange(batch) + 5,
            disparity_px=matched_px * (torch.sin(0.2 * column - 0.3 * row) < 0.7),  # with stripes without an answer
            normal=torch.tensor([0.0, 0, -1])[:, None, None].expand(batch, 3, height, width).clone(),
            albedo=torch.full_like(depth_m, 0.5),
            gloss=torch.full_like(depth_m, 0.1),
        )

    return make


@pytest.fixture
def make_surface() -> MakeFrames:
    """Frames of a given depth (B, 1, H, W), all facing the camera, seen so far away that its rays are parallel."""

    def make(depth_m: Tensor, albedo: float = 1.0, gloss: float = 0.0, focal_px: float = 1e5) -> FrameBatch:
        batch, _, height, width = depth_m.shape
        center = [(width - 1) / 2, (height - 1) / 2]
        return FrameBatch(
            rgb=torch.zeros(batch, 3, height, width, dtype=torch.uint8),
            depth_m=depth_m,
            intrinsics=torch.tensor([[focal_px, 0, center[0]], [0, focal_px, center[1]], [0, 0, 1]]).repeat(
                batch, 1, 1
            ),
            lidar=torch.zeros(batch, 0, len(LidarColumns._fields)),
            baseline_m=torch.full((batch,), 0.075),
            index=torch.arange(batch),
            normal=torch.tensor([0.0, 0, -1])[:, None, None].expand(batch, 3, height, width).clone(),
            albedo=torch.full_like(depth_m, albedo),
            gloss=torch.full_like(depth_m, gloss),
        )

    return make
