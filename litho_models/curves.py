"""How an error depends on the level and on the spatial frequency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from litho_data.results import Record
from litho_data.store import PrintedScan
from litho_models.metrics import NM_PER_UM

TRANSFER_BANDS = 24


class LevelError(Record):
    """Error at the pixels printed with one level, nm; scans count where the level occurs."""

    level: int
    pixels: int
    scans: int
    bias_nm: float
    sd_nm: float


class TransferCurves(Record):
    """Prediction against measurement per frequency: |H·Z*| / |Z|² and coherence γ², along x and y."""

    frequency_per_um: list[float]
    gain_x: list[float]
    gain_y: list[float]
    coherence_x: list[float]
    coherence_y: list[float]


def level_errors(scans: Sequence[PrintedScan], residuals_um: Sequence[np.ndarray]) -> list[LevelError]:
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


def transfer_curves(scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray]) -> TransferCurves:
    """Transfer and coherence from line spectra (Hann window, line mean removed), averaged over all lines.

    The frequency axis has ``TRANSFER_BANDS`` equal bands up to Nyquist of the layout pitch.
    """
    pitch = scans[0].pitch_um
    edges = np.linspace(0, 0.5 / pitch, TRANSFER_BANDS + 1)
    along_x = np.zeros((3, TRANSFER_BANDS))
    along_y = np.zeros((3, TRANSFER_BANDS))
    for scan, prediction in zip(scans, predictions_um, strict=True):
        usable = scan.valid & np.isfinite(scan.height_um)
        height = np.where(usable, scan.height_um, prediction)
        along_x += _band_powers(height, prediction, pitch, edges)
        along_y += _band_powers(height.T, prediction.T, pitch, edges)
    gain_x, coherence_x = _transfer(along_x)
    gain_y, coherence_y = _transfer(along_y)
    return TransferCurves(
        frequency_per_um=((edges[1:] + edges[:-1]) / 2).tolist(),
        gain_x=gain_x,
        gain_y=gain_y,
        coherence_x=coherence_x,
        coherence_y=coherence_y,
    )


def _band_powers(
    height: np.ndarray, prediction: np.ndarray, pitch_um: float, edges: np.ndarray
) -> np.ndarray:
    window = np.hanning(height.shape[1])
    measured, predicted = (
        np.fft.rfft((field - field.mean(axis=1, keepdims=True)) * window, axis=1)
        for field in (height.astype(np.float64), prediction.astype(np.float64))
    )
    band = np.digitize(np.fft.rfftfreq(height.shape[1], pitch_um), edges[1:-1])
    spectra = [
        (predicted * measured.conj()).real.sum(axis=0),
        (np.abs(measured) ** 2).sum(axis=0),
        (np.abs(predicted) ** 2).sum(axis=0),
    ]
    return np.stack([np.bincount(band, spectrum, minlength=len(edges) - 1) for spectrum in spectra])


def _transfer(powers: np.ndarray) -> tuple[list[float], list[float]]:
    cross, measured, predicted = powers
    tiny = np.finfo(float).tiny
    gain = np.abs(cross) / np.maximum(measured, tiny)
    coherence = cross**2 / np.maximum(measured * predicted, tiny)
    return gain.tolist(), coherence.tolist()
