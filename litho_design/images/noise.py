"""Estimate the white noise of a measured map, and how the uncertainty of a measurement propagates to its
scores.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from scipy.optimize import nnls

from litho_data.foundation.results import Record

T = TypeVar("T")

# Number of random draws of the noise. The rms change of a score over this number of draws is known to 25 %.
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
    """Return the standard deviations of two kinds of noise in a photograph of shape (ny, nx). The first value
    is that of the noise in the dark, in counts. The second is that of the noise proportional to the light, as
    a share of the light.

    The second kind includes speckle.

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


def estimated(
    score: Callable[[T], Record], measured: Record, noisier: Iterable[T], elsewhere: Iterable[T]
) -> tuple[dict[str, float], dict[str, float]]:
    """Correct the scores of a measurement for noise, and for the errors of the print that the registration
    and the levelling have absorbed. Return two dicts, keyed by the name of the score: the corrected scores,
    and their standard deviations.

    The measurement already contains noise, and each variant in ``noisier`` adds the same amount of noise
    again. The mean change of a score over these variants therefore estimates how much noise changed the
    score, and is subtracted (bias correction by bootstrap, Efron and Tibshirani 1993, chapter 10).

    The variants in ``elsewhere`` are measurements that the registration and the levelling cannot distinguish
    from the best fit. They come in pairs. In a pair, one independent parameter differs by plus and minus its
    standard deviation. Fits make a print look more like the expected one than it is, so the mean change of a
    score is added. Mean and variance are those of a score that is quadratic in each normally distributed
    parameter (JCGM 100:2008, 5.1.2 with the note on higher orders).
    """
    noise, place = (dict(_changes(score, measured, variants)) for variants in (noisier, elsewhere))
    figures, spread = {}, {}
    for name, of_noise in noise.items():
        plus, minus = place[name].reshape(-1, 2).T
        linear, square = (plus - minus) / 2, (plus + minus) / 2
        figures[name] = getattr(measured, name) - float(of_noise.mean()) + float(square.sum())
        spread[name] = math.sqrt(of_noise.var() + np.sum(linear**2 + 2 * square**2))
    return figures, spread


def _changes(
    score: Callable[[T], Record], measured: Record, variants: Iterable[T]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name of every score in ``measured``, and the changes of this score over the variants of the
    measurement.
    """
    scores = [score(variant).model_dump(exclude_none=True) for variant in variants]
    for name, value in measured.model_dump(exclude_none=True).items():
        yield name, np.array([one[name] for one in scores]) - value
