"""Measure how the error of a model depends on the layout level and on the spatial frequency."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan

TRANSFER_BANDS = 24
_TINY = float(np.finfo(float).tiny)


class LevelError(Record):
    """The mean (``bias_nm``) and the standard deviation (``sd_nm``) of the error at the scored pixels of one
    layout level. ``scans`` is the number of scans in which the level occurs.
    """

    level: int
    pixels: int
    scans: int
    bias_nm: float
    sd_nm: float


class TransferCurves(Record):
    """A comparison of the spectra of the predicted height H and the measured height Z, along x and along y.
    It states the gain |H·Z*| / |Z|² and the coherence γ² at each frequency.

    ``error_psd_x`` and ``error_psd_y`` are the one-sided power spectral density of the error, nm² per
    cycle/µm. The mean of each line is removed first.
    """

    frequency_per_um: list[float]
    gain_x: list[float]
    gain_y: list[float]
    coherence_x: list[float]
    coherence_y: list[float]
    error_psd_x: list[float] = Field(default_factory=list)
    error_psd_y: list[float] = Field(default_factory=list)


def level_errors(scans: Sequence[PrintedScan], residuals_um: Sequence[Array]) -> list[LevelError]:
    """Return the bias (measured minus predicted) and the standard deviation of the error for each layout
    level. Only scored pixels are used.

    Args:
        scans: the scans.
        residuals_um: measured minus predicted height of each scan, µm, of shape (ny, nx); NaN at pixels that
            are not scored.
    """
    levels = np.concatenate([s.mask_level[np.isfinite(r)] for s, r in zip(scans, residuals_um, strict=True)])
    errors = np.concatenate([r[np.isfinite(r)] for r in residuals_um]) * NM_PER_UM
    values, at, pixels = np.unique(levels, return_inverse=True, return_counts=True)
    bias = np.bincount(at, errors) / pixels
    sd = np.sqrt(np.bincount(at, (errors - bias[at]) ** 2) / pixels)
    seen = np.sum([np.isin(values, scan.mask_level) for scan in scans], axis=0)
    columns = (one.tolist() for one in (values, pixels, seen, bias, sd))
    return [
        LevelError(level=level, pixels=count, scans=among, bias_nm=mean, sd_nm=spread)
        for level, count, among, mean, spread in zip(*columns, strict=True)
    ]


def transfer_curves(scans: Sequence[PrintedScan], predictions_um: Sequence[Array]) -> TransferCurves:
    """Compute the gain, the coherence and the power spectral density of the error from the spectra of all
    lines. The mean of each line is removed, and a Hann window is applied. Only measured pixels are used.

    The frequency axis has ``TRANSFER_BANDS`` equal bands up to the Nyquist frequency of the layout pitch.
    """
    pitch = scans[0].pitch_um
    edges = np.linspace(0, 0.5 / pitch, TRANSFER_BANDS + 1)
    frequency = (edges[1:] + edges[:-1]) / 2
    along_x, along_y = np.zeros((6, TRANSFER_BANDS)), np.zeros((6, TRANSFER_BANDS))
    for scan, prediction in zip(scans, predictions_um, strict=True):
        usable = scan.usable
        error = np.where(usable, scan.height_um.astype(np.float64) - prediction, 0)
        along_x += _band_powers(error, prediction, usable, pitch, edges)
        along_y += _band_powers(error.T, prediction.T, usable.T, pitch, edges)
    curves: dict[str, Any] = {"frequency_per_um": frequency.tolist()}
    for axis, (*parts, measured, predicted, error, lines) in (("x", along_x), ("y", along_y)):
        cross = np.hypot(*parts)
        curves |= {
            f"gain_{axis}": (cross / np.maximum(measured, _TINY)).tolist(),
            f"coherence_{axis}": (cross**2 / np.maximum(measured * predicted, _TINY)).tolist(),
            f"error_psd_{axis}": (NM_PER_UM**2 * error / np.maximum(lines, _TINY)).tolist(),
        }
    return TransferCurves(**curves)


def _band_powers(error: Array, prediction: Array, usable: Array, pitch_um: float, edges: Array) -> Array:
    """Compute sums over frequency bands. The result has shape (6, bands). Its rows are the real and the
    imaginary part of the cross power, the power of the measurement, the power of the prediction, the power
    spectral density of the error, and the number of terms in the sum of this density. Each value is a sum
    over all lines and over the frequencies of one band.

    The power spectral density is one-sided, in µm² per cycle/µm. Its sum divided by the number of terms is
    its mean.

    ``error`` is measured minus predicted height, and 0 at pixels that are not usable. Unusable pixels
    therefore lower the power of the error in their line. To lower the power of the prediction and the number
    of terms in the same way, both are multiplied by the usable share of the line, weighted with the squared
    window. Unusable pixels then do not bias the results.
    """
    window = np.hanning(error.shape[1])
    share = usable @ window**2 / np.sum(window**2)
    means = error.sum(axis=1, keepdims=True) / np.maximum(usable.sum(axis=1, keepdims=True), 1)
    centred = prediction.astype(np.float64) - prediction.mean(axis=1, keepdims=True, dtype=np.float64)
    missed = np.fft.rfft(np.where(usable, error - means, 0) * window, axis=1)
    predicted = np.fft.rfft(centred * window, axis=1)
    band = np.digitize(np.fft.rfftfreq(error.shape[1], pitch_um), edges[1:-1])
    density = 2 * pitch_um / np.sum(window**2)
    power = share @ np.abs(predicted) ** 2
    # The measurement is the sum of the prediction and the error.
    with_error = (predicted * missed.conj()).sum(axis=0)
    error_power = (np.abs(missed) ** 2).sum(axis=0)
    spectra = [
        power + with_error.real,
        with_error.imag,
        power + 2 * with_error.real + error_power,
        power,
        density * error_power,
        np.full(band.shape, share.sum()),
    ]
    return np.stack([np.bincount(band, spectrum, minlength=len(edges) - 1) for spectrum in spectra])
