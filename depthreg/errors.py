"""The errors that end a command with one sentence instead of a traceback."""

import argparse
from typing import NoReturn


class InputError(ValueError):
    """Bad input: one sentence that names the file or key and what was expected.

    The command line prints it without a traceback and exits with status 2.
    """


class RunError(RuntimeError):
    """What went wrong while working on good input, such as a full disk: one sentence that says what is left intact.

    The command line prints it without a traceback and exits with status 1.
    """


class ArgumentParser(argparse.ArgumentParser):
    """Argparse that complains in one sentence, like everything else here."""

    def error(self, message: str) -> NoReturn:
        """Raise what argparse would print with the usage before it."""
        raise InputError(message)
