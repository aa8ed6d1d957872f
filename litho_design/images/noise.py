"""Estimate the white noise of a measured map, and the uncertainty of a score that the measurement's
uncertainty causes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from scipy.optimize import nnls

from litho_data.foundation.results import Record

T = TypeVar("T")

# Number of random draws within a measurement's uncertainty; with so many, their rms is known to 25 %.
DRAWS = 8
# Beyond this frequency (cycles/px) along both axes, neither prints nor images have structure.
_NOISE_BAND = 0.35


def white_noise(values: np.ndarray) -> float:
    """Return the standard deviation of the white noise in a map (ny, nx), from its highest frequencies."""
    window, high = _window_and_band(values.shape)
    power = np.abs(np.fft.fft2(values * window)) ** 2 / np.square(window).sum()
    return float(np.sqrt(power[high].mean()))


def noise_of_light(counts: np.ndarray) -> tuple[float, float]:
    """Return the noise of a photograph (ny, nx): its sd in the dark, and its sd as a share of the light.

    The second part covers, for example, speckle, which is proportional to the light.

    The variance of the highest frequencies is fitted as (sd in the dark)^2 + (share)^2 times the squared
    light.
    """
    from scipy.ndimage import gaussian_filter

    window, high = _window_and_band(counts.shape)
    noise = np.fft.ifft2(np.fft.fft2(counts * window) * high).real / np.sqrt(high.mean())
    light = gaussian_filter(counts.astype(float).clip(0), 2.0)
    columns = np.square(np.stack([window, window * light], axis=-1)).reshape(-1, 2)
    scale = columns.max(0)
    (dark, share), _ = nnls(columns / scale, np.square(noise).ravel())
    return float(np.sqrt(dark / scale[0])), float(np.sqrt(share / scale[1]))


def _window_and_band(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the Hann window of a map, and the mask of the frequencies that contain only noise."""
    along = [np.abs(np.fft.fftfreq(count)) > _NOISE_BAND for count in shape]
    return np.outer(*map(np.hanning, shape)), np.logical_and.outer(*along)


def uncertainties(score: Callable[[T], Record], measured: Record, variants: Iterable[T]) -> dict[str, float]:
    """Return the standard deviation of every figure of ``measured``: its rms change over variants of the
    measurement.
    """
    return {name: float(np.sqrt(np.mean(found**2))) for name, found in _changes(score, measured, variants)}


def freed_of_noise(
    score: Callable[[T], Record], measured: Record, variants: Iterable[T]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return figures corrected for the bias from noise, and the standard deviation of each figure.

    The measurement already contains noise, and the variants add as much again. Their mean change therefore
    estimates the change that the measurement's own noise caused (bias correction by bootstrap, Efron and
    Tibshirani 1993, chapter 10). Variants come in pairs of opposite noise, so a figure that is linear in the
    noise is not changed.
    """
    changes = dict(_changes(score, measured, variants))
    figures = {name: getattr(measured, name) - float(found.mean()) for name, found in changes.items()}
    return figures, {name: float(found.std()) for name, found in changes.items()}


def _changes(
    score: Callable[[T], Record], measured: Record, variants: Iterable[T]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the changes of every figure of ``measured`` over variants of the measurement."""
    scores = [score(variant).model_dump(exclude_none=True) for variant in variants]
    for name, value in measured.model_dump(exclude_none=True).items():
        yield name, np.array([one[name] for one in scores]) - value
