"""The one error that a user's input can cause."""


class InputError(ValueError):
    """Bad input: one sentence that names the file or key and what was expected.

    The command line prints it without a traceback and exits with status 2.
    """
