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

# Number of variants of a measurement that are drawn at random within its uncertainty. The rms change over
# this number of variants is known to 25 %.
DRAWS = 8
# The errors of a print are correlated over long distances. A fit to the print therefore absorbs more of these
# errors than it would absorb of independent errors, by this factor (found with ``benchmarks.coverage``).
HIDDEN = 1.5
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
    score, and is subtracted (bias correction by bootstrap, Efron and Tibshirani 1993, chapter 10). Each
    variant in ``elsewhere`` is a measurement that the registration and the levelling cannot distinguish from
    the best fit. Fits make a print look more like the expected one than it is, so the mean change of these
    variants is added. Variants come in pairs with opposite signs, so the mean change of a score that is
    linear in the variation is zero.
    """
    noise, place = (dict(_changes(score, measured, variants)) for variants in (noisier, elsewhere))
    figures = {
        name: getattr(measured, name) - float(noise[name].mean()) + float(place[name].mean())
        for name in noise
    }
    return figures, {name: float(np.hypot(noise[name].std(), HIDDEN * place[name].std())) for name in noise}


def _changes(
    score: Callable[[T], Record], measured: Record, variants: Iterable[T]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name of every score in ``measured``, and the changes of this score over the variants of the
    measurement.
    """
    scores = [score(variant).model_dump(exclude_none=True) for variant in variants]
    for name, value in measured.model_dump(exclude_none=True).items():
        yield name, np.array([one[name] for one in scores]) - value
