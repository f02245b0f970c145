"""The `depthreg` command: one dictionary of subcommands."""

import errno
import importlib
import sys
from collections.abc import Sequence

from depthreg import __version__
from depthreg.application import run_application
from depthreg.errors import InputError, RunError

COMMANDS = {  # name -> what it does; depthreg/NAME.py is how
    "train": "walk the curriculum, or one stage of it",
    "evaluate": "score a checkpoint beside the classical baselines",
    "compare": "see what changing one thing did, over many runs",
    "complete": "complete and register your own files",
    "demo": "try it in the browser",
    "gallery": "see what each stage of the curriculum measures",
    "render": "write a data set of a synthetic world",
    "export": "write a network for ONNX Runtime, TorchScript or torch.export",
    "publish": "write a checkpoint's weights in a small file to share",
    "pack": "put such a data set into tar files to stream from",
}
APPLICATIONS = ("train", "evaluate", "gallery", "render")  # Hydra composes them; the others parse their own arguments

_OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EIO}


def usage() -> str:
    """What `depthreg --help` prints."""
    commands = "\n".join(f"  {name:<10} {what}" for name, what in COMMANDS.items())
    return f"""usage: depthreg COMMAND ...

Align colour with sparse depth and complete the depth.

commands:
{commands}

options:
  --help     `depthreg COMMAND --help` says more
  --version"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; bad input is one sentence on standard error and exit status 2."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0
    if arguments[0] == "--version":
        print(f"depthreg {__version__}")
        return 0
    name, *rest = arguments
    if name not in COMMANDS:
        print(f"depthreg: unknown command '{name}': expected one of {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    try:
        if name in APPLICATIONS:
            return run_application(name, rest)
        return importlib.import_module(f"depthreg.{name}").main(rest)
    except InputError as error:
        print(f"depthreg {name}: {error}", file=sys.stderr)
        return 2
    except RunError as error:
        print(f"depthreg {name}: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        if error.errno not in _OF_THE_DISK:
            raise
        print(f"depthreg {name}: {error.filename or 'a file'} can't be written: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"depthreg {name}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
