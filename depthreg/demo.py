"""`depthreg demo`: a page in the browser that aligns and completes two files."""

import argparse
import os
import signal
import tempfile
import threading
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.progress import track

from depthreg.checkpoint import RELEASED
from depthreg.errors import ArgumentParser, InputError

MAX_UPLOAD = "50mb"  # each file


def main(argv: Sequence[str]) -> int:
    """Run the command until it is interrupted."""
    args = _parse(argv)
    if find_spec("gradio") is None:
        raise InputError("the page needs Gradio: expected pip install 'depthreg[demo]' before it")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does: the folder is removed
    with tempfile.TemporaryDirectory(prefix="depthreg-demo-") as folder:
        try:
            _serve(args, Path(folder))
        except KeyboardInterrupt:
            Console().print("stopped; its files are removed")
    return 0


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="depthreg demo",
        description="Serve a page that aligns and completes two files, on this machine alone.",
        epilog="Uploads stay in a temporary folder, which goes when the page is stopped; nothing is sent anywhere.",
    )
    add = parser.add_argument
    add(
        "--checkpoint",
        type=Path,
        default=RELEASED,
        metavar="CKPT",
        help="weights, of any stage of `depthreg train`; by default the released ones",
    )
    add("--port", type=int, metavar="N", help="by default the first free one from 7860 on")
    add(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="0.0.0.0 lets in every machine that reaches this one, without a password; by default none",
    )
    return parser.parse_args(argv)


def _serve(args: argparse.Namespace, folder: Path) -> None:
    """Serve for ever."""
    from depthreg.model import load

    model = load(args.checkpoint)
    # Gradio reads these when it is imported.
    os.environ |= {"GRADIO_ANALYTICS_ENABLED": "False", "GRADIO_TEMP_DIR": str(folder), "HF_HUB_OFFLINE": "1"}
    from depthreg.demonstration.examples import SCENES, render_example
    from depthreg.demonstration.page import CSS, build_page

    console = Console(stderr=True)
    numbered = track(list(enumerate(SCENES)), "Rendering examples", console=console, transient=True)
    examples = [render_example(scene, folder / f"example-{index}") for index, scene in numbered]
    page = build_page(model, examples, folder)
    try:
        _, url, _ = page.launch(
            server_name=args.host,
            server_port=args.port,
            share=False,
            max_file_size=MAX_UPLOAD,
            prevent_thread_lock=True,
            quiet=True,
            ssr_mode=False,
            run_history=False,
            enable_monitoring=False,
            footer_links=[],
            css=CSS,
        )
    except OSError as error:
        raise InputError(f"--host {args.host}, --port {args.port}: expected an address and a free port") from error
    Console().print(f"{url} shows it; Ctrl-C ends it", soft_wrap=True)
    try:
        threading.Event().wait()
    finally:
        page.close(verbose=False)
