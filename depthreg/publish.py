"""`depthreg publish`: the weights of a run in a small file that others can load, with where they come from."""

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from rich.console import Console

from depthreg.checkpoint import PUBLISHED_SUFFIX, load_network, read_checkpoint, write_published
from depthreg.errors import ArgumentParser, InputError
from depthreg.run_folder import read_record

_ORIGIN = ("id", "started", "overrides", "git", "versions", "hardware")


def main(argv: Sequence[str]) -> int:
    """Run `depthreg publish CHECKPOINT OUT`."""
    parser = ArgumentParser(
        "depthreg publish", description="Write a checkpoint's weights in half precision, with how they were trained."
    )
    parser.add_argument("checkpoint", type=Path, help="runs/.../full/last.ckpt, in the folder of its run")
    parser.add_argument("out", type=Path, help=f"new {PUBLISHED_SUFFIX} file")
    options = parser.parse_args(argv)
    if options.out.suffix != PUBLISHED_SUFFIX or options.out.exists():
        raise InputError(f"{options.out}: expected a new file that ends in {PUBLISHED_SUFFIX}")
    if not options.out.absolute().parent.is_dir():
        raise InputError(f"{options.out} can't be written: expected {options.out.parent} to be a folder")
    network = load_network(options.checkpoint)
    record = read_record(options.checkpoint.absolute().parents[1])
    checkpoint = read_checkpoint(options.checkpoint)
    stage = {"stage": checkpoint["depthreg"]["stage"], "epoch": checkpoint["epoch"], "step": checkpoint["global_step"]}
    write_published(options.out, network, {**{key: record[key] for key in _ORIGIN}, **stage})
    content = options.out.read_bytes()
    size = f"{sum(parameter.numel() for parameter in network.parameters()) / 1e6:.2f} M parameters"
    checksum = sha256(content).hexdigest()
    Console().print(f"{options.out}: {size}, {len(content) / 1e6:.1f} MB, sha256 {checksum}", soft_wrap=True)
    return 0
