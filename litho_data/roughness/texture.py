"""Find the direction and the period of lines on a surface, and test whether they could occur by chance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, gammaincc, ndtri, polygamma

from litho_data.foundation import Array, InputError
from litho_data.roughness.spectrum import hann

FEWEST_LINES = 64
# A peak is compared with the frequencies around it that lie outside its own width under a Hann window.
_AROUND = 16
_OWN = 3
# Share of the powers that are independent. Under a Hann window, powers that are 0, 1 or 2 frequencies apart
# have a correlation of 1, 4/9 or 1/36.
_INDEPENDENT = 1 / (1 + 2 * 4 / 9 + 2 / 36)
_QUANTILES = ndtri((np.arange(200) + 0.5) / 200)
# First frequency that is used. Lower frequencies contain the part of a bow that levelling did not remove.
_FIRST = 3


@dataclass(frozen=True)
class LineDirection:
    """Direction of the lines of a surface.

    Args:
        angle_deg: angle of the lines to the rows, from -90 (excluded) to 90. An angle of 0 is along x;
            positive angles are from x towards y.
        strength: length of the mean double-angle vector of the power spectrum; 0 for an isotropic surface, 1
            for lines that all have one direction.
        p: probability that an isotropic surface has at least this strength by chance (Rayleigh's test).
    """

    angle_deg: float
    strength: float
    p: float


@dataclass(frozen=True)
class LinePeriod:
    """The strongest period of lines.

    Args:
        period_um: period at the centre of the peak that rises furthest above the spectrum around it.
        share: share of the power of the line means that lies in the peak.
        p: probability that a smooth spectrum has such a peak at any frequency by chance.
        amplitude_um: amplitude at this period, as a root mean square over the surfaces.
        coherence: agreement of the phases at this period. Every surface has a phasor of unit length, and the
            coherence is the length of the mean phasor. It is 1 if all surfaces have the same phase, and about
            1 / √F if the phases of F surfaces are independent.
    """

    period_um: float
    share: float
    p: float
    amplitude_um: float
    coherence: float


def line_direction(heights_um: Sequence[Array]) -> LineDirection:
    """Find the direction in which surfaces change least, from their power spectra.

    Each frequency (fx, fy) contributes a vector whose angle is twice that of the frequency and whose length
    is the power. Each surface is scaled by its own variance. The powers of random surfaces are independent
    and exponentially distributed. The mean vector of an isotropic surface is therefore normal with variance 1
    / n, where n = (Σ P)² / Σ P² is the effective number of frequencies.

    Args:
        heights_um: levelled heights in µm, one array of shape (ny, nx) per surface. The pixels must be
            square; NaN is replaced by the mean.

    Raises:
        InputError: a surface has fewer than 64 rows or columns.
    """
    vectors, variances = zip(*(_mean_vector(height) for height in heights_um), strict=True)
    vector, variance = np.mean(vectors), np.mean(variances) / len(heights_um)
    # In the spectrum, the power of lines lies in the direction across the lines.
    across = 0.5 * float(np.degrees(np.angle(vector)))
    return LineDirection(
        angle_deg=across - 90 if across > 0 else across + 90,
        strength=float(np.abs(vector)),
        p=float(np.exp(-(np.abs(vector) ** 2) / variance)),
    )


def _mean_vector(height_um: Array) -> tuple[complex, float]:
    """Return the mean double-angle vector of the power of a surface, and the variance that this vector would
    have on an isotropic surface.
    """
    height = np.asarray(height_um, np.float64)
    if height.ndim != 2 or min(height.shape) < FEWEST_LINES:
        raise InputError(
            "shape of the surface", got=height.shape, wanted=f"at least {FEWEST_LINES} rows and columns"
        )
    finite = np.isfinite(height)
    height = np.where(finite, height - height[finite].mean(), 0.0)
    ny, nx = height.shape
    weight = hann(height.shape)
    power = np.abs(np.fft.fft2((height - (height * weight).sum() / weight.sum()) * weight)) ** 2
    fy, fx = np.meshgrid(np.fft.fftfreq(ny), np.fft.fftfreq(nx), indexing="ij")
    radius = np.hypot(fx, fy)
    # Beyond the Nyquist frequency of the axes, the spectrum consists only of its four corners, which would
    # favour four directions.
    used = (radius >= _FIRST / min(ny, nx)) & (radius < 0.5)
    power, angle = power[used], np.arctan2(fy, fx)[used]
    total = power.sum()
    if total == 0:
        return 0j, 1.0
    variance = (power**2).sum() / total**2 / _INDEPENDENT**2
    return complex((power * np.exp(2j * angle)).sum() / total), float(variance)


def line_period(means_um: Sequence[Array], pitch_um: float) -> LinePeriod | None:
    """Find the strongest period that the line means of all scans share. Return None if a scan has fewer than
    64 lines.

    If lines are random, the mean periodogram of F scans, divided by its smooth level, is distributed as
    Gamma(F) / F. The level is a parabola fitted to the logarithms of the power at the surrounding
    frequencies, and its uncertainty is integrated out. The p-value of the largest peak is corrected for the
    number of frequencies (Bonferroni).

    Args:
        means_um: mean height of each line, one array per scan; all arrays are cropped to the shortest.
        pitch_um: distance between lines, µm.
    """
    count, scans = min(len(own) for own in means_um), len(means_um)
    if count < FEWEST_LINES:
        return None
    taper = np.hanning(count)
    spectra = np.stack(
        [np.abs(np.fft.rfft(taper * (own[:count] - own[:count].mean()))) ** 2 for own in means_um]
    )
    # Scans differ in roughness, so each is divided by its own level.
    floor = np.finfo(float).tiny
    spectra = (spectra / np.maximum(np.median(spectra, axis=1, keepdims=True), floor))[:, _FIRST:]
    power = np.maximum(spectra.mean(axis=0), floor)
    level, chance = _against_surroundings(power, scans)
    peak = int(np.argmin(chance))
    near = slice(max(0, peak - 2), peak + 3)
    centre = float(np.average(np.arange(len(power))[near] + _FIRST, weights=power[near]))
    share = np.maximum(power[near] - level[near], 0).sum() / power.sum()
    waves = taper * np.exp(-2j * np.pi * centre * np.arange(count) / count) * 2 / taper.sum()
    amplitudes = np.array([waves @ (own[:count] - own[:count].mean()) for own in means_um])
    sizes = np.maximum(np.abs(amplitudes), floor)
    return LinePeriod(
        period_um=count * pitch_um / centre,
        share=float(share),
        p=min(1.0, len(power) * float(chance[peak])),
        amplitude_um=float(np.sqrt(np.mean(sizes**2))),
        coherence=float(np.abs((amplitudes / sizes).mean())),
    )


def _against_surroundings(power: Array, scans: int) -> tuple[Array, Array]:
    """For each frequency, return the power level given by the surrounding frequencies, and the probability
    that the actual power exceeds this level so far by chance.
    """
    position = np.arange(len(power))
    logarithm = np.log(power) - digamma(scans) + np.log(scans)
    level, chance = np.empty(len(power)), np.empty(len(power))
    for at in position:
        apart = position - at
        around = (np.abs(apart) <= _AROUND) & (np.abs(apart) > _OWN)
        basis = np.vander(apart[around] / _AROUND, 3, increasing=True)
        inverse = np.linalg.pinv(basis)
        fitted = inverse[0] @ logarithm[around]
        variance = polygamma(1, scans) * (inverse[0] @ inverse[0]) / _INDEPENDENT
        ratio = power[at] / np.exp(fitted - np.sqrt(variance) * _QUANTILES)
        level[at], chance[at] = np.exp(fitted), gammaincc(scans, scans * ratio).mean()
    return level, chance
