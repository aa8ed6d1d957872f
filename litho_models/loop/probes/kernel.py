"""The missing linear response: what of the residual is the layout filtered by one kernel.

A regularised cross-spectral (Wiener) estimate over all scans, cut to a finite support, judged on scans
held out; its control swaps the layouts between the scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, rfft2
from scipy.ndimage import label
from scipy.signal import fftconvolve

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.probe import Estimate, Probe, sums_by_fold
from litho_models.scan_terms import POLICIES, TermPixels, Terms, least_squares, term_maps

SUPPORT_UM = 5.0
# The regularisation, relative to the median power of the layouts.
REGULARISATIONS = tuple(10.0**exponent for exponent in range(-3, 3))
# Printed features end here; beyond there is no layout to respond to, and half the band costs a quarter.
_BAND_CYCLES_PER_UM = 2.5
_FITTED_PX = 20_000
# Closer to the centre, a kernel is a wrong blur rather than something of its own.
_CENTRE_UM = 0.5
_FINER = 4
_PEAK_EDGE = 0.1


@dataclass(frozen=True)
class MissingKernel(Probe):
    """Residual = k * layout with one kernel for all scans.

    Attributes:
        layouts, residuals: spectra (scans, fy, fx) of the tapered scans, µm, in the band.
        size: (y, x) of the scans in pixels of ``pitch_um``, the pitch of the band.
        pixels: squared taper summed over a scan, in pixels of the band.
        pitch_um: sampling that the band needs.
    """

    layouts: np.ndarray
    residuals: np.ndarray
    size: tuple[int, int]
    pixels: float
    pitch_um: float

    @property
    def name(self) -> str:
        return "missing-kernel"

    @property
    def free(self) -> Terms:
        return POLICIES["full"]

    def held_out(self, fold_of: np.ndarray) -> Estimate:
        """Kernels (flattened, support cut) without each fold and their gain on each held-out scan."""
        cross, power = np.conj(self.layouts) * self.residuals, np.abs(self.layouts) ** 2
        sums = sums_by_fold(cross, fold_of), sums_by_fold(power, fold_of)
        choice = self._regularisation(*sums)
        kernels = self._without_each(*sums, choice)
        gains = np.zeros(len(cross))
        for fold, kernel in enumerate(kernels):
            for scan in np.flatnonzero(fold_of == fold):
                gains[scan] = self._gain(kernel, cross[scan], power[scan])
        common = self._kernel(sums[0].sum(axis=0), sums[1].sum(axis=0), choice).ravel()
        per_fold = np.stack([kernel.ravel() for kernel in kernels])
        return Estimate(common=common, per_fold=per_fold, gains_nm2=gains)

    def controls(self, fold_of: np.ndarray, random: np.random.Generator, count: int) -> np.ndarray:
        """Mean held-out gains (count,), nm², with every residual next to the layout of another scan."""
        return np.array([self._control(fold_of, random) for _ in range(count)])

    def _control(self, fold_of: np.ndarray, random: np.random.Generator) -> float:
        count = len(self.layouts)
        other = (np.arange(count) + random.integers(1, count)) % count
        signs = random.choice([-1.0, 1.0], size=(count, 1, 1))
        cross = np.conj(self.layouts[other]) * self.residuals * signs.astype(np.float32)
        sums = sums_by_fold(cross, fold_of), sums_by_fold(np.abs(self.layouts[other]) ** 2, fold_of)
        return max(self._pooled_gain(*sums, c) for c in REGULARISATIONS) / count

    def agreement(self) -> float:
        """Correlation over all layouts of the responses that two halves of the scans ask for."""
        cross = np.conj(self.layouts) * self.residuals
        power = np.abs(self.layouts) ** 2
        choice = self._regularisation(cross, power)
        first, second = (
            rfft2(self._kernel(cross[start::2].sum(axis=0), power[start::2].sum(axis=0), choice))
            for start in (0, 1)
        )
        weight = _weights(power.sum(axis=0).shape, self.size) * power.sum(axis=0)
        sizes = np.sqrt((weight * np.abs(first) ** 2).sum() * (weight * np.abs(second) ** 2).sum())
        return float((weight * first * np.conj(second)).real.sum() / max(sizes, np.finfo(float).tiny))

    def correction(self, parameters: np.ndarray, scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        """The layout filtered by the kernel, its mean left to the datum, (y, x) µm."""
        kernel = resampled(parameters.reshape(self.size), self.pitch_um, scan.stored.pitch_um)
        radius = kernel.shape[0] // 2
        layout = scan.stored.layout_um.astype(np.float64)
        padded = np.pad(layout - layout.mean(), radius, mode="edge")
        return fftconvolve(padded, kernel, mode="valid").astype(np.float32)

    def summary(self, parameters: np.ndarray) -> dict[str, tuple[float, str]]:
        """Sum, first moment, and the strongest peak off the centre, heights per layout height."""
        kernel = self.kernel_map(parameters)
        y, x = (np.fft.fftshift(np.fft.fftfreq(n, 1 / n)) * self.pitch_um for n in self.size)
        peak_y, peak_x, amplitude = off_centre_peak(parameters.reshape(self.size), self.pitch_um)
        return {
            "sum": (float(kernel.sum()), "1"),
            "first_moment_y": (float(y @ kernel.sum(axis=1)), "µm"),
            "first_moment_x": (float(kernel.sum(axis=0) @ x), "µm"),
            "peak_y": (peak_y, "µm"),
            "peak_x": (peak_x, "µm"),
            "peak_amplitude": (amplitude, "1"),
        }

    def kernel_map(self, parameters: np.ndarray) -> np.ndarray:
        """The kernel with its origin in the middle, (y, x), per pixel of the band."""
        return np.fft.fftshift(parameters.reshape(self.size))

    def _regularisation(self, cross: np.ndarray, power: np.ndarray) -> float:
        """The one whose kernels do best where they have not seen; ``cross``, ``power``: (folds, fy, fx)."""
        return max(REGULARISATIONS, key=lambda c: self._pooled_gain(cross, power, c))

    def _without_each(self, cross: np.ndarray, power: np.ndarray, regularisation: float) -> list[np.ndarray]:
        """Kernels from the sums of all folds but one; ``cross``, ``power``: (folds, fy, fx)."""
        all_cross, all_power = cross.sum(axis=0), power.sum(axis=0)
        return [
            self._kernel(all_cross - own_cross, all_power - own_power, regularisation)
            for own_cross, own_power in zip(cross, power, strict=True)
        ]

    def _pooled_gain(self, cross: np.ndarray, power: np.ndarray, regularisation: float) -> float:
        """Held-out gain summed over all scans, nm²."""
        kernels = self._without_each(cross, power, regularisation)
        return sum(self._gain(k, c, p) for k, c, p in zip(kernels, cross, power, strict=True))

    def _gain(self, kernel: np.ndarray, cross: np.ndarray, power: np.ndarray) -> float:
        """Gain in mean squared error, nm², summed over the scans whose spectra were summed."""
        transfer = rfft2(kernel)
        agreed = 2 * (np.conj(transfer) * cross).real - np.abs(transfer) ** 2 * power
        weights = _weights(power.shape, self.size)
        return float((weights * agreed).sum()) / (np.prod(self.size) * self.pixels) * NM_PER_UM**2

    def _kernel(self, cross: np.ndarray, power: np.ndarray, regularisation: float) -> np.ndarray:
        """Kernel (y, x), origin in the corner, zero beyond the support; its far ring is its zero."""
        transfer = cross / (power + regularisation * np.median(power))
        kernel = irfft2(transfer, s=self.size)
        distance = _distance_um(self.size, self.pitch_um)
        reach = reach_um(self.size, self.pitch_um)
        ring = (distance > 0.8 * reach) & (distance <= reach)
        return np.where(distance <= reach, kernel - kernel[ring].mean(), 0.0)


def missing_kernel(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], defects: Sequence[np.ndarray]
) -> MissingKernel:
    """Measure the spectra of layouts and residuals, both freed of what a scan may add by itself.

    Args:
        scans, predictions: scans and their held-out predictions (y, x) µm.
        defects: bool (y, x) per scan, left out.
    """
    size = tuple(min(scan.stored.shape[axis] for scan in scans) for axis in (0, 1))
    pitch_um = scans[0].stored.pitch_um
    taper = np.outer(np.hanning(size[0]), np.hanning(size[1]))
    band = tuple(_band_size(n, pitch_um) for n in size)
    layouts: list[np.ndarray] = []
    residuals: list[np.ndarray] = []
    for scan, prediction, defect in zip(scans, predictions, defects, strict=True):
        usable = scan.usable & ~defect
        layout = scan.stored.layout_um.astype(np.float64)
        residual = np.where(usable, scan.stored.height_um - prediction, 0.0).astype(np.float64)
        # The gain is taken from the residual alone: a layout without its low frequencies, which the
        # prediction holds, could not say how much of them the kernel needs.
        for target, freed in (
            (layouts, _freed(layout, None, usable)),
            (residuals, _freed(residual, prediction, usable)),
        ):
            top, left = ((full - n) // 2 for full, n in zip(freed.shape, size, strict=True))
            target.append(_in_band(taper * freed[top : top + size[0], left : left + size[1]], band))
    coarser = size[0] / band[0]
    return MissingKernel(
        layouts=np.stack(layouts).astype(np.complex64),
        residuals=np.stack(residuals).astype(np.complex64),
        size=(band[0], band[1]),
        pixels=float((taper**2).mean() * band[0] * band[1]),
        pitch_um=pitch_um * coarser,
    )


def resampled(kernel: np.ndarray, pitch_um: float, wanted_um: float) -> np.ndarray:
    """Kernel (origin in the corner) at a finer pitch: an odd square with its origin in the middle.

    Interpolated by its Fourier series; the sum over pixels stays, so that it filters alike.
    """
    ny, nx = kernel.shape
    factor = pitch_um / wanted_um
    radius = round(reach_um((ny, nx), pitch_um) / wanted_um)
    offsets = np.arange(-radius, radius + 1) / factor
    rows = np.exp(2j * np.pi * np.outer(offsets, np.fft.fftfreq(ny)))
    columns = np.exp(2j * np.pi * np.outer(offsets, np.fft.fftfreq(nx)))
    spectrum = np.fft.fft2(kernel)
    return (rows @ spectrum @ columns.T).real / (ny * nx) / factor**2


def off_centre_peak(kernel: np.ndarray, pitch_um: float) -> tuple[float, float, float]:
    """(y, x) in µm of the largest magnitude farther than 0.5 µm from the origin, and what it holds.

    The amplitude is the kernel summed over the peak down to a tenth of its height: height per layout
    height, 0.9 of the whole for a Gaussian peak.

    Args:
        kernel: (y, x), origin in the corner, per pixel of ``pitch_um``.
    """
    fine_um = pitch_um / _FINER
    fine = resampled(kernel, pitch_um, fine_um)
    radius = fine.shape[0] // 2
    y, x = (np.indices(fine.shape) - radius) * fine_um
    outside = np.where(np.hypot(y, x) > _CENTRE_UM, np.abs(fine), 0.0)
    at = np.unravel_index(int(np.argmax(outside)), fine.shape)
    if not fine[at]:
        return 0.0, 0.0, 0.0
    blobs, _ = label(fine / fine[at] > _PEAK_EDGE)
    return float(y[at]), float(x[at]), float(fine[blobs == blobs[at]].sum())


def _freed(values: np.ndarray, prediction: np.ndarray | None, usable: np.ndarray) -> np.ndarray:
    """Values minus their fit by plane, bow and (if given) prediction; zero where nothing was measured."""
    terms = POLICIES["full"] - (frozenset() if prediction is not None else {"gain"})
    basis = term_maps(TermPixels(values if prediction is None else prediction), terms)
    inside = np.flatnonzero(usable)
    thinned = inside[:: max(1, len(inside) // _FITTED_PX)]
    coefficients = least_squares(basis[:, thinned], values.ravel()[thinned])
    return np.where(usable, values - (coefficients @ basis).reshape(values.shape), 0.0)


def _band_size(size: int, pitch_um: float) -> int:
    """Even number of pixels whose Nyquist frequency is the end of the band."""
    return min(size, 2 * round(size * min(1.0, 2 * pitch_um * _BAND_CYCLES_PER_UM) / 2))


def _in_band(scan: np.ndarray, band: tuple[int, ...]) -> np.ndarray:
    """Half spectrum (fy, fx) of a scan at the coarser sampling that its band needs."""
    spectrum = rfft2(scan)
    ny, nx = band
    half = ny // 2
    rows = np.concatenate([spectrum[: ny - half], spectrum[len(spectrum) - half :]])
    return rows[:, : nx // 2 + 1] * (ny * nx / scan.size)


def _weights(shape: tuple[int, ...], size: tuple[int, int]) -> np.ndarray:
    """How often each entry of a half spectrum stands in the full one."""
    weights = np.full(shape, 2.0)
    weights[:, 0] = 1.0
    if size[1] % 2 == 0:
        weights[:, -1] = 1.0
    return weights


def _distance_um(size: tuple[int, int], pitch_um: float) -> np.ndarray:
    y, x = (np.fft.fftfreq(n, 1 / n) * pitch_um for n in size)
    return np.hypot(y[:, None], x[None, :])


def reach_um(size: tuple[int, int], pitch_um: float) -> float:
    """How far a kernel reaches on fields of ``size`` pixels."""
    return min(SUPPORT_UM, min(size) * pitch_um / 8)
