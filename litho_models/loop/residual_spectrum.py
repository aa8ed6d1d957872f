"""Power spectrum of what is left: the noise that an experiment has to be seen against."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import map_coordinates

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.linear import ALL_FREE, without_scan_terms
from litho_models.loop.prepared import PreparedScan
from litho_models.scan_terms import TermPixels, term_maps

_TILE_PX = 64


class NoiseSpectrum(Record):
    """Mean power of tiles of residuals, nm² per pixel of noise variance.

    ``power_nm2``: (tile/2 + 1, tile/2 + 1) over the sizes of the frequencies along y and x, so that its mean
    over the whole grid of frequencies is the variance of a pixel.
    """

    tile_px: int
    power_nm2: list[list[float]]

    @property
    def rms_nm(self) -> float:
        """Standard deviation of a pixel."""
        return float(np.sqrt(self.on_grid((self.tile_px, self.tile_px)).mean()))

    def on_grid(self, shape: tuple[int, int]) -> np.ndarray:
        """Power at the frequencies of ``np.fft.fft2`` of a map of this shape, nm²."""
        folded = np.array(self.power_nm2)
        at = [np.abs(np.fft.fftfreq(n)) * self.tile_px for n in shape]
        rows, columns = np.meshgrid(*at, indexing="ij")
        return map_coordinates(folded, [rows, columns], order=1, mode="nearest")

    def along(self, change: np.ndarray) -> float:
        """Standard deviation of the noise along a change (y, x) of the height, nm.

        That of the mean over pixels of noise times change, divided by the rms of the change.
        """
        spectrum = np.abs(np.fft.fft2(change)) ** 2
        total = spectrum.sum()
        shape = change.shape[0], change.shape[1]
        return float(np.sqrt((spectrum * self.on_grid(shape)).sum() / total)) if total else self.rms_nm


def residual_spectrum(scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray]) -> NoiseSpectrum:
    """Spectrum of measured minus predicted (y, x) µm, each scan freed of what it may add by itself."""
    size = min(_TILE_PX, *(min(scan.stored.shape) for scan in scans))
    window = np.outer(np.hanning(size + 2)[1:-1], np.hanning(size + 2)[1:-1])
    window /= np.sqrt((window**2).mean())
    powers = []
    for scan, prediction in zip(scans, predictions, strict=True):
        residual = _freed(scan, prediction)
        ny, nx = residual.shape
        for top in range(0, ny - size + 1, size // 2):
            for left in range(0, nx - size + 1, size // 2):
                tile = residual[top : top + size, left : left + size]
                if np.isfinite(tile).all():
                    tapered = NM_PER_UM * (tile - tile.mean()) * window
                    powers.append(np.abs(np.fft.fft2(tapered)) ** 2 / size**2)
    # Outliers in few tiles are defects, which a second look leaves out.
    power = np.mean(powers, axis=0) if powers else np.full((size, size), _plain_variance(scans, predictions))
    half = size // 2 + 1
    folded = (power + power[::-1, :][np.r_[-1, 0 : size - 1]]) / 2
    folded = (folded + folded[:, ::-1][:, np.r_[-1, 0 : size - 1]]) / 2
    return NoiseSpectrum(tile_px=size, power_nm2=np.round(folded[:half, :half], 3).tolist())


def _freed(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
    """Residual (y, x) µm without the scan's own terms; NaN where not measured."""
    residual = np.where(scan.usable, scan.stored.height_um - prediction, np.nan).astype(np.float64)
    maps = term_maps(TermPixels(prediction, scan.line), ALL_FREE)
    at = scan.sample
    found = np.linalg.lstsq(maps[:, at].T, residual.reshape(-1)[at], rcond=None)[0]
    return residual - (found @ maps).reshape(residual.shape)


def _plain_variance(scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray]) -> float:
    left = [
        without_scan_terms(scan.height - scan.at_sample(prediction), scan, prediction)
        for scan, prediction in zip(scans, predictions, strict=True)
    ]
    return float(np.mean([(one**2).mean() for one in left])) * NM_PER_UM**2
