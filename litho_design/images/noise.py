"""Estimate the white noise of a measured map, the covariance of a fit to it, and the uncertainty of its
scores.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np
from scipy.optimize import nnls

from litho_data.foundation.results import Record

T = TypeVar("T")

# Number of random draws of the noise. With this number of draws, the rms change of a score is known to 25 %.
DRAWS = 8
# Number of tiles along each side of a map from which the covariance of a fit is computed. Errors of
# the expected map extend over several features, so each tile must contain many features.
_TILES = 4
# Beyond this frequency (cycles/px) along both axes, neither prints nor images have structure.
_NOISE_BAND = 0.35


def white_noise(values: np.ndarray) -> float:
    """Return the standard deviation of the white noise in a map of shape (ny, nx), estimated from the highest
    spatial frequencies of the map.
    """
    window, high = _window_and_band(values.shape)
    power = np.abs(np.fft.fft2(values * window)) ** 2 / np.square(window).sum()
    return float(np.sqrt(power[high].mean()))


def noise_of_light(counts: np.ndarray) -> tuple[float, float]:
    """Return the standard deviations of two kinds of noise in a photograph of shape (ny, nx). The first value
    is the standard deviation of the noise in the dark, in counts. The second is the standard deviation of the
    noise that is proportional to the light, as a share of the light.

    The second kind includes speckle. The variance at the highest spatial frequencies is fitted as dark^2 +
    (share * light)^2, where ``dark`` and ``share`` are the two returned values.
    """
    from scipy.ndimage import gaussian_filter

    window, high = _window_and_band(counts.shape)
    noise = np.fft.ifft2(np.fft.fft2(counts * window) * high).real / np.sqrt(high.mean())
    light = gaussian_filter(counts.astype(float).clip(0), 2.0)
    columns = np.square(np.stack([window, window * light], axis=-1)).reshape(-1, 2)
    scale = columns.max(0)
    (dark, share), _ = nnls(columns / scale, np.square(noise).ravel())
    return float(np.sqrt(dark / scale[0])), float(np.sqrt(share / scale[1]))


def covariance_by_tiles(slopes: np.ndarray, residual: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the covariance of a least-squares fit to a map whose residuals are correlated between pixels,
    shape (k, k).

    The fit is repeated without each tile of the map (jackknife, Efron and Tibshirani 1993, chapter 11). A
    print that differs from the expected one appears to be displaced by a different amount in each tile. The
    covariance includes this effect, even if few tiles determine a parameter. It does not include an error
    that is the same in all tiles.

    Args:
        slopes: derivatives of the fitted values with respect to the k parameters, shape (n, k).
        residual: measured minus fitted values, shape (n,).
        shape: shape (ny, nx) of the map. The first ny * nx residuals are those of its pixels, row by row. Any
            others express prior knowledge, and belong to no tile.
    """
    along = [np.arange(size) * _TILES // size for size in shape]
    tile = np.full(len(residual), -1)
    tile[: shape[0] * shape[1]] = (along[0][:, None] * _TILES + along[1]).ravel()
    normal, right = slopes.T @ slopes, slopes.T @ residual
    found = []
    for left_out in range(_TILES**2):
        part, rest = slopes[tile == left_out], residual[tile == left_out]
        found.append(np.linalg.pinv(normal - part.T @ part) @ (right - part.T @ rest))
    spread: np.ndarray = np.cov(np.transpose(found), bias=True) * (_TILES**2 - 1)
    return spread


def _window_and_band(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return a Hann window for a map, and a mask of the frequencies that contain only noise."""
    along = [np.abs(np.fft.fftfreq(count)) > _NOISE_BAND for count in shape]
    return np.outer(*map(np.hanning, shape)), np.logical_and.outer(*along)


def estimated(
    score: Callable[[T], Record],
    measured: Record,
    noisier: Iterable[T],
    left: Iterable[T],
    hidden: Iterable[T],
) -> tuple[dict[str, float], dict[str, float]]:
    """Correct the scores of a measurement for its errors. Return two dicts, keyed by the name of the score:
    the corrected scores, and their standard deviations.

    Errors that remain in a measurement bias its scores. The same kinds of errors are therefore added once
    more. This changes a score, on average, by the same bias, which is then subtracted (bias correction by
    bootstrap, Efron and Tibshirani 1993, chapter 10). Other errors are hidden by a fit, such as levelling:
    the fit makes the print look more like the expected print than it is. For each pair in ``hidden``, the
    mean change of a score is therefore added.

    The variants come in pairs. The two variants of a pair contain the same error with opposite signs. In
    ``left`` and ``hidden``, each pair changes one independent parameter by its standard deviation. If the
    parameters are normally distributed and the score is a sum of quadratic functions of single parameters,
    the mean and the variance are exact (JCGM 100:2008, 5.1.2).

    Args:
        score: function that scores a variant.
        measured: scores of the measurement.
        noisier: pairs of variants with added random noise, which is as strong as the noise of the
            measurement.
        left: pairs of variants with added errors of the kinds that remain in the measurement.
        hidden: pairs of variants that the fit cannot distinguish from the measurement.
    """
    noise, rest, fitted = (_changes(score, measured, variants) for variants in (noisier, left, hidden))
    figures, spread = {}, {}
    for name in noise:
        (even_left, odd_left), (even, odd) = _parts(rest[name]), _parts(fitted[name])
        figures[name] = getattr(measured, name) - float(noise[name].mean() + even_left.sum() - even.sum())
        squares = np.concatenate([odd_left, odd]) ** 2 + 2 * np.concatenate([even_left, even]) ** 2
        spread[name] = math.sqrt(noise[name].var() + squares.sum())
    return figures, spread


def _changes(score: Callable[[T], Record], measured: Record, variants: Iterable[T]) -> dict[str, np.ndarray]:
    """Return, for every score in ``measured``, the differences between the scores of the variants and this
    score. The dict is keyed by the name of the score.
    """
    scores = [score(variant).model_dump(exclude_none=True) for variant in variants]
    values = measured.model_dump(exclude_none=True)
    return {name: np.array([one[name] - value for one in scores]) for name, value in values.items()}


def _parts(changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the even and the odd part of the change of a score for each pair of variants. In ``changes``,
    the two variants of a pair follow one another.
    """
    plus, minus = changes.reshape(-1, 2).T
    return (plus + minus) / 2, (plus - minus) / 2
