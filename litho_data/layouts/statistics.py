"""Compute the statistics of a set of layouts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.foundation.results import Result

_FEWEST_PX = 64
_BIN_PER_UM = 0.05


class LayoutStatistics(Result):
    """Statistics of a set of layouts, pooled over all layouts.

    Args:
        level_share: share of the pixels that have each level; the shares sum to 1.
        jump_share: share of the pairs of neighbouring pixels (along x and y) whose levels differ by 0, 1, 2
            …; the shares sum to 1.
        frequency_per_um: centres of the radial frequency bins, cycles/µm.
        power_share: share of the spectral power in each frequency bin; the shares sum to 1. The mean level is
            subtracted first, so its power is not included.
        settings: settings with which ``write_layout_set`` made the layouts; None if it did not make them.
    """

    SCHEMA: ClassVar[str] = "litho-data/layouts/2"
    FILE_NAME: ClassVar[str] = "layouts.json"

    count: int
    levels: int
    pitch_um: float
    level_share: list[float]
    jump_share: list[float]
    frequency_per_um: list[float]
    power_share: list[float]
    settings: dict[str, Any] | None = None


def layout_statistics(layouts: Iterable[Array | Path], *, levels: int, pitch_um: float) -> LayoutStatistics:
    """Compute statistics pooled over all layouts, with only one layout in memory at a time.

    Args:
        layouts: arrays of levels, each of shape (ny, nx), or paths of layout files.
        levels: number of levels L.
        pitch_um: pixel pitch, µm.

    Raises:
        InputError: there is no layout, a level is L or more, or a layout is smaller than 64 x 64 px.
    """
    levels_count = np.zeros(levels, np.int64)
    jumps_count = np.zeros(levels, np.int64)
    powers: list[Array] = []
    for layout in layouts:
        level = _checked(layout, levels)
        levels_count += np.bincount(level.ravel(), minlength=levels)
        for axis in (0, 1):
            jumps = np.abs(np.diff(level.astype(int), axis=axis)).ravel()
            jumps_count += np.bincount(jumps, minlength=levels)
        powers.append(_radial_power(level, pitch_um))
    if not powers:
        raise InputError("layouts", got="none", wanted="at least one")
    power = np.mean(powers, axis=0)
    return LayoutStatistics(
        count=len(powers),
        levels=levels,
        pitch_um=pitch_um,
        level_share=(levels_count / levels_count.sum()).tolist(),
        jump_share=(jumps_count / jumps_count.sum()).tolist(),
        frequency_per_um=((np.arange(power.size) + 0.5) * _BIN_PER_UM).tolist(),
        power_share=(power / (power.sum() or 1.0)).tolist(),
    )


def _checked(layout: Array | Path, levels: int) -> Array:
    if isinstance(layout, Path):
        from litho_data.readers import read_layout

        layout = read_layout(layout)
    if layout.max() >= levels:
        raise InputError("level in a layout", got=int(layout.max()), wanted=f"0 to {levels - 1}")
    if min(layout.shape) < _FEWEST_PX:
        raise InputError(
            "size of a layout", got=f"{layout.shape} px", wanted=f"at least {_FEWEST_PX} x {_FEWEST_PX} px"
        )
    return layout


def _radial_power(level: Array, pitch_um: float) -> Array:
    """Subtract the mean from a layout, and return the share of its spectral power in each radial frequency
    bin. The shares sum to 1.

    The bins extend to the Nyquist frequency along an axis; the last bin includes all higher frequencies,
    which occur in the corners of the spectrum.
    """
    window = np.outer(np.hanning(level.shape[0]), np.hanning(level.shape[1]))
    weighted = (level - (level * window).sum() / window.sum()) * window
    spectrum = np.abs(np.fft.fft2(weighted)) ** 2
    frequency = np.hypot(
        np.fft.fftfreq(level.shape[0], pitch_um)[:, None], np.fft.fftfreq(level.shape[1], pitch_um)[None, :]
    )
    bins = (frequency / _BIN_PER_UM).astype(int).ravel()
    limit = int(np.ceil(0.5 / pitch_um / _BIN_PER_UM))
    power = np.bincount(np.minimum(bins, limit - 1), weights=spectrum.ravel(), minlength=limit)
    return power / (power.sum() or 1.0)
