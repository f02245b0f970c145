"""What `benchmarks/inference.py` times: each method makes of a case a function that does one frame."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from depthreg.baselines.completion import ip_basic
from depthreg.checkpoint import RELEASED, load_network
from depthreg.data.io import read_depth_m, read_rgb, write_depth_png, write_png
from depthreg.export import Size, export, made_frame, open_exported
from depthreg.frame_network import FrameNetwork
from depthreg.model import Model
from depthreg.networks import TinyUNet
from depthreg.pipeline import WriteBehind, read_ahead
from speed.unets import RESNET18, RESNET34, ResNetUNet

FILES = 6  # frames that a run of the pipeline reads and writes
SCALE = 256.0  # of their depth files


@dataclass(frozen=True)
class Case:
    """One row of the table.

    Attributes:
        method: One of `METHODS`.
        precision: One of those that the method lists.
        size: Of the frame.
        threads: That may compute.
        checkpoint: Our weights.
    """

    method: str
    precision: str
    size: Size
    threads: int
    checkpoint: Path = RELEASED


@dataclass(frozen=True)
class Runner:
    """A method that is ready.

    Attributes:
        run: Does `frames` frames, from what a camera gives to metres.
        parameters: Of the network, in millions.
        frames: How many a run does.
    """

    run: Callable[[], object]
    parameters: float = 0.0
    frames: int = 1


def _millions(network: nn.Module) -> float:
    return sum(parameter.numel() for parameter in network.parameters()) / 1e6


def _cast(run: Callable[[], object], precision: str) -> Callable[[], object]:
    """Without gradients, convolutions in bfloat16 where that is asked for."""

    def cast() -> None:
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            run()

    return cast


def _ours(case: Case) -> nn.Module:
    return load_network(case.checkpoint)


def eager(case: Case) -> Runner:
    """Our network as PyTorch runs it."""
    network, frame = FrameNetwork(_ours(case)), made_frame(case.size)
    return Runner(_cast(lambda: network(*frame), case.precision), _millions(network))


def compiled(case: Case) -> Runner:
    """The same after torch.compile, which needs a C++ compiler."""
    network, frame = FrameNetwork(_ours(case)), made_frame(case.size)
    network.compile()
    return Runner(_cast(lambda: network(*frame), case.precision), _millions(network))


def onnx_runtime(case: Case) -> Runner:
    """The same in ONNX Runtime, exported for this size alone."""
    network = _ours(case)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        export(network, path, "onnx", case.precision, case.size, {})
        session = open_exported(path, "onnx", case.threads)
    frame = made_frame(case.size)
    return Runner(lambda: session(*frame), _millions(network))


def files_in_turn(case: Case) -> Runner:
    """Read, compute, write, one frame after the other: what overlapping is compared with."""
    model, pairs, out = _files(case)

    def run() -> None:
        for pair in pairs:
            _write(out, model(*_read(pair)).depth_m)

    return Runner(run, _millions(model.network), len(pairs))


def files_overlapped(case: Case) -> Runner:
    """The same, with the next frames read and the last ones written meanwhile."""
    model, pairs, out = _files(case)

    def run() -> None:
        with WriteBehind() as write_behind:
            for frame in read_ahead(_read, pairs):
                write_behind(_write, out, model(*frame).depth_m)

    return Runner(run, _millions(model.network), len(pairs))


def _files(case: Case) -> tuple[Model, list[tuple[Path, Path]], Path]:
    """Our model, and pairs of files in a folder that lasts as long as the process."""
    folder = Path(tempfile.mkdtemp(dir=_FOLDER.name))
    pairs = [(folder / f"{index}_rgb.png", folder / f"{index}_depth.png") for index in range(FILES)]
    for index, (rgb_path, depth_path) in enumerate(pairs):
        rgb, depth_m = made_frame(case.size, index)
        write_png(rgb_path, cv2.GaussianBlur(rgb.numpy(), (7, 7), 0))  # compresses about as a photo does
        write_depth_png(depth_path, depth_m.numpy(), SCALE)
    return Model(_ours(case)), pairs, folder / "completed.png"


_FOLDER = tempfile.TemporaryDirectory()  # removed when the process ends


def _read(pair: tuple[Path, Path]) -> tuple[np.ndarray, np.ndarray]:
    return read_rgb(pair[0]), read_depth_m(pair[1], SCALE)


def _write(path: Path, depth_m: np.ndarray) -> None:
    write_depth_png(path, depth_m, SCALE)


def classical(case: Case) -> Runner:
    """IP-Basic, which needs no colour and no training."""
    _, depth_m = made_frame(case.size)
    sparse_m = depth_m.numpy()
    return Runner(lambda: ip_basic(sparse_m))


def _stand_in(network: nn.Module, stride: int, case: Case) -> Runner:
    """A network with random weights that sees colour and depth and gives depth, all at the frame's size."""
    network = network.eval()
    rgb, depth_m = made_frame(case.size)

    def run() -> Tensor:
        height, width = case.size
        seen = torch.cat([rgb.permute(2, 0, 1)[None].float() / 255, depth_m[None, None]], dim=1)
        padded = F.pad(seen, [0, -width % stride, 0, -height % stride])
        return network(padded)[..., :height, :width]

    return Runner(_cast(run, case.precision), _millions(network))


def tiny_unet(case: Case) -> Runner:
    """TinyU-Net as published, whose 0.48 M parameters say little about its time."""
    network = TinyUNet(4, 1, (64, 128, 256, 512))
    return _stand_in(network, network.stride, case)


def resnet18_unet(case: Case) -> Runner:
    """segmentation-models-pytorch's U-Net with its ResNet-18, built here."""
    return _stand_in(ResNetUNet(4, RESNET18), 32, case)


def large_unet(case: Case) -> Runner:
    """A U-Net with a ResNet-34 and a decoder twice as wide: CompletionFormer's order of size, without its attention."""
    return _stand_in(ResNetUNet(4, RESNET34, (512, 256, 128, 64, 32)), 32, case)


METHODS: dict[str, tuple[Callable[[Case], Runner], Sequence[str]]] = {  # how, and in which precisions
    "ours, eager": (eager, ("fp32", "bf16")),
    "ours, compiled": (compiled, ("fp32", "bf16")),
    "ours, ONNX Runtime": (onnx_runtime, ("fp32", "int8")),
    "ours, files in turn": (files_in_turn, ("fp32",)),
    "ours, files overlapped": (files_overlapped, ("fp32",)),
    "IP-Basic": (classical, ("fp32",)),
    "TinyU-Net": (tiny_unet, ("fp32", "bf16")),
    "U-Net, ResNet-18": (resnet18_unet, ("fp32", "bf16")),
    "30 M stand-in": (large_unet, ("fp32", "bf16")),
}
