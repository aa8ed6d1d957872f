"""How an error depends on the level and on the spatial frequency."""

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
    """Error at the pixels printed with one level, nm; scans count where the level occurs."""

    level: int
    pixels: int
    scans: int
    bias_nm: float
    sd_nm: float


class TransferCurves(Record):
    """Prediction against measurement per frequency: |H·Z*| / |Z|² and coherence γ², along x and y.

    ``error_psd``: one-sided density of the error's power along lines, nm² per cycle/µm, line means removed.
    ``half_power``: frequency at which the gain first falls below 1/√2 of that of the lowest band, 1/µm; None
    if it never does. ``noise_band``: width of the ideal low pass that lets as much white noise through, 1/µm.
    None or empty in older result files.
    """

    frequency_per_um: list[float]
    gain_x: list[float]
    gain_y: list[float]
    coherence_x: list[float]
    coherence_y: list[float]
    error_psd_x: list[float] = Field(default_factory=list)
    error_psd_y: list[float] = Field(default_factory=list)
    half_power_x_per_um: float | None = None
    half_power_y_per_um: float | None = None
    noise_band_x_per_um: float | None = None
    noise_band_y_per_um: float | None = None


def level_errors(scans: Sequence[PrintedScan], residuals_um: Sequence[Array]) -> list[LevelError]:
    """Bias (measured minus predicted) and standard deviation per layout level, over scored pixels.

    Args:
        scans: the scans; ``residuals_um``: measured minus predicted (ny, nx), NaN where not scored.
    """
    levels = np.concatenate([s.mask_level[np.isfinite(r)] for s, r in zip(scans, residuals_um, strict=True)])
    errors = np.concatenate([r[np.isfinite(r)] for r in residuals_um]) * NM_PER_UM
    rows = []
    for level in np.unique(levels):
        here = errors[levels == level]
        rows.append(
            LevelError(
                level=int(level),
                pixels=int(here.size),
                scans=sum(bool((scan.mask_level == level).any()) for scan in scans),
                bias_nm=float(here.mean()),
                sd_nm=float(here.std()),
            )
        )
    return rows


def transfer_curves(scans: Sequence[PrintedScan], predictions_um: Sequence[Array]) -> TransferCurves:
    """Transfer, coherence and error from line spectra (Hann window, line mean removed), over all lines.

    The frequency axis has ``TRANSFER_BANDS`` equal bands up to Nyquist of the layout pitch.
    """
    pitch = scans[0].pitch_um
    edges = np.linspace(0, 0.5 / pitch, TRANSFER_BANDS + 1)
    frequency = (edges[1:] + edges[:-1]) / 2
    along_x, along_y = np.zeros((5, TRANSFER_BANDS)), np.zeros((5, TRANSFER_BANDS))
    for scan, prediction in zip(scans, predictions_um, strict=True):
        usable = scan.usable
        height = np.where(usable, scan.height_um, prediction)
        along_x += _band_powers(height, prediction, pitch, edges)
        along_y += _band_powers(height.T, prediction.T, pitch, edges)
    curves: dict[str, Any] = {"frequency_per_um": frequency.tolist()}
    for axis, (cross, measured, predicted, error, lines) in (("x", along_x), ("y", along_y)):
        gain = np.abs(cross) / np.maximum(measured, _TINY)
        curves |= {
            f"gain_{axis}": gain.tolist(),
            f"coherence_{axis}": (cross**2 / np.maximum(measured * predicted, _TINY)).tolist(),
            f"error_psd_{axis}": (NM_PER_UM**2 * error / np.maximum(lines, 1)).tolist(),
            f"half_power_{axis}_per_um": half_power_frequency(frequency, gain),
            f"noise_band_{axis}_per_um": noise_equivalent_band(frequency, gain),
        }
    return TransferCurves(**curves)


def half_power_frequency(frequency: Array, gain: Array) -> float | None:
    """Where a gain (bands,) first falls below 1/√2 of the lowest band's, linear between bands; or None."""
    limit = np.sqrt(0.5) * gain[0]
    below = np.flatnonzero(gain < limit)
    if not below.size:
        return None
    crossing = slice(below[0] - 1, below[0] + 1)
    return float(np.interp(-limit, -gain[crossing], frequency[crossing]))


def noise_equivalent_band(frequency: Array, gain: Array) -> float | None:
    """∫ gain² df over the gain² of the lowest band, for equal bands; None where that one is zero."""
    return float(np.sum(gain**2) * (frequency[1] - frequency[0]) / gain[0] ** 2) if gain[0] > 0 else None


def _band_powers(height: Array, prediction: Array, pitch_um: float, edges: Array) -> Array:
    """Sums over lines and the frequencies of each band, (5, bands): cross, measured, predicted, error, count.

    The error is a one-sided density (µm² per cycle/µm), the count that of its terms.
    """
    window = np.hanning(height.shape[1])
    measured, predicted = (
        np.fft.rfft((field - field.mean(axis=1, keepdims=True)) * window, axis=1)
        for field in (height.astype(np.float64), prediction.astype(np.float64))
    )
    band = np.digitize(np.fft.rfftfreq(height.shape[1], pitch_um), edges[1:-1])
    density = 2 * pitch_um / np.sum(window**2)
    spectra = [
        (predicted * measured.conj()).real.sum(axis=0),
        (np.abs(measured) ** 2).sum(axis=0),
        (np.abs(predicted) ** 2).sum(axis=0),
        density * (np.abs(measured - predicted) ** 2).sum(axis=0),
        np.full(band.shape, float(len(height))),
    ]
    return np.stack([np.bincount(band, spectrum, minlength=len(edges) - 1) for spectrum in spectra])
