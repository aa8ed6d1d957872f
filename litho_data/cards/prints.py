"""The print that an id belongs to, by the card's expression, which may be slow beyond all patience."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Sequence

from litho_data.foundation.errors import InputError

_LONGEST_S = 10.0
_MATCH = """
import json, re, sys
pattern, ids = json.load(sys.stdin)
json.dump([found and found["print"] for found in (re.fullmatch(pattern, one) for one in ids)], sys.stdout)
"""


def prints_of(ids: Sequence[str], pattern: str | None) -> list[str | None]:
    """The group ``print`` of the expression for each whole id, None where it does not match.

    Without an expression every id is a print of its own. Nothing stops an expression that tries all ways to
    repeat repetitions, so one with any repetition runs in a process of its own.

    Raises:
        InputError: no result after 10 s.
    """
    if pattern is None:
        return list(ids)
    if not set("*+{?") & set(pattern.replace("(?", "(")):
        return [found and found["print"] for found in (re.fullmatch(pattern, one) for one in ids)]
    try:
        # Isolated and without site packages, which would take ten times as long.
        done = subprocess.run(
            [sys.executable, "-ISc", _MATCH],
            input=json.dumps([pattern, list(ids)]),
            capture_output=True,
            text=True,
            timeout=_LONGEST_S,
            check=True,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"[ids] print = {pattern!r}",
            got=f"no result after {_LONGEST_S:.0f} s",
            wanted="an expression without repetitions inside repetitions",
        ) from error
    return json.loads(done.stdout)
