"""Describe the texture of flat surfaces: whether it has lines, in which direction, and with which period.

The paper calls the roughness of its flat print line-shaped and not periodic (arXiv:2309.17343).
"""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness import line_direction, line_period

RARE = 1e-3


class Period(Record, extra="ignore"):
    """A period of lines.

    Args:
        period_um: distance at which lines repeat.
        share: fraction of the sum of the squared line means that has this period.
        p: chance that a smooth spectrum contains a peak of at least this height at any frequency.
        amplitude_nm: root mean square of the amplitude over the surfaces.
        coherence: 1 if the lines have the same phase in all surfaces, in the coordinates of the given arrays.
    """

    period_um: float
    share: float
    p: float
    amplitude_nm: float
    coherence: float


class Lines(Record):
    """Lines along one axis.

    Args:
        along: ``x`` (rows) or ``y`` (columns).
        share: fraction of the surface's variance that is in the means of the lines. It is above zero even for
            a surface without lines, so compare the two axes.
        period: the strongest period of these means; None with fewer than 64 lines.
    """

    along: str
    share: float
    period: Period | None


class Texture(Record):
    """Texture of surfaces of one kind.

    Args:
        angle_deg: direction of the lines, 0 along x, positive from x to y.
        strength: directional strength; 0 if all directions are alike, 1 if all lines have one direction.
        isotropic_p: the chance of at least this strength on an isotropic surface.
        lines: the lines along x and the lines along y.
    """

    id: str
    surfaces: int
    angle_deg: float
    strength: float
    isotropic_p: float
    lines: list[Lines]

    @property
    def verdict(self) -> str:
        """State whether the texture is directional and periodic, at a significance level of 1 in 1,000."""
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
    """Measure the texture of levelled surfaces with square pixels.

    Each surface is an array (ny, nx) of heights in µm. Pixels that are NaN are left out.

    Raises:
        InputError: a surface of fewer than 64 rows or columns.
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
        period = Period(**asdict(found), amplitude_nm=NM_PER_UM * found.amplitude_um)
    return Lines(along=along, share=float(np.mean(shares)) if shares else 0.0, period=period)


def _line_means(height_um: np.ndarray, axis: int) -> np.ndarray:
    """Return the mean of each line; lines without a measured pixel get the mean of all lines."""
    measured = np.isfinite(height_um)
    return np.where(measured, height_um, 0).sum(axis=axis) / np.maximum(measured.sum(axis=axis), 1)
