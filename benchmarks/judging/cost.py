"""How large a network is, and how long it takes for a KITTI frame."""

import math
import time

import torch
from torch import nn

from judging.table import Row

SIZE = (375, 1242)
RUNS = 5


def rows(network: nn.Module, threads: int) -> list[Row]:
    """Parameters in millions; median seconds on this machine's cores, and on its GPU where it has one."""
    parameters = sum(parameter.numel() for parameter in network.parameters()) / 1e6
    seconds = median_seconds(network, "cpu")
    milliseconds = 1000 * median_seconds(network, "cuda") if torch.cuda.is_available() else math.nan
    part, of = "cost", f"1242x375, median of {RUNS}"
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU here: not measured"
    return [
        Row(part, "parameters (millions)", parameters, {}, parameters, 5.2, 3.0),
        Row(part, f"time on {threads} threads (s)", seconds, {}, seconds, 1.0, 0.3, of=of),
        Row(part, "time on a GPU, bf16, compiled (ms)", milliseconds, {}, milliseconds, 8.0, 3.0, of=f"{of}; {gpu}"),
    ]


def inputs() -> tuple[torch.Tensor, torch.Tensor]:
    """Noise, and returns at one pixel in twenty."""
    generator = torch.Generator().manual_seed(0)
    rgb, depth_m = (torch.rand(1, channels, *SIZE, generator=generator) for channels in (3, 1))
    known = torch.rand(1, 1, *SIZE, generator=generator) < 0.05
    return rgb, (5 + 60 * depth_m) * known


@torch.inference_mode()
def median_seconds(network: nn.Module, device: str) -> float:
    """Median of a few runs, after warming up; on a GPU in bfloat16, compiled."""
    home = next(network.parameters()).device
    rgb, depth_m = (tensor.to(device) for tensor in inputs())
    on_gpu = device == "cuda"
    run = torch.compile(network.to(device)) if on_gpu else network.to(device)
    seconds = []
    with torch.autocast("cuda", torch.bfloat16, enabled=on_gpu):
        for _ in range(RUNS + 3):
            start = time.perf_counter()
            run(rgb, depth_m)
            if on_gpu:
                torch.cuda.synchronize()
            seconds.append(time.perf_counter() - start)
    network.to(home)
    return sorted(seconds[3:])[RUNS // 2]
