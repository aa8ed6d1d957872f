"""Writing heights to files that others read: Gwyddion Simple Field and NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file

SUFFIXES = (".gsf", ".npy")
_UM_PER_M = 1e6
_ITEM = 4


def write_heights(
    path: str | Path,
    height_um: np.ndarray,
    *,
    pitch_um: tuple[float, float] | None,
    title: str = "",
    header: Mapping[str, str] | None = None,
) -> Path:
    """Write a height map; the suffix says how.

    ``.gsf`` holds float32 metres with size, title and header, and opens in Gwyddion; ``.npy`` holds
    float64 µm and nothing else. Missing pixels are NaN in both.

    Raises:
        InputError: another suffix.
    """
    file = Path(path)
    if file.suffix not in SUFFIXES:
        raise InputError(f"{file}: file type", got=repr(file.suffix), wanted=" or ".join(SUFFIXES))
    with atomic_file(file) as temporary, temporary.open("wb") as stream:
        if file.suffix == ".npy":
            np.save(stream, np.asarray(height_um, dtype=np.float64))
        else:
            stream.write(_gsf(height_um, pitch_um, title, header or {}))
    return file


def _gsf(
    height_um: np.ndarray, pitch_um: tuple[float, float] | None, title: str, header: Mapping[str, str]
) -> bytes:
    ny, nx = height_um.shape
    fields = {"XRes": str(nx), "YRes": str(ny), "ZUnits": "m", "Title": title}
    if pitch_um is not None:
        size_m = {"XReal": nx * pitch_um[1] / _UM_PER_M, "YReal": ny * pitch_um[0] / _UM_PER_M}
        fields |= {"XYUnits": "m"} | {key: repr(float(size)) for key, size in size_m.items()}
    lines = [f"{key} = {' '.join(value.split())}" for key, value in {**fields, **header}.items() if value]
    text = "\n".join(["Gwyddion Simple Field 1.0", *lines, ""]).encode()
    return text + b"\0" * (_ITEM - len(text) % _ITEM) + (height_um / _UM_PER_M).astype("<f4").tobytes()
