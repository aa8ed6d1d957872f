"""The one exception that users are meant to read."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input: the message is one line that says what is wrong, what was found and wanted, and a hint.

    The command lines print it without a traceback and exit with code 2; every other exception is a defect of
    this project.
    """

    def __init__(self, what: str, *, got: object = None, wanted: object = None, hint: str = ""):
        parts = [what]
        if got is not None:
            parts.append(f"got {got}")
        if wanted is not None:
            parts.append(f"wanted {wanted}")
        message = ", ".join(parts)
        super().__init__(" ".join(f"{message}; {hint}".split()) if hint else " ".join(message.split()))
