"""Statistics of a set of layouts, and how far a design lies outside it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record, Result

FEATURES = ("mean_level", "sd_level", "mean_jump", "extreme_share", "correlation_at_half_um")

_WINDOW_PX = 64
_BIN_PER_UM = 0.05
_LONGEST_LAG_UM = 5.0
_QUANTILE = 0.99
_POWER_QUANTILE = 0.95


class LayoutStatistics(Result):
    """Pooled statistics of a set of layouts.

    Args:
        level_share: share of pixels at each level, sums to 1.
        jump_share: share of neighbouring pixel pairs (along x and y) that differ by 0, 1, 2 … levels.
        frequency_per_um: centres of the radial frequency bins, cycles/µm.
        power_share: share of the power (mean level excluded) in each bin, sums to 1.
        lag_um: lags of the autocorrelation, µm.
        autocorrelation_x, autocorrelation_y: of the level about the layout's mean, 1 at lag 0.
        windows: features of 64 × 64 px windows, for `departure`.
        settings: of a set that was made here, None for any other.
    """

    SCHEMA: ClassVar[str] = "litho-data/layouts/1"
    FILE_NAME: ClassVar[str] = "layouts.json"

    count: int
    levels: int
    pitch_um: float
    level_share: list[float]
    jump_share: list[float]
    frequency_per_um: list[float]
    power_share: list[float]
    lag_um: list[float]
    autocorrelation_x: list[float]
    autocorrelation_y: list[float]
    windows: WindowFeatures
    settings: dict[str, Any] | None = None


class WindowFeatures(Record):
    """Mean and covariance of the features of all windows of a set, and the spread of its own windows.

    The features are `FEATURES`; ``distance_quantile`` is the 99 % quantile of their Mahalanobis distance.
    """

    count: int
    window_px: int
    mean: list[float]
    covariance: list[list[float]]
    distance_quantile: float


class Departure(Record):
    """How far a design lies outside a set.

    Args:
        level_distance: total-variation distance of the level shares, 0 (same) to 1 (disjoint).
        jump_distance: the same for the jump shares.
        power_beyond: share of the design's power at frequencies above which the set has at most 5 %.
        windows_outside: share of the design's windows beyond the set's 99 % distance; 0.01 is expected
            of a layout like the set's.
        worst_distance: largest Mahalanobis distance of a window, relative to that quantile.
    """

    level_distance: float
    jump_distance: float
    power_beyond: float
    windows_outside: float
    worst_distance: float


def layout_statistics(layouts: Iterable[Array | Path], *, levels: int, pitch_um: float) -> LayoutStatistics:
    """Collect the statistics of layouts, one at a time.

    Args:
        layouts: uint8 levels (ny, nx), or paths of layout files.
        levels: number of levels L.
        pitch_um: pixel pitch, µm.

    Raises:
        InputError: no layout, a level of L or more, or a layout smaller than a window.
    """
    levels_count = np.zeros(levels, np.int64)
    jumps_count = np.zeros(levels, np.int64)
    powers: list[Array] = []
    correlations: list[Array] = []
    features: list[Array] = []
    for layout in layouts:
        level = _checked(layout, levels)
        levels_count += np.bincount(level.ravel(), minlength=levels)
        for axis in (0, 1):
            jumps = np.abs(np.diff(level.astype(int), axis=axis)).ravel()
            jumps_count += np.bincount(jumps, minlength=levels)
        powers.append(_radial_power(level, pitch_um))
        correlations.append(_autocorrelation(level, pitch_um))
        features.append(window_features(level, levels, pitch_um))
    if not features:
        raise InputError("layouts", got="none", wanted="at least one")
    shortest = min(one.shape[1] for one in correlations)
    power = np.mean(powers, axis=0)
    correlation = np.mean([one[:, :shortest] for one in correlations], axis=0)
    return LayoutStatistics(
        count=len(features),
        levels=levels,
        pitch_um=pitch_um,
        level_share=(levels_count / levels_count.sum()).tolist(),
        jump_share=(jumps_count / jumps_count.sum()).tolist(),
        frequency_per_um=((np.arange(power.size) + 0.5) * _BIN_PER_UM).tolist(),
        power_share=(power / (power.sum() or 1.0)).tolist(),
        lag_um=(np.arange(shortest) * pitch_um).tolist(),
        autocorrelation_x=correlation[1].tolist(),
        autocorrelation_y=correlation[0].tolist(),
        windows=_pool(np.concatenate(features)),
    )


def departure(design: Array | Path, training: LayoutStatistics) -> Departure:
    """How far one design lies outside the layouts that a model was trained on.

    Raises:
        InputError: a level that the training set does not have, or a design smaller than a window.
    """
    own = layout_statistics([design], levels=training.levels, pitch_um=training.pitch_um)
    power = np.array(own.power_share)
    cumulative = np.cumsum(training.power_share)
    beyond = np.arange(power.size) > np.searchsorted(cumulative, _POWER_QUANTILE)
    features = window_features(_checked(design, training.levels), training.levels, training.pitch_um)
    distance = _mahalanobis(features, np.array(training.windows.mean), np.array(training.windows.covariance))
    relative = distance / max(training.windows.distance_quantile, np.finfo(float).tiny)
    return Departure(
        level_distance=_total_variation(own.level_share, training.level_share),
        jump_distance=_total_variation(own.jump_share, training.jump_share),
        power_beyond=float(power[: beyond.size][beyond].sum()),
        windows_outside=float((relative > 1).mean()),
        worst_distance=float(relative.max()),
    )


def window_features(level: Array, levels: int, pitch_um: float) -> Array:
    """Features of the non-overlapping windows of a layout, shape (windows, len(FEATURES))."""
    ny, nx = (size // _WINDOW_PX for size in level.shape)
    windows = level[: ny * _WINDOW_PX, : nx * _WINDOW_PX].astype(float)
    windows = (
        windows.reshape(ny, _WINDOW_PX, nx, _WINDOW_PX).swapaxes(1, 2).reshape(-1, _WINDOW_PX, _WINDOW_PX)
    )
    centred = windows - windows.mean((1, 2), keepdims=True)
    variance = (centred**2).mean((1, 2))
    lag = max(1, round(0.5 / pitch_um))
    product = (centred[:, :, lag:] * centred[:, :, :-lag]).mean((1, 2))
    jump_x = np.abs(np.diff(windows, axis=2)).mean((1, 2))
    jump_y = np.abs(np.diff(windows, axis=1)).mean((1, 2))
    extreme = ((windows == 0) | (windows == levels - 1)).mean((1, 2))
    correlation = np.divide(product, variance, out=np.ones_like(product), where=variance > 0)
    return np.stack(
        [windows.mean((1, 2)), variance**0.5, (jump_x + jump_y) / 2, extreme, correlation], axis=1
    )


def _checked(layout: Array | Path, levels: int) -> Array:
    if isinstance(layout, Path):
        from litho_data.readers import read_layout

        layout = read_layout(layout)
    if layout.max() >= levels:
        raise InputError("level in a layout", got=int(layout.max()), wanted=f"0 to {levels - 1}")
    if min(layout.shape) < _WINDOW_PX:
        raise InputError("layout", got=f"{layout.shape} px", wanted=f"at least {_WINDOW_PX} px each way")
    return layout


def _radial_power(level: Array, pitch_um: float) -> Array:
    """Power about the mean in radial bins up to the axis Nyquist frequency, normalised per layout."""
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


def _autocorrelation(level: Array, pitch_um: float) -> Array:
    """Autocorrelation along y and x, shape (2, lags); for a constant layout 0 except at lag 0."""
    centred = level - level.mean()
    variance = (centred**2).mean()
    lags = min(round(_LONGEST_LAG_UM / pitch_um), min(level.shape) - 1) + 1
    result = np.zeros((2, lags))
    result[:, 0] = 1.0
    if variance > 0:
        for lag in range(1, lags):
            result[0, lag] = (centred[lag:] * centred[:-lag]).mean() / variance
            result[1, lag] = (centred[:, lag:] * centred[:, :-lag]).mean() / variance
    return result


def _pool(features: Array) -> WindowFeatures:
    mean = features.mean(axis=0)
    covariance = np.atleast_2d(np.cov(features, rowvar=False, ddof=0))
    return WindowFeatures(
        count=len(features),
        window_px=_WINDOW_PX,
        mean=mean.tolist(),
        covariance=covariance.tolist(),
        distance_quantile=float(np.quantile(_mahalanobis(features, mean, covariance), _QUANTILE)),
    )


def _mahalanobis(features: Array, mean: Array, covariance: Array) -> Array:
    # A feature that does not vary in the set (a flat print) still needs a scale: a thousandth of a level.
    ridge = covariance + 1e-6 * np.eye(len(mean))
    off = features - mean
    return np.sqrt(np.einsum("wi,ij,wj->w", off, np.linalg.inv(ridge), off))


def _total_variation(shares_a: list[float], shares_b: list[float]) -> float:
    return float(0.5 * np.abs(np.array(shares_a) - np.array(shares_b)).sum())
