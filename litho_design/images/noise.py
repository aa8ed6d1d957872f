"""White noise of a measured map, and how far a score moves within what a measurement allows."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np

from litho_data.foundation.results import Record

T = TypeVar("T")

# Draws of a measurement's own uncertainty: their rms is known to 25 %.
DRAWS = 8
# Frequencies along both axes, cycles/px, beyond which neither prints nor images have structure left.
_NOISE_BAND = 0.35


def white_noise(values: np.ndarray) -> float:
    """Standard deviation of the white noise in a map (ny, nx), from its highest frequencies."""
    ny, nx = values.shape
    window = np.hanning(ny)[:, None] * np.hanning(nx)
    power = np.abs(np.fft.fft2(values * window)) ** 2 / np.square(window).sum()
    high = (np.abs(np.fft.fftfreq(ny)) > _NOISE_BAND)[:, None] & (np.abs(np.fft.fftfreq(nx)) > _NOISE_BAND)
    return float(np.sqrt(power[high].mean()))


def uncertainties(score: Callable[[T], Record], measured: Record, variants: Iterable[T]) -> dict[str, float]:
    """Rms change of every figure of ``measured`` over variants of the measurement: one standard deviation."""
    figures = measured.model_dump(exclude_none=True)
    changes = [
        {name: value - figures[name] for name, value in score(variant).model_dump(exclude_none=True).items()}
        for variant in variants
    ]
    return {name: float(np.sqrt(np.mean([change[name] ** 2 for change in changes]))) for name in figures}
