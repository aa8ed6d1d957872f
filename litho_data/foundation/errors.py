"""Define InputError and functions that raise it. InputError is the only exception of the project whose
message is written for users.
"""

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

_MANY = 12
# Messages show only this many characters of the given value, which can have any length.
_LONGEST = 240


class InputError(ValueError):
    """An error for bad input. Its one-line message says what is wrong, what was given and what is allowed,
    and may add a hint.

    All commands print the message without a traceback and exit with code 2. Every other exception is a defect
    of this project, unless the system caused it, for example a full disk. If ``got`` is an exception, the
    message states the cause of this exception in plain words.
    """

    def __init__(self, what: str, *, got: object = None, wanted: object = None, hint: str = ""):
        parts = [what]
        if got is not None:
            text = said(got) if isinstance(got, Exception) else str(got)
            parts.append(f"got {text if len(text) <= _LONGEST else text[:_LONGEST] + '…'}")
        if wanted is not None:
            parts.append(f"wanted {wanted}")
        message = ", ".join(parts)
        super().__init__(" ".join(f"{message}; {hint}".split()) if hint else " ".join(message.split()))


@contextmanager
def about(what: str) -> Iterator[None]:
    """Prepend ``what`` to the message of any InputError that the ``with`` block raises."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{what}: {error}") from error


@contextmanager
def damaged(what: str) -> Iterator[None]:
    """If the content of a file causes an error in the ``with`` block, raise an InputError which says that the
    file is damaged. Use this function for files that a program wrote and that somebody may have edited later.

    Raises:
        InputError: the content of the file causes an error, such as a missing key, text instead of a number,
            or invalid JSON.
    """
    try:
        yield
    except InputError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        raise InputError(f"{what} is damaged", got=f"{type(error).__name__}: {said(error)}") from error


def said(error: Exception) -> str:
    """Return the reason for an error in plain words instead of Python's own message."""
    if isinstance(error, UnicodeDecodeError):
        return "bytes that are not text"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error).partition("\n")[0] or type(error).__name__


def require_known(what: str, got: str, known: Iterable[str]) -> None:
    """Refuse a name that is not among ``known``. The arguments are those of `unknown_name`.

    Raises:
        InputError: the name is not known.
    """
    if got not in known:
        raise unknown_name(what, got, known)


def unknown_name(
    what: str, got: object, known: Iterable[str], hint: str = "", *, also: str = ""
) -> InputError:
    """Return the error for an unknown name. If a known name is similar, the hint suggests the nearest one.

    Args:
        what: what the name stands for, such as "model".
        got: the unknown name.
        known: all known names.
        hint: what to suggest if no known name is similar.
        also: what else could have been given instead of a name, such as "an image file".
    """
    names = list(known)
    near = difflib.get_close_matches(str(got), names)
    # A long list of names does not help a user who misspelt one of them, so only the nearest is suggested.
    shown = [] if near and len(names) > _MANY else names
    wanted = " or ".join(filter(None, (", ".join(shown), also)))
    return InputError(
        what, got=repr(str(got)), wanted=wanted or None, hint=f"did you mean {near[0]}?" if near else hint
    )
