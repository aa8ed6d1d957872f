"""Fast writer of the measured prints' scan format: metres, tabs, CRLF, three-digit exponents."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError

_TEXT_WIDTH = len("-1.2345e-007\t")


def write_text_matrix(path: str | Path, height_um: np.ndarray) -> None:
    """Write heights with five significant digits, one line per row.

    Args:
        height_um: finite heights below 10 m, µm, shape (ny, nx).

    Raises:
        InputError: a value that the format cannot hold.
    """
    if not np.isfinite(height_um).all():
        raise InputError("height in a text matrix", got="NaN or infinity", wanted="finite numbers")
    mantissa, exponent = _five_digits(np.abs(height_um) * 1e-6)
    text = np.empty((*height_um.shape, _TEXT_WIDTH + 1), np.uint8)
    text[:] = np.frombuffer(b"-0.0000e-000\t\n", np.uint8)
    for place, power in zip((1, 3, 4, 5, 6), (10000, 1000, 100, 10, 1), strict=True):
        text[..., place] = ord("0") + mantissa // power % 10
    text[..., 8] = np.where(exponent < 0, ord("-"), ord("+"))
    for place, power in zip((9, 10, 11), (100, 10, 1), strict=True):
        text[..., place] = ord("0") + np.abs(exponent) // power % 10
    text[:, -1, 12] = ord("\r")
    keep = np.ones(text.shape, bool)
    keep[..., 0] = height_um < 0
    keep[:, :-1, 13] = False
    Path(path).write_bytes(text[keep].tobytes())


def _five_digits(magnitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(integer mantissa 10000…99999, decimal exponent); zero has mantissa and exponent 0."""
    positive = magnitude > 0
    exponent = np.floor(np.log10(magnitude, where=positive, out=np.zeros_like(magnitude))).astype(int)
    mantissa = np.rint(magnitude * 10.0 ** (4 - exponent)).astype(int)
    carried = mantissa >= 100000
    return np.where(carried, 10000, mantissa), np.where(positive, exponent + carried, 0)
