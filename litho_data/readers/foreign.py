"""The door to foreign parsers: whatever they raise, log or warn about damaged files ends here."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from litho_data.foundation.errors import InputError

_LOGGERS = ("tifffile", "igor2", "SurfaceTopography")
_LONGEST_MESSAGE = 160


@contextmanager
def foreign_parser(path: Path, kind: str) -> Iterator[None]:
    """Run a parser that is not ours; any exception becomes one InputError about the file.

    Parsers of binary formats raise struct, index, key, value, memory, decode, assertion and own
    errors on damaged files, and log to stderr besides; a caller can act on none of it.
    """
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"[:_LONGEST_MESSAGE]
        raise InputError(
            f"cannot read {path} as {kind}", got=reason, hint="the file may be damaged"
        ) from error
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
