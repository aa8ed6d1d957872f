"""Find the direction and the period of lines on a surface, and test whether a surface without lines could
show them by chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, gammaincc, ndtri, polygamma

from litho_data.foundation import Array, InputError
from litho_data.roughness.spectrum import hann

FEWEST_LINES = 64
# A peak is compared with the powers at up to this many frequencies on either side. The frequencies closest to
# the peak are left out, because a Hann window spreads the peak over them.
_AROUND = 16
_OWN = 3
# Effective share of the powers that are independent of one another. With a Hann window, powers at frequencies
# that are 0, 1 or 2 steps apart have a correlation of 1, 4/9 or 1/36.
_INDEPENDENT = 1 / (1 + 2 * 4 / 9 + 2 / 36)
_QUANTILES = ndtri((np.arange(200) + 0.5) / 200)
# Lowest frequency that is used, in cycles per field. Lower frequencies contain the rest of a bow that
# levelling did not remove.
_FIRST = 3


@dataclass(frozen=True)
class LineDirection:
    """Direction of the lines of a surface.

    Args:
        angle_deg: angle between the lines and the rows in degrees, from -90 (excluded) to 90. Lines along x
            have the angle 0; positive angles turn from x towards y.
        strength: length of the mean double-angle vector of the power spectrum (see ``line_direction``); 0 for
            an isotropic surface, 1 for lines that all have the same direction.
        p: probability that an isotropic surface shows at least this strength by chance (Rayleigh's test).
    """

    angle_deg: float
    strength: float
    p: float


@dataclass(frozen=True)
class LinePeriod:
    """The strongest period with which lines repeat.

    Args:
        period_um: period at the centre of the peak that rises furthest above the spectrum around it.
        share: share of the power of the line means (the mean height of each line) that lies in the peak.
        p: probability that a surface with a smooth spectrum shows such a peak at any frequency by chance.
        amplitude_um: amplitude of the wave with this period, as a root mean square over the surfaces.
        coherence: agreement between the surfaces in the phase of this wave. For each surface, the phase of
            the wave is written as a complex number of modulus 1. The coherence is the modulus of the mean of
            these numbers. It is 1 if all surfaces have the same phase, and about 1 / √F if the phases of F
            surfaces are independent.
    """

    period_um: float
    share: float
    p: float
    amplitude_um: float
    coherence: float


def line_direction(heights_um: Sequence[Array]) -> LineDirection:
    """Find the direction in which surfaces change least, from their power spectra.

    For each frequency (fx, fy), a vector is computed. Its length is the power at this frequency, and its
    angle is twice the angle of (fx, fy), so that opposite directions count as the same. The direction of the
    lines follows from the mean of these vectors. The powers of each surface are divided by their sum. The
    powers P of a random surface are exponentially distributed. For an isotropic surface, the mean vector is
    therefore normally distributed with variance 1 / n, where n is the effective number of independent
    frequencies: (Σ P)² / Σ P², reduced because the Hann window correlates neighbouring powers.

    Args:
        heights_um: levelled heights in µm, one array of shape (ny, nx) per surface. The pixels must be
            square; NaN is replaced by the mean.

    Raises:
        InputError: a surface has fewer than 64 rows or columns.
    """
    vectors, variances = zip(*(_mean_vector(height) for height in heights_um), strict=True)
    vector, variance = np.mean(vectors), np.mean(variances) / len(heights_um)
    # The power of lines lies at frequencies in the direction across the lines.
    across = 0.5 * float(np.degrees(np.angle(vector)))
    return LineDirection(
        angle_deg=across - 90 if across > 0 else across + 90,
        strength=float(np.abs(vector)),
        p=float(np.exp(-(np.abs(vector) ** 2) / variance)),
    )


def _mean_vector(height_um: Array) -> tuple[complex, float]:
    """Return the mean double-angle vector of the power spectrum of a surface, and the variance that this
    vector would have if the surface were isotropic.
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
    # Frequencies beyond the Nyquist frequency of the axes exist only in the four corners of the spectrum.
    # They would favour the diagonal directions.
    used = (radius >= _FIRST / min(ny, nx)) & (radius < 0.5)
    power, angle = power[used], np.arctan2(fy, fx)[used]
    total = power.sum()
    if total == 0:
        return 0j, 1.0
    variance = (power**2).sum() / total**2 / _INDEPENDENT**2
    return complex((power * np.exp(2j * angle)).sum() / total), float(variance)


def line_period(means_um: Sequence[Array], pitch_um: float) -> LinePeriod | None:
    """Find the strongest period that the line means (the mean height of each line) of all scans have in
    common. Return None if a scan has fewer than 64 lines.

    If the line means are random with a smooth spectrum, the mean periodogram of F scans, divided by this
    spectrum, is distributed as Gamma(F) / F. At each frequency, the smooth spectrum is estimated by a
    parabola fitted to the logarithms of the powers at the surrounding frequencies. The p-value is averaged
    over the uncertainty of this estimate. The p-value of the largest peak is corrected for the number of
    frequencies that were searched (Bonferroni).

    Args:
        means_um: line means in µm, one array per scan. All arrays are cropped to the length of the shortest.
        pitch_um: distance between lines, µm.
    """
    count, scans = min(len(own) for own in means_um), len(means_um)
    if count < FEWEST_LINES:
        return None
    taper = np.hanning(count)
    spectra = np.stack(
        [np.abs(np.fft.rfft(taper * (own[:count] - own[:count].mean()))) ** 2 for own in means_um]
    )
    # Scans differ in roughness, so the power spectrum of each is divided by its own median.
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
    """For each frequency, return the power expected from the powers at the surrounding frequencies, and the
    probability that chance alone gives at least the observed ratio of the power to the expected power.
    ``scans`` is the number of scans over which the powers were averaged.
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
