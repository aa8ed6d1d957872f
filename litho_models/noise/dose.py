"""Evaluate a dose matrix, which is a set of prints at different doses. For each dose, determine the height,
the roughness and the number of lost steps (steps that were printed much too low). Then recommend a dose.

The paper searches for a laser power in this way (appendix "Mask and optical elements fabrication"). The
evaluation uses all scans that state a dose. A layout is suitable if areas of one level are wider than the
blur of the printer, as in a step ladder.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from litho_data.foundation.kinds import Array
from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.noise.staircase import READABLE_AT
from litho_models.scoring.like_layouts import blurred_layout_um

# Pixels closer than this to a change of level are not used. The distance is about four standard deviations of
# the optical spot, or two standard deviations of a diffusion of 0.5 µm.
_GUARD_UM = 1.0
# For each step, the height is divided by the number of levels that the step spans. The step counts as lost if
# the ratio is less than this fraction of the median ratio of all steps at the same dose.
LOST_BELOW = 0.5
_FEWEST_PIXELS = 50
_FEWEST_LEVELS = 3
# Standard deviations of the Gaussians that average the surroundings of a pixel. The larger of the two exceeds
# ``_GUARD_UM``, because diffusion reaches up to 2.5 µm.
_REACHES_UM = (1.0, 2.0)


class LevelHeight(Record):
    """The printed height of one level, measured from the lowest printed level. The height is computed from
    all scans at one dose together.
    """

    level: int
    height_nm: float
    sigma_nm: float
    pixels: int


class DoseRow(Record):
    """The results at one dose.

    Args:
        dose: dose relative to the nominal dose.
        height_gain: slope of the printed height of the levels as a function of their nominal height, from a
            straight-line fit.
        full_height_nm: printed height of the highest level above the lowest.
        roughness_nm: rms deviation of the height within areas of one level.
        lost_low: number of successive lost steps from the lowest level upwards. Steps are lost there because
            under-exposed resist does not remain. For each step, the height is divided by the number of levels
            that the step spans. The step counts as lost if this ratio is less than half the median ratio of
            all steps at the same dose. If all steps shrink by the same factor, the median shrinks too, so a
            uniform shrinkage makes no step count as lost.
        lost_high: number of successive lost steps from the highest level downwards. Steps are lost there
            because over-exposed resist cannot react any further.
        worst_readability: smallest ratio of the height of a step to the standard deviation σ of single pixels
            on its two levels. If this ratio is at least 3.92, single pixels of the two levels can be told
            apart.
    """

    dose: float
    scans: list[str]
    levels: list[LevelHeight]
    height_gain: float
    full_height_nm: float
    roughness_nm: float
    lost_low: int
    lost_high: int
    worst_readability: float


class DoseMatrix(Record):
    """The results at all doses, in ascending order of the dose, and the recommended dose with the reason for
    it.
    """

    rows: list[DoseRow]
    recommended_dose: float
    reason: str
    guard_um: float


def dose_matrix(scans: Sequence[PrintedScan]) -> tuple[DoseMatrix | None, list[str]]:
    """Evaluate every stated dose. Return the dose matrix, or None if too few doses can be evaluated. Also
    return notes that say which doses are not evaluated, and why.

    A dose is evaluated only if three levels have areas that are wide enough to measure. A matrix needs at
    least two such doses. Among the doses at which the fewest steps are lost, the dose with a ``height_gain``
    closest to 1 is recommended.
    """
    by_dose: dict[float, list[PrintedScan]] = {}
    for scan in scans:
        if scan.dose is not None:
            by_dose.setdefault(round(scan.dose, 6), []).append(scan)
    if not by_dose:
        return None, [
            "No dose matrix, because no scan in the store states a dose (column 'dose' in the card's table)."
        ]
    if len(by_dose) == 1:
        return None, [f"No dose matrix, because all scans in the store have the same dose, {min(by_dose):g}."]
    heights = {dose: _level_heights(by_dose[dose]) for dose in sorted(by_dose)}
    narrow = [dose for dose in heights if len(heights[dose][1]) < _FEWEST_LEVELS]
    rows = [_row(dose, *heights[dose]) for dose in heights if dose not in narrow]
    notes = []
    if narrow:
        notes.append(
            f"{'Left out of the' if len(rows) > 1 else 'No'} dose matrix: prints at dose "
            f"{', '.join(f'{dose:g}' for dose in narrow)} have fewer than {_FEWEST_LEVELS} levels with areas "
            f"farther than {_GUARD_UM:g} µm from every edge; step ladders have such areas (litho-data masks "
            "--pattern dose-matrix)."
        )
    if len(rows) < 2:
        return None, notes
    used = {scan_id for row in rows for scan_id in row.scans}
    if apart := [scan.id for row in rows for scan in by_dose[row.dose] if scan.id not in used]:
        notes.append(
            f"Left out of the dose matrix: {', '.join(apart)}, because no wide area has a level in common "
            "with the other scans at this dose."
        )
    fewest = min(row.lost_low + row.lost_high for row in rows)
    sound = [row for row in rows if row.lost_low + row.lost_high == fewest]
    best = min(sound, key=lambda row: abs(row.height_gain - 1))
    readable = best.worst_readability >= READABLE_AT
    told_apart = "all neighbouring levels can" if readable else "some neighbouring levels cannot"
    reason = (
        f"of the {len(sound)} doses that lose the fewest steps ({fewest}), this dose prints heights closest "
        f"to the nominal heights (gain {best.height_gain:.3f}); single pixels of {told_apart} be told apart "
        f"(the worst step is {best.worst_readability:.2f} σ, and {READABLE_AT:.2f} σ are needed)"
    )
    return DoseMatrix(rows=rows, recommended_dose=best.dose, reason=reason, guard_um=_GUARD_UM), notes


def _row(dose: float, scans: Sequence[PrintedScan], levels: list[LevelHeight]) -> DoseRow:
    nominal = np.array([entry.level for entry in levels]) * scans[0].level_height_um * NM_PER_UM
    height = np.array([entry.height_nm for entry in levels])
    sigma = np.array([entry.sigma_nm for entry in levels])
    step = np.diff(height)
    spread = np.maximum(np.sqrt((sigma[1:] ** 2 + sigma[:-1] ** 2) / 2), 1e-4)
    per_level = step / np.diff(nominal)
    lost = per_level < LOST_BELOW * np.median(per_level)
    lost_low, lost_high = _run_length(lost), _run_length(lost[::-1])
    return DoseRow(
        dose=dose,
        scans=[scan.id for scan in scans],
        levels=levels,
        height_gain=float(np.polyfit(nominal, height, 1)[0]),
        full_height_nm=float(height[-1]),
        roughness_nm=float(np.sqrt(np.average(sigma**2, weights=[entry.pixels for entry in levels]))),
        lost_low=lost_low,
        lost_high=lost_high,
        worst_readability=float((step / spread).min()),
    )


def _level_heights(scans: Sequence[PrintedScan]) -> tuple[list[PrintedScan], list[LevelHeight]]:
    """Return the scans that are used, and the mean and standard deviation of the height of each level. Only
    pixels that are far from every change of level are used. The datum, the tilt and the effect of the
    surrounding layout are first removed from each scan. A scan is used only if shared levels link it to the
    scan with the most levels, directly or through other scans. Without such a link, its datum would be
    unknown.
    """
    found = [_level_parts(scan) for scan in scans]
    linked = _linked_levels(found)
    used = [(scan, parts) for scan, parts in zip(scans, found, strict=True) if linked & parts.keys()]
    height_nm = _common_heights_nm([parts for _, parts in used])
    rows = []
    for level in sorted(height_nm):
        own = [parts[level] for _, parts in used if level in parts]
        pixels = sum(part.size for part in own)
        if pixels >= _FEWEST_PIXELS:
            rows.append((level, height_nm[level], _pooled_sd(own), pixels))
    ground = rows[0][1] if rows else 0.0
    heights = [
        LevelHeight(level=level, height_nm=height - ground, sigma_nm=sd, pixels=pixels)
        for level, height, sd, pixels in rows
    ]
    return [scan for scan, _ in used], heights


def _level_parts(scan: PrintedScan) -> dict[int, Array]:
    """For each level, return the heights, nm, of its pixels that are far from every change of level. The tilt
    and the effect of the surrounding layout are removed. The datum is not removed.
    """
    inside = _plateaus(scan)
    if not inside.any():
        return {}
    level = scan.mask_level[inside]
    y, x = np.nonzero(inside)
    present = np.unique(level)
    dummies = (level[:, None] == present[None, :]).astype(np.float64)
    # The fit has one height per level, one tilt, and an effect of the surroundings. The tilt and the
    # surroundings also change the height within areas of one level, so the fit can separate them from the
    # heights of the levels.
    slopes = np.stack([y / scan.shape[0], x / scan.shape[1]], axis=1) - 0.5
    others = np.hstack([slopes, _surroundings(scan)[:, inside].T])
    height_nm = NM_PER_UM * scan.height_um[inside].astype(np.float64)
    weights, *_ = np.linalg.lstsq(np.hstack([dummies, others]), height_nm, rcond=None)
    flat = height_nm - others @ weights[len(present) :]
    return {int(value): flat[level == value] for value in present}


def _linked_levels(scans: Sequence[Mapping[int, Array]]) -> set[int]:
    """Return the levels whose heights can be compared. These are the levels of the scan with the most levels,
    and of all scans that are linked to this scan by shared levels, directly or through other scans.
    """
    most = max(scans, key=len)
    linked = set(most)
    while more := {level for parts in scans if linked & parts.keys() for level in parts} - linked:
        linked |= more
    return linked


def _common_heights_nm(scans: Sequence[Mapping[int, Array]]) -> dict[int, float]:
    """Return the height of each level, nm, from a joint fit of one height per level and one datum per scan.
    Only differences between the heights have a meaning.
    """
    levels = sorted({level for parts in scans for level in parts})
    rows, means, weights = [], [], []
    for number, parts in enumerate(scans):
        for level, part in parts.items():
            row = np.zeros(len(levels) + len(scans))
            row[[levels.index(level), len(levels) + number]] = 1
            rows.append(row)
            means.append(part.mean())
            weights.append(np.sqrt(part.size))
    if not rows:
        return {}
    weight = np.array(weights)
    fitted, *_ = np.linalg.lstsq(np.array(rows) * weight[:, None], np.array(means) * weight, rcond=None)
    return {level: float(height) for level, height in zip(levels, fitted[: len(levels)], strict=True)}


def _surroundings(scan: PrintedScan) -> Array:
    """Blur the layout by Gaussians with standard deviations of 1 µm and 2 µm. Return the two blurred layouts
    minus the layout itself, µm. The result has shape (2, ny, nx).
    """
    return np.stack([blurred_layout_um(scan, reach_um) for reach_um in _REACHES_UM]) - scan.layout_um


def _plateaus(scan: PrintedScan) -> Array:
    """Return a mask, of shape (ny, nx), of the measured pixels that are not near any change of level."""
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * round(_GUARD_UM / scan.pitch_um) + 1
    even = maximum_filter(scan.mask_level, size) == minimum_filter(scan.mask_level, size)
    return even & scan.usable


def _run_length(flags: Array) -> int:
    """Return the number of leading True values."""
    return int(np.argmin(flags)) if not flags.all() else len(flags)


def _pooled_sd(parts: Sequence[Array]) -> float:
    """Return the pooled standard deviation of the values in ``parts`` around the mean of each part. Return 0
    if no part has two values.
    """
    squares = sum(float(((part - part.mean()) ** 2).sum()) for part in parts)
    return float(np.sqrt(squares / max(1, sum(part.size - 1 for part in parts))))
