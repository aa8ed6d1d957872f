"""Measure step heights line by line, in the windows of ISO 5436-1 away from the edges."""

from collections.abc import Sequence

import numpy as np

from litho_data.foundation import Array, InputError
from litho_data.foundation.results import Record
from litho_data.roughness.spectrum import lines_nm
from litho_data.scan import Axis

# An edge counts only if the profile changes there by more than this many times the median change. On a rough
# surface without a step, the largest change is 4 to 5 times the median change.
_EDGE_SIGMA = 9.0
# Smallest number of measured positions: two treads of three pixels each.
_FEWEST_COLUMNS = 6


class StepHeight(Record):
    """The measured height of one step.

    Args:
        height_nm: height of the step, averaged over the lines.
        line_sd_nm: standard deviation of the step heights of the individual lines.
        uncertainty_nm: standard uncertainty of ``height_nm``, computed from the standard deviation and the
            number of independent lines. It does not include the uncertainty of the microscope's height scale.
        lines: number of lines that were fitted.
    """

    height_nm: float
    line_sd_nm: float
    uncertainty_nm: float
    lines: int


def groove_depth(height_um: Array, pitch_um: float, *, left_um: float, right_um: float) -> StepHeight:
    """Return the height of a ridge or groove of type A1 (ISO 5436-1) above its surroundings, positive for a
    ridge and negative for a groove.

    ``z = a·x + b + h·δ`` is fitted to every line, where δ is 1 on the middle third of the feature and 0 on
    two reference sections (arms) beside it. The fitted h is the height. If W is the width of the feature, the
    arms cover the distances from W/3 to W outside its edges, so the profile spans three widths.

    Args:
        height_um: heights in µm, shape (ny, nx); NaN is ignored.
        left_um: position of the first edge along x, in µm from the field's border.
        right_um: position of the second edge, in µm from the same border.

    Raises:
        InputError: the edges are in the wrong order, or the arms extend beyond the field.
    """
    width_um = right_um - left_um
    lines, position_um = _profiles(height_um, pitch_um, "x")
    extent_um = lines.shape[1] * pitch_um
    if width_um <= 0 or left_um - width_um < -1e-9 or right_um + width_um > extent_um + 1e-9:
        raise InputError(
            "edges of a groove",
            got=f"{left_um:g} and {right_um:g} µm",
            wanted=f"left < right, with one width free on both sides in a field of {extent_um:g} µm",
        )
    third_um = width_um / 3
    feature = (position_um >= left_um + third_um) & (position_um <= right_um - third_um)
    before = (position_um >= left_um - width_um) & (position_um <= left_um - third_um)
    after = (position_um >= right_um + third_um) & (position_um <= right_um + width_um)
    return _fit_steps(lines, [position_um], [before | after, feature])[0]


def stair_steps(
    height_um: Array, pitch_um: float, *, edges_um: Sequence[float], axis: Axis = "x"
) -> list[StepHeight]:
    """Return the heights of the steps of a staircase, one for each edge. A height is positive if the surface
    rises along the axis.

    Treads are the flat parts between the edges. For every line, one height per tread and one slope common to
    all treads are fitted to the middle thirds of the treads. The height of a step is the difference between
    the heights of two neighbouring treads.

    Args:
        edges_um: positions of the edges along the axis in µm, in ascending order.

    Raises:
        InputError: the edges are not ascending positions inside the field, or a tread is narrower than 3
            pixels.
    """
    lines, position_um = _profiles(height_um, pitch_um, axis)
    return _fit_steps(lines, [position_um], _middle_thirds(position_um, pitch_um, edges_um))


def _middle_thirds(position_um: Array, pitch_um: float, edges_um: Sequence[float]) -> list[Array]:
    limits_um = np.array([0.0, *edges_um, position_um.size * pitch_um])
    widths_um = np.diff(limits_um)
    if len(edges_um) == 0 or widths_um.min() < 3 * pitch_um:
        raise InputError(
            "edges of a staircase",
            got=list(edges_um),
            wanted="ascending positions inside the field, at least 3 pixels apart",
        )
    return [
        (position_um >= start + width / 3) & (position_um <= start + 2 * width / 3)
        for start, width in zip(limits_um[:-1], widths_um, strict=True)
    ]


def _profiles(height_um: Array, pitch_um: float, axis: Axis) -> tuple[Array, Array]:
    lines = lines_nm(height_um, axis)
    return lines, (np.arange(lines.shape[1]) + 0.5) * pitch_um


def _fit_steps(lines: Array, background: list[Array], treads: list[Array]) -> list[StepHeight]:
    """Fit one height per tread, plus background functions that all treads have in common, to each line.
    Return the height of each step, averaged over the lines.
    """
    used = np.any(treads, axis=0)
    centred = [function - function.mean() for function in background]
    design = np.stack([*centred, *(tread.astype(float) for tread in treads)], axis=1)[used]
    heights = []
    for line in lines[:, used]:
        finite = np.isfinite(line)
        if np.linalg.matrix_rank(design[finite]) < design.shape[1]:
            continue
        weights, *_ = np.linalg.lstsq(design[finite], line[finite], rcond=None)
        heights.append(np.diff(weights[len(background) :]))
    if len(heights) < 2:
        raise InputError("lines that show all treads of a step", got=len(heights), wanted="at least 2")
    return [_summary(step) for step in np.array(heights).T]


def _summary(step_nm: Array) -> StepHeight:
    sd_nm = float(step_nm.std(ddof=1))
    # The roughness of a print is correlated between neighbouring lines, so not every line counts as
    # independent.
    independent = _independent_lines(step_nm) if sd_nm > 0 else float(step_nm.size)
    return StepHeight(
        height_nm=float(step_nm.mean()),
        line_sd_nm=sd_nm,
        uncertainty_nm=sd_nm / float(np.sqrt(independent)),
        lines=int(step_nm.size),
    )


def _independent_lines(values: Array) -> float:
    """Return the effective number of independent lines, n / (1 + 2 Σ ρ), where ρ is the autocorrelation of
    the values of n lines. The sum ends before the first lag at which ρ is negative.
    """
    deviation = values - values.mean()
    correlation = np.correlate(deviation, deviation, "full")[values.size - 1 :] / (deviation @ deviation)
    negative = np.flatnonzero(correlation < 0)
    until = int(negative[0]) if negative.size else correlation.size
    return float(values.size / max(1.0, 1 + 2 * correlation[1:until].sum()))


def find_step(height_um: Array, pitch_um: float, *, axis: Axis = "x") -> StepHeight:
    """Find the edges of a step, ridge, groove or row of grooves in a scan, and return the mean height of the
    steps at these edges.

    The slope of the field is removed from the median profile. An edge is a place where this profile changes
    by at least half of its largest change. The heights of the steps are fitted as in ``stair_steps``, and
    their absolute values are averaged. A raw scan shows the bow of the scanner, so a curvature common to all
    treads is fitted too. Steps of one scan share treads, so their errors are not independent. The stated
    uncertainty is therefore the uncertainty of a single step; it is not divided by the root of the number of
    steps.

    Args:
        height_um: heights in µm, shape (ny, nx); NaN where not measured.

    Raises:
        InputError: no edge stands out from the profile, or edges are closer than three pixels.
    """
    lines, position_um = _profiles(height_um, pitch_um, axis)
    measured = np.flatnonzero(np.isfinite(lines).any(axis=0))
    if measured.size < _FEWEST_COLUMNS:
        raise InputError(
            f"step along {axis}",
            got=f"{measured.size} measured positions",
            wanted=f"at least {_FEWEST_COLUMNS}",
        )
    # Unmeasured borders are cut off, and gaps are bridged by straight lines.
    lines = lines[:, measured[0] : measured[-1] + 1]
    places = measured - measured[0]
    position_um = position_um[: lines.shape[1]]
    profile = np.interp(np.arange(lines.shape[1]), places, np.nanmedian(lines[:, places], axis=0))
    width = max(2, profile.size // 50)
    sums = np.cumsum(np.insert(profile, 0, 0.0))
    means = (sums[width:] - sums[:-width]) / width
    change = means[width:] - means[:-width]
    change = change - np.median(change)
    largest, usual = np.abs(change).max(), np.median(np.abs(change))
    if not largest > _EDGE_SIGMA * usual:
        raise InputError(
            f"step along {axis}",
            got="no edge that stands out from the profile",
            wanted="a scan of a step or groove whose edges lie across this axis",
        )
    steep = np.flatnonzero(np.abs(change) > largest / 2)
    edges = [
        float(np.average(group + width, weights=np.abs(change[group])) * pitch_um)
        for group in np.split(steep, np.flatnonzero(np.diff(steep) > 1) + 1)
    ]
    along = np.linspace(-1, 1, profile.size)
    steps = _fit_steps(lines, [along, along**2], _middle_thirds(position_um, pitch_um, edges))
    return StepHeight(
        height_nm=float(np.mean([abs(step.height_nm) for step in steps])),
        line_sd_nm=float(np.mean([step.line_sd_nm for step in steps])),
        uncertainty_nm=float(np.sqrt(np.mean([step.uncertainty_nm**2 for step in steps]))),
        lines=min(step.lines for step in steps),
    )
