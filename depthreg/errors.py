"""The one error that a user's input can cause, and arguments that cause it."""

import argparse
from typing import NoReturn


class InputError(ValueError):
    """Bad input: one sentence that names the file or key and what was expected.

    The command line prints it without a traceback and exits with status 2.
    """


class ArgumentParser(argparse.ArgumentParser):
    """Argparse that complains in one sentence, like everything else here."""

    def error(self, message: str) -> NoReturn:
        """Raise what argparse would print with the usage before it."""
        raise InputError(message)
