"""Set the precision of the matrix products in networks, and warn if a lower precision is slower on this
processor.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Literal

import torch

Precision = Literal["float32", "bfloat16"]

# Names that PyTorch gives to the processor features that multiply in bfloat16: two of x86, two of ARM.
_UNITS = ("amx_bf16", "avx512_bf16", "bf16", "sve_bf16")


@contextmanager
def network_precision(precision: Precision, device_type: str) -> Iterator[None]:
    """Context manager for a block in which networks multiply matrices in the given precision. Heights and
    blurs stay in float32.
    """
    with torch.autocast(device_type, torch.bfloat16, enabled=precision == "bfloat16"):
        yield


def warn_where_slower(precision: Precision, device_type: str) -> None:
    """Warn on stderr that float32 is faster if this processor only emulates the given precision. The warning
    is printed at most once per process.
    """
    if precision != "float32" and device_type == "cpu" and not has_bfloat16_unit():
        _say("networks run in bfloat16, but this processor has no bfloat16 unit: float32 is faster")


def has_bfloat16_unit() -> bool:
    """Return True if this processor multiplies in bfloat16. Other processors emulate it in float32."""
    known = getattr(torch.cpu, "get_capabilities", None)
    # Older versions of PyTorch cannot list the features of a processor. A bfloat16 unit is then assumed.
    return known is None or any(known().get(unit) for unit in _UNITS)


@cache
def _say(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)
