"""Measure the period of a grating: first roughly from the peak of its spectrum, then precisely from how the
phase changes across the field.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from litho_data.foundation import YX, Array, InputError
from litho_data.foundation.results import Record
from litho_data.scan import Axis

# Range in which the period is searched, as a factor: an uncalibrated scanner may show a period that is wrong
# by up to this factor.
SEARCHED = 1.25
# Width of the windows in which phases are measured, and smallest accepted length of the scan, both in
# periods. A Hann window of two periods suppresses the harmonics of the grating. What is left of them changes
# all phases equally, because the windows are one period apart. A straight line is fitted to the phases, so
# several windows side by side are needed.
_WINDOW_PERIODS, _FEWEST_PERIODS = 2.0, 8.0
# Largest accepted scatter of the phases. Phases of pure noise scatter by 1.8 rad.
_MOST_SCATTER_RAD = 0.5
# Factor by which the overlap of the windows increases the variance of the fit. Neighbouring windows overlap
# by half, so the noise of each window is correlated with that of the two windows beside it. The correlation
# is between 1/6 and 2/9, depending on where in the windows the bars are.
_OVERLAP_VARIANCE = 1 + 2 * 2 / 9


@dataclass(frozen=True)
class Wave:
    """The fundamental wave of a grating: its spatial frequencies along x and y, and their standard
    uncertainty, all in cycles/µm.
    """

    x_per_um: float
    y_per_um: float
    uncertainty_per_um: float


class Scale(Record):
    """The scale of an axis: the factor that converts lengths stated by the microscope to true lengths, and
    its standard uncertainty.
    """

    factor: float
    uncertainty: float


def find_wave(height_um: Array, pitch_um: YX, period_um: float, axis: Axis) -> Wave:
    """Find the fundamental wave of a grating that repeats along an axis, or within 15° of this direction.

    The phase is measured in Hann windows that are two periods wide along the axis and extend over the whole
    length of the other axis. A straight line is fitted to the phases, and its slope is the correction of the
    frequency. The scatter of the phases about this line gives an uncertainty that includes the effects of
    noise, drift and a bent scanner axis.

    Args:
        height_um: heights in µm, shape (ny, nx); NaN where not measured.
        pitch_um: stated pixel pitch along y and x, µm.
        period_um: known period of the grating, µm. The search covers periods from ``period_um / SEARCHED`` to
            ``period_um * SEARCHED``.
        axis: the axis along which the grating repeats.

    Raises:
        InputError: the scan shows fewer than eight periods, or nothing periodic.
    """
    lines = height_um if axis == "x" else height_um.T
    along_um, across_um = pitch_um[::-1] if axis == "x" else pitch_um
    extent_um = lines.shape[1] * along_um
    if extent_um < _FEWEST_PERIODS * period_um or period_um < 4 * along_um:
        raise InputError(
            f"grating along {axis}",
            got=f"{extent_um / period_um:.1f} periods of {period_um / along_um:.1f} pixels",
            wanted=f"at least {_FEWEST_PERIODS:g} periods of at least 4 pixels",
        )
    flat = np.nan_to_num(lines - np.nanmean(lines))
    at = _peak(flat, (along_um, across_um), period_um)
    for _ in range(3):
        step, error, scatter = _advance(flat, (along_um, across_um), at)
        if not scatter < _MOST_SCATTER_RAD:
            raise InputError(
                f"grating along {axis}",
                got=f"nothing that repeats every {period_um:g} µm (the phase scatters by {scatter:.1f} rad)",
                wanted="a scan of a grating of this period",
            )
        at = at + step
    x, y = at if axis == "x" else at[::-1]
    return Wave(float(x), float(y), error)


def line_bow(height_um: Array, pitch_um: YX, wave: Wave) -> tuple[float, float]:
    """Measure how far the middle of a scan line is displaced along x relative to the ends of the line. Return
    the displacement and its standard uncertainty, in µm.

    A displacement b means that the pixel at x on a line of length L shows the point x + 4 b (x / L) (1 - x /
    L) of the surface, apart from a shift and a change of scale of the whole line.

    Args:
        height_um: heights of a grating that repeats along x, in µm, shape (ny, nx).
        pitch_um: stated pixel pitch along y and x, µm.
        wave: the wave of the grating, as measured by ``find_wave``.
    """
    y, x = (np.arange(n) * step for n, step in zip(height_um.shape, pitch_um, strict=True))
    flat = np.nan_to_num(height_um - np.nanmean(height_um))
    across = (flat * np.exp(-2j * np.pi * wave.y_per_um * y[:, None])).mean(axis=0)
    places, phases = _phases(across * np.exp(-2j * np.pi * wave.x_per_um * x), x, 1 / wave.x_per_um)
    displaced_um = phases / (2 * np.pi * wave.x_per_um)
    from_middle = 2 * (places - x.mean()) / (len(x) * pitch_um[1])
    weight, error, _ = _last_weight([np.ones_like(places), from_middle, -(from_middle**2)], displaced_um)
    return weight, error


def axis_scales(waves: Sequence[tuple[Wave, float, float]], axes: Sequence[Axis]) -> dict[Axis, Scale]:
    """Return the scales of the axes for which gratings were measured. The scanner is assumed to have no
    shear.

    If stated lengths along an axis are too short by the factor c, measured frequencies along this axis are
    too high by the factor c. A grating with the measured frequencies f_x and f_y along the two axes therefore
    has the true squared frequency (f_x / c_x)² + (f_y / c_y)², whatever its angle.

    Args:
        waves: for each grating, the measured wave, the known period and its standard uncertainty (µm).
        axes: for each grating, the axis that it calibrates. An axis without a grating is assumed to have a
            correct scale.
    """
    design = np.array([[wave.x_per_um**2, wave.y_per_um**2] for wave, _, _ in waves])
    known = np.array([1 / period_um**2 for _, period_um, _ in waves])
    columns = [0 if axis == "x" else 1 for axis in axes]
    others = [column for column in (0, 1) if column not in columns]
    solved = np.linalg.solve(design[:, columns], known - design[:, others].sum(axis=1))
    found: dict[Axis, Scale] = {}
    for value, axis, (wave, period_um, period_sd_um) in zip(solved, axes, waves, strict=True):
        factor = float(value**-0.5)
        relative = np.hypot(wave.uncertainty_per_um * period_um / factor, period_sd_um / period_um)
        found[axis] = Scale(factor=factor, uncertainty=factor * float(relative))
    return found


def _peak(flat: Array, pitch_um: YX, period_um: float) -> Array:
    """Return the frequency with the highest power in the searched range, at most 15° from the axis. The
    result contains its components along and across the axis.
    """
    ny, nx = flat.shape
    windowed = flat * np.outer(np.hanning(ny), np.hanning(nx))
    power = np.abs(np.fft.fft2(windowed)[:, : nx // 2 + 1]) ** 2
    along = np.fft.rfftfreq(nx, pitch_um[0])[None, :]
    across = np.fft.fftfreq(ny, pitch_um[1])[:, None]
    inside = (np.abs(np.log(np.hypot(along, across).clip(1e-12) * period_um)) < np.log(SEARCHED)) & (
        np.abs(across) < np.tan(np.radians(15)) * along
    )
    row, column = np.unravel_index(np.argmax(np.where(inside, power, -1.0)), power.shape)
    return np.array([along[0, column], across[row, 0]])


def _advance(flat: Array, pitch_um: YX, at: Array) -> tuple[Array, float, float]:
    """Return the correction that is to be added to the frequency ``at`` (its components along and across the
    axis), the uncertainty of the component along the axis, and the scatter of the phases in rad.
    """
    x, y = (np.arange(n) * step for n, step in zip(flat.shape[::-1], pitch_um, strict=True))
    carried = flat * np.exp(-2j * np.pi * (at[0] * x[None, :] + at[1] * y[:, None]))
    places, phases = _phases(carried.mean(axis=0), x, 1 / at[0])
    slope, error, scatter = _line(places, phases)
    # The grating is only slightly rotated, so the phases of four bands of rows are enough to measure its
    # angle. Within each band, all other waves average out.
    window = np.hanning(len(x))
    bands = [band @ window for band in np.array_split(carried, 4)]
    centres = np.array([band.mean() for band in np.array_split(y, 4)])
    sums = np.array([band.sum() for band in bands])
    tilt, _, _ = _line(centres, np.unwrap(np.angle(sums)))
    return np.array([slope, tilt]) / (2 * np.pi), error / (2 * np.pi), scatter


def _phases(carried: Array, x_um: Array, period_um: float) -> tuple[Array, Array]:
    """Measure the phase of a wave in windows one period apart.

    In each window, the tilt and the bow of the scanner appear as a slope, which a Hann window does not
    cancel. So the wave, its conjugate, a constant and a slope are fitted together.

    Args:
        carried: profile multiplied by the conjugate of the wave exp(2πi x / period_um), shape (nx,), complex.
    """
    width_um = _WINDOW_PERIODS * period_um
    places = np.arange(x_um[0] + width_um / 2, x_um[-1] - width_um / 2, width_um / 2)
    distance = (x_um[None, :] - places[:, None]) / width_um
    windows = np.where(np.abs(distance) < 0.5, np.cos(np.pi * distance) ** 2, 0.0)
    # Multiplied by the conjugate wave, a constant becomes this function, and the conjugate wave becomes the
    # square of this function.
    constant = np.exp(-2j * np.pi * x_um / period_um)
    columns = [np.ones_like(constant), constant**2, constant, (x_um - x_um.mean()) / width_um * constant]
    design = np.column_stack(columns)
    products = design.conj()[:, :, None] * design[:, None, :]
    normal = np.tensordot(windows, products, 1)
    weights = np.linalg.solve(normal, (windows @ (design.conj() * carried[:, None]))[:, :, None])
    return places, np.unwrap(np.angle(weights[:, 0, 0]))


def _line(places: Array, phases: Array) -> tuple[float, float, float]:
    """Fit a straight line to phases. Return its slope, the standard uncertainty of the slope, and the scatter
    of the phases about the line.
    """
    return _last_weight([np.ones_like(places), places - places.mean()], phases)


def _last_weight(columns: list[Array], values: Array) -> tuple[float, float, float]:
    """Fit values by a linear combination of columns (least squares). Return the coefficient of the last
    column, the standard uncertainty of this coefficient, and the scatter of the values about the fit.
    """
    design = np.column_stack(columns)
    weights, *_ = np.linalg.lstsq(design, values, rcond=None)
    rest = values - design @ weights
    freedom = max(len(values) - len(columns), 1)
    scatter = float(np.sqrt(rest @ rest / freedom))
    error = scatter * np.sqrt(_OVERLAP_VARIANCE * np.linalg.inv(design.T @ design)[-1, -1])
    return float(weights[-1]), _wider(freedom) * float(error), scatter


def _wider(freedom: int) -> float:
    """Return the standard deviation of Student's t with this number of degrees of freedom. For one or two
    degrees of freedom it is not finite, and 3 is returned.

    An uncertainty that is computed from the scatter of a few phases is multiplied by this factor.
    """
    return (freedom / (freedom - 2)) ** 0.5 if freedom > 2 else 3.0
