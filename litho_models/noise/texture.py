"""Describe the texture of flat surfaces. The description states whether the texture consists of lines, in
which direction the lines run, and with which period they repeat.

The paper says that the roughness of its flat print is line-shaped and not periodic (arXiv:2309.17343).
"""

from collections.abc import Sequence

import numpy as np

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness import line_direction, line_period

RARE = 1e-3


class Period(Record):
    """The strongest period with which lines repeat.

    Args:
        period_um: distance at which the lines repeat, µm.
        share: fraction of the sum of squares of the line means that is due to this period.
        p: p value of the peak. It is the probability that random line means with a smooth spectrum have a
            peak that is at least as significant, at any frequency.
        amplitude_nm: amplitude of the oscillation with this period, as root mean square over the surfaces.
        coherence: agreement between the surfaces in the phase of the lines; 1 if the phase is the same on all
            surfaces. The phase is counted from the first pixel of each array.
    """

    period_um: float
    share: float
    p: float
    amplitude_nm: float
    coherence: float


class Lines(Record):
    """The lines of a texture along one axis.

    Args:
        along: axis along which the lines run: ``x`` (rows) or ``y`` (columns).
        share: variance of the means of the lines, as a fraction of the variance of the surface. This share is
            above zero even for a surface without lines. To find out whether there are lines, compare the
            shares of the two axes.
        period: strongest period of the means of the lines; None if there are fewer than 64 lines.
    """

    along: str
    share: float
    period: Period | None


class Texture(Record):
    """The texture that one or more surfaces of one kind have in common.

    Args:
        angle_deg: direction of the lines in degrees; 0 is along x, and positive angles turn from x to y.
        strength: how strongly one direction prevails; 0 if all directions are alike, 1 if all lines have one
            direction.
        isotropic_p: p value of the direction, i.e. the probability that an isotropic surface has at least
            this ``strength``.
        lines: results for the lines along x, then for the lines along y.
    """

    id: str
    surfaces: int
    angle_deg: float
    strength: float
    isotropic_p: float
    lines: list[Lines]

    @property
    def verdict(self) -> str:
        """Return a phrase that states whether the texture has a direction and a period. The significance
        level is 1 in 1,000.
        """
        directed = (
            f"line-shaped, along {self.angle_deg:.0f}° from x" if self.isotropic_p < RARE else "no direction"
        )
        periods = [
            f"period of {one.period.period_um:.3g} µm across lines along {one.along} "
            f"(amplitude {one.period.amplitude_nm:.1f} nm, {100 * one.period.share:.0f} % of the sum of "
            "squares of the line means)"
            for one in self.lines
            if one.period is not None and one.period.p < RARE
        ]
        return f"{directed}; {', '.join(periods) or 'not periodic'}"


def texture(name: str, heights_um: Sequence[np.ndarray], pitch_um: float) -> Texture:
    """Measure the texture of levelled surfaces whose scans have square pixels.

    Each surface is an array of heights, µm, of shape (ny, nx). Pixels that are NaN are left out.

    Raises:
        InputError: a surface has fewer than 64 rows or columns.
    """
    direction = line_direction(heights_um)
    return Texture(
        id=name,
        surfaces=len(heights_um),
        angle_deg=direction.angle_deg,
        strength=direction.strength,
        isotropic_p=direction.p,
        lines=[_lines(heights_um, pitch_um, along) for along in ("x", "y")],
    )


def _lines(heights_um: Sequence[np.ndarray], pitch_um: float, along: str) -> Lines:
    axis = 1 if along == "x" else 0
    means = [_line_means(np.asarray(height, np.float64) - np.nanmean(height), axis) for height in heights_um]
    variances = [float(np.nanvar(height)) for height in heights_um]
    shares = [own.var() / all_of_it for own, all_of_it in zip(means, variances, strict=True) if all_of_it > 0]
    period = None
    if found := line_period(means, pitch_um):
        period = Period(
            period_um=found.period_um,
            share=found.share,
            p=found.p,
            amplitude_nm=NM_PER_UM * found.amplitude_um,
            coherence=found.coherence,
        )
    return Lines(along=along, share=float(np.mean(shares)) if shares else 0.0, period=period)


def _line_means(height_um: np.ndarray, axis: int) -> np.ndarray:
    """Return the mean of each line. ``height_um`` must have zero mean. A line without measured pixels gets
    this mean, i.e. zero.
    """
    measured = np.isfinite(height_um)
    return np.where(measured, height_um, 0).sum(axis=axis) / np.maximum(measured.sum(axis=axis), 1)
