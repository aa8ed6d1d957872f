"""Draw random curves and maps: Perlin noise, smooth maps, and roughness with a given spectrum."""

import numpy as np

from litho_data.foundation import Array, Shape
from litho_data.virtual_fab.canvas import apply_transfer, frequencies_per_um

# Spectrum of the fine structure that was found in measured prints and that no model explains. Across the
# hatch lines, it consists of a band around a period of 0.45 µm and a part with longer periods. Along the
# hatch lines, both parts vary slowly.
_BAND_PER_UM = 2.2
_BAND_WIDTH_PER_UM = 0.5
_BAND_SHARE = 0.55
_SLOW_WIDTH_PER_UM = 0.6
_ALONG_UM = 1.2
# Sigma of a blur along the hatch lines. A spot of 0.2 µm writes no finer structure along a line.
_SMOOTH_UM = 0.06


def line_roughness(shape: Shape, pitch_um: float, rng: np.random.Generator) -> Array:
    """Draw a map of roughness that looks like lines along x. The map has the given shape (ny, nx), and its
    variance is 1 on average.
    """
    return gaussian_field(line_roughness_psd(shape, pitch_um), rng, shape)


def line_roughness_psd(shape: Shape, pitch_um: float) -> Array:
    """Return the power spectrum of ``line_roughness`` at the frequencies of rfft2, in arbitrary units."""
    frequency_y, frequency_x = frequencies_per_um(shape, pitch_um)
    band = np.exp(-((np.abs(frequency_y) - _BAND_PER_UM) ** 2) / (2 * _BAND_WIDTH_PER_UM**2))
    slow = np.exp(-(frequency_y**2) / (2 * _SLOW_WIDTH_PER_UM**2))
    across = _BAND_SHARE * band / band.sum() + (1 - _BAND_SHARE) * slow / slow.sum()
    along = np.exp(-4 * (np.pi * _SMOOTH_UM * frequency_x) ** 2) / (
        1 + (2 * np.pi * _ALONG_UM * frequency_x) ** 2
    )
    return across * along


def gaussian_field(psd: Array, rng: np.random.Generator, shape: Shape) -> Array:
    """Draw a Gaussian random field with the given shape (ny, nx) and power spectrum. Its variance is 1 on
    average.

    ``psd`` contains the power at the frequencies of rfft2, in any units.
    """
    # Each column of rfft2 represents two columns of the full spectrum, except column 0 and the Nyquist
    # column.
    doubled = np.full(psd.shape[1], 2.0)
    doubled[0] = 1.0
    if shape[1] % 2 == 0:
        doubled[-1] = 1.0
    mean_power = (psd * doubled).sum() / (shape[0] * shape[1])
    return apply_transfer(rng.standard_normal(shape), np.sqrt(psd / mean_power))


def perlin_curve(position_um: Array, period_um: float, rng: np.random.Generator) -> Array:
    """Draw one-dimensional Perlin noise between -1 and 1, at the given positions. The result has the shape of
    ``position_um``.
    """
    slopes = rng.uniform(-1, 1, 1024)
    cell, inside = np.divmod(position_um / period_um, 1.0)
    left = cell.astype(int) % slopes.size
    right = (left + 1) % slopes.size
    fade = inside**3 * (inside * (6 * inside - 15) + 10)
    # With slopes up to 1, the noise reaches at most 0.5, hence the factor 2.
    return 2 * ((1 - fade) * slopes[left] * inside + fade * slopes[right] * (inside - 1))


def smooth_map(y_um: Array, x_um: Array, period_um: float, rng: np.random.Generator) -> Array:
    """Draw a smooth map: the sum of eight plane waves with random directions and phases, and with periods
    near ``period_um``. On average, the variance of the map is 1.
    """
    waves = 8
    direction = rng.uniform(0, 2 * np.pi, waves)
    phase = rng.uniform(0, 2 * np.pi, waves)
    frequency = rng.uniform(0.7, 1.3, waves) / period_um
    total = np.zeros(np.broadcast_shapes(y_um.shape, x_um.shape))
    for angle, start, rate in zip(direction, phase, frequency, strict=True):
        total += np.cos(2 * np.pi * rate * (x_um * np.cos(angle) + y_um * np.sin(angle)) + start)
    return total * np.sqrt(2 / waves)
