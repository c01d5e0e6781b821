"""The one exception that means "what the user gave cannot be used"."""


class InputError(ValueError):
    """Bad input. The message is one sentence that names the file or argument, what was expected and what came.

    The command line prints the message alone and exits with code 2; a library caller sees a ``ValueError``.
    """
