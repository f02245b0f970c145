"""`depthreg export`: a network as a file that runs without depthreg: colour and returns in, metres out."""

import argparse
import importlib.util
import json
import logging
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn

from depthreg import __version__
from depthreg.checkpoint import RELEASED, load_network
from depthreg.data.io import atomic_write
from depthreg.errors import ArgumentParser, InputError
from depthreg.frame_network import INPUTS, OUTPUTS, FrameNetwork, with_rowwise_norms
from depthreg.networks import Network
from depthreg.networks.blocks import MAX_EXPORTED_SIDE_PX
from depthreg.networks.output import MIN_SIDE_PX

SUFFIXES = {"onnx": ".onnx", "torchscript": ".pt", "pt2": ".pt2"}
PRECISIONS = ("fp32", "fp16", "int8")
OPSET = 17  # of ONNX
METADATA = "depthreg"  # the key of what an exported file says about itself, as JSON


class Size(NamedTuple):
    """Height and width in pixels."""

    height: int
    width: int


def main(argv: Sequence[str]) -> int:
    """Run `depthreg export`: everything is checked before the network is loaded."""
    options = _parse(argv)
    path, kind = options.out, _format(options)
    if path.exists() or not path.absolute().parent.is_dir():
        raise InputError(f"{path} can't be written: expected a new file in a folder that is there")
    if kind == "pt2" and options.size is None:
        raise InputError("--format pt2 is for one size: expected --size WIDTHxHEIGHT, or another format for any size")
    if kind != "onnx" and options.precision == "int8":
        raise InputError(f"--precision int8 is for ONNX Runtime: expected --format onnx, not {kind}")
    if kind == "onnx" and not all(importlib.util.find_spec(name) for name in ("onnx", "onnxruntime")):
        raise InputError("--format onnx needs ONNX and its runtime: expected pip install 'depthreg[export]' before it")
    network = load_network(options.checkpoint)
    description = describe(network, options.checkpoint.name, options.precision, options.size)
    with atomic_write(path) as partial:
        export(network, partial, kind, options.precision, options.size, description)
        apart_m = difference_m(FrameNetwork(network), open_exported(partial, kind), options.size or Size(101, 173))
    megabytes = path.stat().st_size / 1e6
    Console().print(
        f"{path}: {kind}, {options.precision}, {description['size']}, {megabytes:.1f} MB; "
        f"at most {1000 * apart_m:.3g} mm from PyTorch on a made frame, 4 to 40 m deep",
        soft_wrap=True,
    )
    return 0


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="depthreg export",
        description="Write a network as a file that runs without depthreg, with what comes before and after it inside.",
        epilog="In: "
        + "; ".join(f"{name}: {what}" for name, what in INPUTS.items())
        + ". Out: "
        + "; ".join(f"{name}: {what}" for name, what in OUTPUTS.items())
        + ".",
    )
    add = parser.add_argument
    add(
        "checkpoint",
        type=Path,
        nargs="?",
        default=RELEASED,
        metavar="CKPT",
        help="weights; by default the released ones",
    )
    add("out", type=Path, metavar="OUT", help="new file: .onnx, .pt (TorchScript) or .pt2 (torch.export)")
    add("--format", choices=SUFFIXES, help="by default what OUT's ending says")
    add(
        "--size",
        type=_size,
        metavar="WxH",
        help=f"take this size alone, which is faster; by default any from {MIN_SIDE_PX} to {MAX_EXPORTED_SIDE_PX} px",
    )
    add("--precision", choices=PRECISIONS, default="fp32", help="of the convolutions; default: fp32")
    return parser.parse_args(argv)


def _size(text: str) -> Size:
    """Width and height as a user gives them."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    size = Size(int(match[2]), int(match[1])) if match else Size(0, 0)
    if not all(MIN_SIDE_PX <= side <= MAX_EXPORTED_SIDE_PX for side in size):
        raise argparse.ArgumentTypeError(
            f"{text} is no size: expected WIDTHxHEIGHT, {MIN_SIDE_PX} to {MAX_EXPORTED_SIDE_PX} px"
        )
    return size


def _format(options: argparse.Namespace) -> str:
    """The format that is asked for, by name or by the file's ending."""
    kind = options.format or next((name for name, suffix in SUFFIXES.items() if suffix == options.out.suffix), None)
    if kind is None or options.out.suffix != SUFFIXES[kind]:
        endings = SUFFIXES[kind] if kind else ", ".join(SUFFIXES.values())
        raise InputError(f"{options.out} has the wrong ending: expected {endings}")
    return kind


def describe(network: Network, checkpoint: str, precision: str, size: Size | None) -> dict[str, Any]:
    """What an exported file says about itself."""
    return {
        "program": f"depthreg {__version__}",
        "network": type(network).__name__,
        "checkpoint": checkpoint,
        "precision": precision,
        "size": f"{size.width}x{size.height}" if size else f"any from {MIN_SIDE_PX} to {MAX_EXPORTED_SIDE_PX} px",
        "inputs": INPUTS,
        "outputs": OUTPUTS,
    }


@torch.no_grad()
def export(
    network: nn.Module, path: Path, kind: str, precision: str, size: Size | None, description: dict[str, Any]
) -> None:
    """Write a network on the CPU to a file.

    Args:
        network: Any of `depthreg.networks`.
        path: Where to.
        kind: One of `SUFFIXES`.
        precision: One of `PRECISIONS`; int8 for onnx alone.
        size: The only one that it will take; without, any, but not as pt2.
        description: Goes into the file as JSON.
    """
    text, example = json.dumps(description), made_frame(size or Size(96, 160))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what depends on Python values doesn't depend on the frame
        if kind == "onnx":
            _write_onnx(FrameNetwork(network), path, example, size is None, text)
            {"fp32": lambda _: None, "fp16": _halve, "int8": _quantise}[precision](path)
            return
        frame_network = FrameNetwork(network, half=precision == "fp16")
        if kind == "torchscript":
            torch.jit.save(torch.jit.trace(frame_network, example, check_trace=False), path, {METADATA: text})
        else:
            program = torch.export.export(frame_network, example, strict=False)
            torch.export.save(program, path, extra_files={METADATA: text})


def _write_onnx(network: FrameNetwork, path: Path, example: tuple[Tensor, Tensor], any_size: bool, text: str) -> None:
    """By tracing: torch.export would settle at how small a size each halving of a frame ends."""
    import onnx

    sides = {0: "height", 1: "width"}
    maps = [name for name, what in (INPUTS | OUTPUTS).items() if "(height, width" in what]
    torch.onnx.export(
        with_rowwise_norms(network),
        example,
        str(path),
        input_names=list(INPUTS),
        output_names=list(OUTPUTS),
        dynamic_axes=dict.fromkeys(maps, sides) if any_size else None,
        opset_version=OPSET,
        dynamo=False,
    )
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {METADATA: text})
    for value in (*model.graph.input, *model.graph.output):
        value.doc_string = (INPUTS | OUTPUTS)[value.name]
    onnx.save(model, path)


def _halve(path: Path) -> None:
    """Convolve in 16 bits, in an ONNX file; all else stays in 32, as under autocast."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    model = onnx.load(path)
    weights = {value.name: value for value in model.graph.initializer}
    nodes: list[onnx.NodeProto] = []
    for node in model.graph.node:
        if node.op_type != "Conv":
            nodes.append(node)
            continue
        inputs, answer = list(node.input), node.output[0]
        for place, name in enumerate(inputs):
            if name not in weights:  # the frame's, or another name for a weight
                inputs[place] = f"{answer}_{place}_half"
                nodes.append(helper.make_node("Cast", [name], [inputs[place]], to=TensorProto.FLOAT16))
            elif weights[name].data_type != TensorProto.FLOAT16:
                halved = numpy_helper.to_array(weights[name]).astype(np.float16)
                weights[name].CopyFrom(numpy_helper.from_array(halved, name))
        half = helper.make_node("Conv", inputs, [f"{answer}_half"], name=node.name)
        half.attribute.extend(node.attribute)
        nodes += [half, helper.make_node("Cast", half.output, [answer], to=TensorProto.FLOAT)]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def _quantise(path: Path) -> None:
    """Convolve in 8 bits, in an ONNX file: weights from here on, activations by each frame's own range.

    Ranges that are fixed beforehand would need frames like those to come, and depth's differ by a hundred.
    """
    from onnxruntime.quantization import QuantType, quantize_dynamic  # type: ignore[import-untyped, import-not-found, unused-ignore]

    logging.disable(logging.WARNING)  # it recommends a preparation that changes nothing here
    try:
        quantize_dynamic(path, path, op_types_to_quantize=["Conv"], weight_type=QuantType.QUInt8)
    finally:
        logging.disable(logging.NOTSET)


def made_frame(size: Size, seed: int = 0) -> tuple[Tensor, Tensor]:
    """`INPUTS` of a slope, 4 to 40 m away, of which one pixel in twenty is known, in noisy colour."""
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.randint(0, 256, (*size, 3), generator=generator, dtype=torch.uint8)
    slope_m = torch.linspace(40, 4, size.height)[:, None].expand(size)
    return rgb, slope_m * (torch.rand(size, generator=generator) < 0.05)


Exported = Callable[[Tensor, Tensor], dict[str, np.ndarray]]


def open_exported(path: Path, kind: str, threads: int = 0) -> Exported:
    """An exported file as a function from `INPUTS` to `OUTPUTS` by their names.

    Args:
        path: What `write` wrote.
        kind: One of `SUFFIXES`.
        threads: Of ONNX Runtime; as it likes where 0.
    """
    if kind == "onnx":
        import onnxruntime  # type: ignore[import-untyped, import-not-found, unused-ignore]

        settings = onnxruntime.SessionOptions()
        settings.intra_op_num_threads = threads
        session = onnxruntime.InferenceSession(path, settings, providers=["CPUExecutionProvider"])
        return lambda rgb, depth_m: dict(
            zip(
                OUTPUTS,
                session.run(list(OUTPUTS), dict(zip(INPUTS, (rgb.numpy(), depth_m.numpy()), strict=True))),
                strict=True,
            )
        )
    module: Any = torch.jit.load(path) if kind == "torchscript" else torch.export.load(path).module()

    @torch.no_grad()
    def run(rgb: Tensor, depth_m: Tensor) -> dict[str, np.ndarray]:
        return {name: value.numpy() for name, value in zip(OUTPUTS, module(rgb, depth_m), strict=True)}

    return run


@torch.no_grad()
def difference_m(network: FrameNetwork, exported: Exported, size: Size) -> float:
    """How far the exported depths of a made frame are from PyTorch's, at most."""
    frame = made_frame(size, seed=1)
    return float(np.abs(exported(*frame)["depth_m"] - network(*frame)[0].numpy()).max())
