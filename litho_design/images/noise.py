"""Estimate the white noise of a measured map, and how the uncertainty of a measurement propagates to its
scores.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from scipy.optimize import nnls

from litho_data.foundation.results import Record

T = TypeVar("T")

# Number of random draws within the uncertainty of a measurement. With this number, their rms is known to
# 25 %.
DRAWS = 8
# Beyond this frequency (cycles/px) along both axes, neither prints nor images have structure.
_NOISE_BAND = 0.35


def white_noise(values: np.ndarray) -> float:
    """Return the standard deviation of the white noise in a map of shape (ny, nx), from its highest
    frequencies.
    """
    window, high = _window_and_band(values.shape)
    power = np.abs(np.fft.fft2(values * window)) ** 2 / np.square(window).sum()
    return float(np.sqrt(power[high].mean()))


def noise_of_light(counts: np.ndarray) -> tuple[float, float]:
    """Return two standard deviations of the noise in a photograph of shape (ny, nx): that of the noise in the
    dark, and that of the noise proportional to the light, relative to the light.

    The second value includes speckle.

    The variance at the highest frequencies is fitted by dark^2 + (share * light)^2, where ``dark`` and
    ``share`` are the two standard deviations.
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
    """Return a Hann window for a map, and a mask of the frequencies that contain only noise."""
    along = [np.abs(np.fft.fftfreq(count)) > _NOISE_BAND for count in shape]
    return np.outer(*map(np.hanning, shape)), np.logical_and.outer(*along)


def uncertainties(score: Callable[[T], Record], measured: Record, variants: Iterable[T]) -> dict[str, float]:
    """Return the standard deviation of every figure in ``measured``, computed as the rms change of the figure
    over variants of the measurement.
    """
    return {name: float(np.sqrt(np.mean(found**2))) for name, found in _changes(score, measured, variants)}


def freed_of_noise(
    score: Callable[[T], Record], measured: Record, variants: Iterable[T]
) -> tuple[dict[str, float], dict[str, float]]:
    """Correct figures for the bias that noise causes. Return the corrected figures, and the standard
    deviation of each.

    The measurement already contains noise, and each variant adds the same amount of noise again. The mean
    change of a figure over the variants therefore estimates how much the noise in the measurement changed the
    figure (bias correction by bootstrap, Efron and Tibshirani 1993, chapter 10). The variants come in pairs
    with opposite noise, so figures that are linear in the noise are not corrected.
    """
    changes = dict(_changes(score, measured, variants))
    figures = {name: getattr(measured, name) - float(found.mean()) for name, found in changes.items()}
    return figures, {name: float(found.std()) for name, found in changes.items()}


def _changes(
    score: Callable[[T], Record], measured: Record, variants: Iterable[T]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield how every figure in ``measured`` changes over variants of the measurement."""
    scores = [score(variant).model_dump(exclude_none=True) for variant in variants]
    for name, value in measured.model_dump(exclude_none=True).items():
        yield name, np.array([one[name] for one in scores]) - value
