"""Check names that come from files of unknown origin. Only plain names may become part of a path."""

import re
from typing import Annotated

from pydantic import AfterValidator

from litho_data.foundation.errors import InputError

# Longest allowed name, in bytes. File systems allow 255 bytes; the difference is left for suffixes.
_LONGEST_BYTES = 200
_NO_NAME = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]')


def is_plain_name(name: object) -> bool:
    """Return whether a name is plain. A plain name is a valid file name on every system. It is not a
    path, a hidden file or a command-line option.
    """
    return (
        isinstance(name, str)
        and 0 < len(name.encode("utf-8", "replace")) <= _LONGEST_BYTES
        and not _NO_NAME.search(name)
        and name[0] not in ".-~ "
        and name[-1] not in ". "
        # This excludes surrogates, which stand for bytes that could not be decoded.
        and name.isprintable()
    )


def require_plain_name(what: str, name: str) -> str:
    """Return the name if it is plain.

    Raises:
        InputError: the name is not plain, so a path that contains the name could lead to another folder.
    """
    if not is_plain_name(name):
        raise InputError(what, got=repr(name)[:80], wanted="a plain name, without a path")
    return name


def _plain(name: str) -> str:
    if not is_plain_name(name):
        raise ValueError("wanted a plain name, without a path")
    return name


PlainName = Annotated[str, AfterValidator(_plain)]
