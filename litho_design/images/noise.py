"""Estimate the white noise of a measured map, the covariance of a fit to it, and the uncertainties of its
scores.
"""

from __future__ import annotations

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
# Number of random errors from which the uncertainty of a score is computed.
_POSSIBLE = 20_000
# Shares of the possible scores that lie within 1 σ and within 3 σ. For a normal distribution, these shares
# are 0.6827 and 0.9973. With 0.9973, σ would be too wide for skewed scores.
_WITHIN_1, _WITHIN_3 = 0.6827, 0.995
# σ may be larger than necessary by this factor if the score then lies closer to the mean of all possible
# scores.
_NEAR_MEAN = 1.03
# Beyond this frequency (cycles/px) along both axes, neither prints nor sharply sampled images have structure.
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


def corrected_scores(
    score: Callable[[T], Record],
    measured: Record,
    noisy: Iterable[T],
    variants: Iterable[T],
    alternatives: Iterable[T] = (),
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the corrected scores of a measurement and their uncertainties σ, two dicts keyed by the name of
    the score.

    Noise biases a score. Noise of the same strength is therefore added once more, and the mean change is
    subtracted (bias correction by bootstrap, Efron and Tibshirani 1993, chapter 10). Other quantities, such
    as the scale, may be wrong by a known standard deviation. Random errors of them are drawn (JCGM 101:2008),
    and each draw gives one possible true score. The change of a score is assumed to be a sum of quadratic
    functions, one per quantity. An error of position usually makes a score worse, whatever its sign, so the
    possible scores are skewed. Score and σ are chosen so that 68 % of them lie within 1 σ, and 99.5 % within
    3 σ.

    Args:
        score: function that scores an image or a print.
        measured: scores of the measurement.
        noisy: pairs of measurements with added random noise. The two measurements of a pair contain the same
            noise with opposite signs.
        variants: pairs of measurements that differ from the given one in one independent quantity, by plus
            and minus its standard deviation.
        alternatives: pairs of measurements of which one is right, each with the same probability.
    """
    noise, free, either = (_changes(score, measured, one) for one in (noisy, variants, alternatives))
    figures, sigma = {}, {}
    for name, added in noise.items():
        even, odd = _parts(np.concatenate([free[name], either[name]]))
        half = np.random.default_rng(0).standard_normal((_POSSIBLE // 2, 1 + len(odd)))
        # Every draw is used with both signs, so that odd changes cancel in the mean.
        amounts = np.concatenate([half, -half])
        two_valued = amounts[:, 1 + len(free[name]) // 2 :]
        two_valued[:] = np.sign(two_valued)
        possible = getattr(measured, name) - added.mean() + added.std() * amounts[:, 0]
        possible += amounts[:, 1:] @ odd + amounts[:, 1:] ** 2 @ even
        figures[name], sigma[name] = _covering(possible)
    return figures, sigma


def _covering(values: np.ndarray) -> tuple[float, float]:
    """Return the centre and the half width σ of the narrowest interval that contains the share ``_WITHIN_1``
    of the values, while the interval of three times its width contains the share ``_WITHIN_3``.

    Of the centres whose σ is hardly above the smallest one (see ``_NEAR_MEAN``), the one closest to the mean
    is returned.
    """
    mean, sd = float(values.mean()), float(values.std())
    centres = mean + sd * np.array(sorted(np.linspace(-1, 1, 41), key=abs))
    inner, outer = np.quantile(np.abs(values - centres[:, None]), [_WITHIN_1, _WITHIN_3], axis=1)
    widths = np.maximum(inner, outer / 3)
    best = int(np.argmax(widths <= _NEAR_MEAN * widths.min()))
    return float(centres[best]), float(widths[best])


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
