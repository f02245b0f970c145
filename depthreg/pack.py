"""`depthreg pack`: a rendered data set as tar files, to be streamed by many machines."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import track

from depthreg.data.rendered import FolderStore
from depthreg.data.streaming import pack_frames
from depthreg.errors import ArgumentParser, InputError


def main(argv: Sequence[str]) -> int:
    """Run `depthreg pack SOURCE TARGET`."""
    parser = ArgumentParser("depthreg pack", description="Put a data set into tar files to stream from.")
    parser.add_argument("source", type=Path, help="folder of `depthreg render`")
    parser.add_argument("target", type=Path, help="new folder; an interrupted run goes on there")
    parser.add_argument("--frames-per-tar", type=int, default=100, help="default: 100, some 300 MB at 1242x375")
    options = parser.parse_args(argv)
    if options.frames_per_tar < 1:
        raise InputError(f"--frames-per-tar {options.frames_per_tar}: expected a whole number, at least 1")
    count = FolderStore(options.source).description["config"]["count"]
    console = Console(stderr=True)
    packing = pack_frames(options.source, options.target, options.frames_per_tar)
    for _ in track(packing, "Packing", total=count, console=console, disable=not console.is_terminal, transient=True):
        pass
    Console().print(f"{count} frames in {options.target}", soft_wrap=True)
    return 0
