"""Power spectrum of what is left: the noise that an experiment has to be seen against."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import map_coordinates

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.fits import ALL_FREE
from litho_models.loop.prepared import PreparedScan, sample_border_px
from litho_models.scan_terms import freed_um

_TILE_PX = 64


class NoiseSpectrum(Record):
    """Mean power of tiles of residuals, nm² per pixel of noise variance.

    ``power_nm2``: (n, n) at the frequencies of ``np.fft.fft2`` of a tile; their mean is
    the variance of a pixel.
    """

    power_nm2: list[list[float]]

    def on_grid(self, shape: tuple[int, ...]) -> np.ndarray:
        """Power at the frequencies of ``np.fft.fft2`` of a map of this shape, nm²."""
        power = np.array(self.power_nm2)
        at = np.meshgrid(*[np.fft.fftfreq(n) * len(power) for n in shape], indexing="ij")
        return map_coordinates(power, at, order=1, mode="grid-wrap")

    def along(self, change: np.ndarray) -> float:
        """Standard deviation of the noise along a change (y, x) of the height, nm.

        That of the sum over pixels of noise times change, divided by the root of the sum of squares of the
        change.
        """
        spectrum = np.abs(np.fft.fft2(change)) ** 2
        return float(np.sqrt((spectrum * self.on_grid(change.shape)).sum() / spectrum.sum()))


def left_nm(scan: PreparedScan, prediction_um: np.ndarray) -> np.ndarray:
    """Measured minus predicted (y, x), nm, away from the edge and free of what a scan may add by itself.

    NaN where not measured.
    """
    border = sample_border_px(min(scan.stored.shape))
    inner = (slice(border, -border),) * 2
    used = scan.usable[inner]
    freed = freed_um(scan.stored.height_um[inner], prediction_um[inner], used, ALL_FREE)
    return np.where(used, NM_PER_UM * freed, np.nan)


def noise_spectrum(residuals_nm: Sequence[np.ndarray]) -> NoiseSpectrum:
    """Spectrum of maps of ``left_nm``, from tiles that are measured everywhere."""
    size = min(_TILE_PX, *(min(one.shape) for one in residuals_nm))
    window = np.outer(*[np.hanning(size + 2)[1:-1]] * 2)
    window /= np.sqrt((window**2).mean())
    powers: list[np.ndarray] = []
    for residual in residuals_nm:
        every = sliding_window_view(residual, (size, size))[:: size // 2, :: size // 2].reshape(
            -1, size, size
        )
        tiles = every[np.isfinite(every).all(axis=(1, 2))]
        about_mean = tiles - tiles.mean(axis=(1, 2), keepdims=True)
        powers += [*np.abs(np.fft.fft2(about_mean * window)) ** 2 / size**2]
    if not powers:
        powers = [np.full((size, size), float(np.mean([np.nanvar(one) for one in residuals_nm])))]
    return NoiseSpectrum(power_nm2=np.round(np.mean(powers, axis=0), 3).tolist())
