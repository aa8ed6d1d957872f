"""Evaluate prints of steps (staircases): find the areas of constant level (treads), measure the heights of
the steps between them, and judge whether neighbouring levels can be told apart (readability).
"""

from itertools import pairwise

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness import stair_steps
from litho_data.scan import Axis
from litho_models.noise.spread_scores import GAUSSIAN
from litho_models.scan_terms.term import smooth_shapes
from litho_models.scoring.statistics import rms

# Smallest readability at which single pixels of two neighbouring treads can be told apart. If the heights are
# Gaussian, 2.5 % of the pixels of each tread are then nearer to the height of the other tread.
READABLE_AT = 2 * GAUSSIAN.half_width(0.95)
# Pixels closer than this to an edge are not used. The distance is at least three standard deviations of the
# printer's blur, so that the blurred edges are left out.
_GUARD_UM = 0.75
# Width of the narrowest tread that is searched for, as a fraction of the width of the field.
_NARROWEST_TREAD = 1 / 25
_MOST_TREADS = 24


class Step(Record):
    """One step of a staircase. Heights are in nm.

    Args:
        readability: height of the step divided by ``sigma_nm``, the standard deviation of single pixels on
            its two treads.
        misread: share of misread pixels, averaged over the two treads of the step. A pixel is misread if its
            height is nearer to the mean of the other tread than to the mean of its own tread.
    """

    height_nm: float
    uncertainty_nm: float
    sigma_nm: float
    readability: float
    misread: float


class StepPrint(Record):
    """The results from a print of steps.

    Args:
        tread_sigma_nm: rms deviation of the height within the treads, after one tilt common to all treads is
            removed.
        tread_mae_nm: mean absolute deviation of the pixels from the median height of their tread.
        resolvable_step_nm: smallest height of a step at which single pixels of its treads can be told apart:
            3.92 times ``tread_sigma_nm``.
    """

    id: str
    axis: Axis
    edges_um: list[float]
    tread_means_nm: list[float]
    steps: list[Step]
    tread_sigma_nm: float
    tread_mae_nm: float
    resolvable_step_nm: float


def step_print(
    scan_id: str,
    height_um: Array,
    pitch_um: tuple[float, float],
    level_height_um: float,
) -> StepPrint:
    """Find the treads (areas of one height) of a staircase that rises along x or y, and evaluate its steps.

    Args:
        scan_id: name of the scan in the result.
        height_um: measured height, µm, with shape (ny, nx); NaN where it was not measured.
        pitch_um: pixel pitch along y and x, µm.
        level_height_um: nominal height of a step, µm. An edge between narrow treads is found only if their
            heights differ by at least about half this step.

    Raises:
        InputError: no step was found.
    """
    axis, edges_px = find_edges(height_um, level_height_um)
    along, pitch_along = (height_um, pitch_um[1]) if axis == "x" else (height_um.T, pitch_um[0])
    edges_um = [edge * pitch_along for edge in edges_px]
    treads = _treads(along.shape, edges_px, round(_GUARD_UM / pitch_along))
    flat_nm = NM_PER_UM * _without_plane(along, treads)
    heights = [flat_nm[:, tread][np.isfinite(flat_nm[:, tread])] for tread in treads]
    steps = []
    for step, (first, second) in zip(
        stair_steps(along, pitch_along, edges_um=edges_um), pairwise(heights), strict=True
    ):
        sigma = rms([first.std(), second.std()])
        steps.append(
            Step(
                height_nm=step.height_nm,
                uncertainty_nm=step.uncertainty_nm,
                sigma_nm=sigma,
                # Rounding to float32 changes a height of 1 µm by up to 6e-5 nm, so a σ below this value is
                # meaningless.
                readability=abs(step.height_nm) / max(sigma, 1e-4),
                misread=_misread(first, second),
            )
        )
    tread_sigma = rms([own.std() for own in heights])
    return StepPrint(
        id=scan_id,
        axis=axis,
        edges_um=edges_um,
        tread_means_nm=[float(own.mean() - heights[0].mean()) for own in heights],
        steps=steps,
        tread_sigma_nm=tread_sigma,
        tread_mae_nm=float(np.concatenate([np.abs(own - np.median(own)) for own in heights]).mean()),
        resolvable_step_nm=READABLE_AT * tread_sigma,
    )


def find_edges(height_um: Array, level_height_um: float) -> tuple[Axis, list[int]]:
    """Find the axis along which a staircase rises. Also return the indices of the pixels at which a new tread
    starts, in ascending order.

    A piecewise-constant function is fitted to the profile of the staircase. At each position along the axis,
    the profile is the median of the heights along the line parallel to the edges. The fit minimises the
    squared error plus a price for each edge. The price is the reduction of the squared error by an edge
    between two treads that have the smallest width and differ in height by half a level.

    A tilt along the axis would add edges, so the tilt is removed first. Columns or rows without a measured
    pixel are skipped.

    Raises:
        InputError: there is no edge along either axis.
    """
    found: dict[Axis, tuple[float, list[int]]] = {}
    for axis in ("x", "y"):
        along = height_um if axis == "x" else height_um.T
        measured = np.flatnonzero(np.isfinite(along).any(axis=0))
        profile = np.nanmedian(along[:, measured], axis=0)
        narrowest = max(3, int(len(profile) * _NARROWEST_TREAD))
        # If two pieces of w pixels each are joined to one, and their heights differ by d, the squared error
        # grows by w d²/2.
        price = narrowest * (level_height_um / 2) ** 2 / 2
        tilted = _piecewise_constant(profile, price, narrowest)
        profile = profile - _slope_of_treads(profile, measured, tilted) * measured
        edges = _piecewise_constant(profile, price, narrowest)
        means = [piece.mean() for piece in np.split(profile, edges)]
        found[axis] = (float(np.ptp(means)), [int(measured[edge]) for edge in edges])
    chosen = max(found, key=lambda name: found[name][0])
    if not found[chosen][1]:
        raise InputError(
            "step print",
            got="no step along x or y",
            wanted=f"steps of about {level_height_um:g} µm along one axis",
        )
    return chosen, found[chosen][1]


def _piecewise_constant(profile: Array, price: float, narrowest: int) -> list[int]:
    """Return the edges of the piecewise-constant function that minimises the squared error plus ``price`` for
    each edge. The minimum is found by dynamic programming.
    """
    size = len(profile)
    sums = np.concatenate([[0.0], np.cumsum(profile)])
    squares = np.concatenate([[0.0], np.cumsum(profile**2)])
    best = np.full(size + 1, np.inf)
    best[0] = -price
    last = np.zeros(size + 1, int)
    for stop in range(narrowest, size + 1):
        starts = np.arange(0, stop - narrowest + 1)
        total = sums[stop] - sums[starts]
        error = squares[stop] - squares[starts] - total**2 / (stop - starts)
        cost = best[starts] + error + price
        last[stop] = starts[np.argmin(cost)]
        best[stop] = cost.min()
    edges: list[int] = []
    stop = size
    while last[stop] > 0 and len(edges) < _MOST_TREADS:
        stop = int(last[stop])
        edges.append(stop)
    return edges[::-1]


def _slope_of_treads(profile: Array, position: Array, edges: list[int]) -> float:
    """Return the median slope of a profile between its edges, in µm per unit of ``position``. Some edges may
    have been found only because the profile is tilted. They do no harm, because between them the profile
    still has the slope of the tilt. Only the middle of each piece is used, because the blurred edges may
    reach far into a narrow tread. The result is 0 for a profile of fewer than two pixels.
    """
    if len(profile) < 2:
        return 0.0
    slopes = []
    for start, stop in pairwise([0, *edges, len(profile)]):
        inset = min(2 * (stop - start) // 5, (stop - start) // 2 - 1)
        middle = slice(start + inset, stop - inset)
        slopes.append(np.polyfit(position[middle], profile[middle], 1)[0])
    return float(np.median(slopes))


def _treads(shape: tuple[int, ...], edges_px: list[int], guard_px: int) -> list[slice]:
    """Return the range of columns of each tread, without ``guard_px`` columns at either end. In a narrow
    tread, only a third of its columns is left out at either end.
    """
    ends = pairwise([0, *edges_px, shape[1]])
    insets = [(start, stop, min(guard_px, (stop - start) // 3)) for start, stop in ends]
    return [slice(start + inset, stop - inset) for start, stop, inset in insets]


def _without_plane(height_um: Array, treads: list[slice]) -> Array:
    """Return the heights without the tilt that all treads have in common. The result is NaN outside the
    treads.
    """
    ny, nx = height_um.shape
    x, y = smooth_shapes((ny, nx))[:2]
    terms = [np.zeros((ny, nx)) for _ in treads]
    inside = np.zeros((ny, nx), bool)
    for term, tread in zip(terms, treads, strict=True):
        term[:, tread] = 1
        inside[:, tread] = True
    usable = inside & np.isfinite(height_um)
    design = np.stack([y[usable], x[usable], *(term[usable] for term in terms)], axis=1)
    weights, *_ = np.linalg.lstsq(design, height_um[usable].astype(np.float64), rcond=None)
    return np.where(usable, height_um - weights[0] * y - weights[1] * x, np.nan)


def _misread(first: Array, second: Array) -> float:
    below, above = sorted((first, second), key=np.mean)
    middle = (below.mean() + above.mean()) / 2
    return float((np.mean(below > middle) + np.mean(above < middle)) / 2)
