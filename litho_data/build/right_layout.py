"""Is a scan the print of its own layout? What ids, files and doses got mixed up says itself in a set.

A scan that registers may still show another layout like its own, a mirrored one, or the same layout at
another dose. One that does not register may show another layout of the set.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from litho_data.register.geometry import ORIENTATIONS
from litho_data.register.orientation import search_orientation
from litho_data.register.scan import at_layout_pitch
from litho_data.register.topography import pearson, predicted_topography, remove_bow

_BLUR_PX = 3.0
_SIDE_PX = 128
# Another layout must explain a scan this much better, in correlation.
_BETTER = 0.02
# A print of another layout reaches 0.3 to 0.5 at its best shift, one of this layout 0.9.
_FITS, _LEAD = 0.6, 0.15
MIRRORED = ("flip-x", "flip-y", "transpose", "anti-transpose")
# Scatter of the gain among prints of one layout at one dose, and among those of different layouts.
_SCATTER_SAME, _SCATTER_OTHER = 0.01, 0.03
_CLEAR_SIGMA = 4.0


@dataclass(frozen=True)
class _Print:
    """One registered scan: its heights on its layout, and where it belongs.

    ``turned``: whether the card says that it lay turned. ``group`` is what should share a gain: the dose, if
    the card gives it, or the printed block.
    """

    id: str
    topography: np.ndarray
    height: np.ndarray
    layout: str
    dihedral: str
    turned: bool
    group: float | str


def doubts(
    records: Sequence[Mapping[str, Any]], load: Callable[[str], Mapping[str, np.ndarray]]
) -> dict[str, str]:
    """What speaks against a scan being the print of its own layout, by id; nothing for most sets.

    Args:
        records: of the scans of a dataset.
        load: the arrays ``mask_level`` and ``height_um`` of an id.
    """
    prints = [_print(record, load(record["id"])) for record in records if "dihedral" in record["quality"]]
    said: dict[str, list[str]] = {one.id: [] for one in prints}
    for name, text in (*_other_layouts(prints), *_orientations(prints), *_gains(prints)):
        said[name].append(text)
    return {name: "; ".join(texts) for name, texts in said.items() if texts}


def fitting_layout(
    height_um: np.ndarray,
    scan_pitch_um: tuple[float, float],
    layouts: Mapping[str, np.ndarray],
    pitch_um: float,
) -> str:
    """The layout whose topography a scan shows, in any orientation, or "" if none stands out.

    Args:
        height_um: (ny, nx), NaN where not measured.
        scan_pitch_um: (y, x).
        layouts: levels (ny, nx) by id.
        pitch_um: of the layouts.
    """
    flat = remove_bow(at_layout_pitch(height_um, scan_pitch_um, pitch_um))
    scores = {}
    for name, level in layouts.items():
        found = search_orientation(flat, predicted_topography(level, _BLUR_PX), tuple(ORIENTATIONS), (1,))
        scores[name] = found[0].ncc if found else 0.0
    ranked = sorted(scores, key=lambda name: scores[name], reverse=True)
    if not ranked or scores[ranked[0]] < _FITS:
        return ""
    rival = scores[ranked[1]] if len(ranked) > 1 else 0.0
    return ranked[0] if scores[ranked[0]] - rival > _LEAD else ""


def _print(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> _Print:
    level, height = arrays["mask_level"], arrays["height_um"]
    step = max(1, -(-max(level.shape) // _SIDE_PX))
    sparse = (slice(step // 2, None, step),) * 2
    dose = record["columns"].get("dose")
    return _Print(
        id=record["id"],
        topography=predicted_topography(level, _BLUR_PX)[sparse],
        height=height[sparse].astype(np.float64),
        layout=sha256(level.tobytes()).hexdigest(),
        dihedral=str(record["quality"]["dihedral"]),
        turned=bool(record["columns"].get("turned_deg")),
        group=float(dose) if dose is not None and np.isfinite(dose) else str(record["print"]),
    )


def _other_layouts(prints: Sequence[_Print]) -> list[tuple[str, str]]:
    """Scans that another layout of the set explains better, at the warp that was found for their own."""
    said = []
    for one in prints:
        sparse = (slice(None, None, 2),) * 2
        height = one.height[sparse]
        seen = np.isfinite(height)
        own = pearson(height[seen], one.topography[sparse][seen])
        others = {
            other.id: pearson(height[seen], other.topography[sparse][seen])
            for other in prints
            if other.layout != one.layout and other.topography.shape == one.topography.shape
        }
        best = max(others, key=lambda name: others[name], default="")
        if best and others[best] > own + _BETTER:
            text = (
                f"its heights fit the layout of {best} better: correlation {others[best]:.3f}, own {own:.3f}"
            )
            said.append((one.id, text))
    return said


def _orientations(prints: Sequence[_Print]) -> list[tuple[str, str]]:
    """Scans that lie mirrored or turned on their layout, unlike the others of the set."""
    if not prints:
        return []
    usual, count = Counter(one.dihedral for one in prints).most_common(1)[0]
    said = []
    for one in prints:
        if one.turned:
            # As its card says.
            continue
        if one.dihedral != usual and 2 * count > len(prints):
            mirrored = (one.dihedral in MIRRORED) != (usual in MIRRORED)
            what = "a mirror image of its layout" if mirrored else f"turned ({one.dihedral})"
            said.append((one.id, f"{what}, unlike the other scans: is the file of its layout the right one?"))
        elif one.dihedral in MIRRORED:
            said.append((one.id, f"a mirror image of its layout ({one.dihedral}); is its file mirrored?"))
    return said


def _gains(prints: Sequence[_Print]) -> list[tuple[str, str]]:
    """Scans whose height per level fits another group than their own, and groups out of the order of dose."""
    same_layout = Counter(one.layout for one in prints)
    repeated = len(prints) > 0 and min(same_layout.values()) > 1
    scatter = _SCATTER_SAME if repeated else _SCATTER_OTHER
    responses = [_response(one) for one in prints]
    logs = np.array([np.log(max(abs(gain), 1e-12)) for gain, _ in responses])
    if repeated:
        logs -= [
            np.median([logs[k] for k, other in enumerate(prints) if other.layout == one.layout])
            for one in prints
        ]
    groups = {
        group: np.array([one.group == group for one in prints]) for group in {one.group for one in prints}
    }
    middle = {group: float(np.median(logs[members])) for group, members in groups.items()}
    said = []
    for k, one in enumerate(prints):
        if groups[one.group].sum() < 3:
            continue
        off = abs(logs[k] - middle[one.group])
        nearest = min(middle, key=lambda group: abs(logs[k] - middle[group]))
        if off > _CLEAR_SIGMA * scatter and nearest != one.group:
            percent = 100 * np.expm1(logs[k] - middle[one.group])
            text = f"height per level {percent:+.0f} % off the others of {one.group}, as in {nearest}"
            said.append((one.id, f"{text}: is its id or dose the right one?"))
    growth = np.array([growth for _, growth in responses])
    rising = {
        group: (middle[group], int(members.sum()))
        for group, members in groups.items()
        if isinstance(group, float) and np.median(growth[members]) > 0
    }
    traded = _traded_doses(rising, scatter)
    return said + [(one.id, traded[one.group]) for one in prints if one.group in traded]


def _response(one: _Print) -> tuple[float, float]:
    """Height per level, µm: the slope of the heights over the blurred layout; and how it grows with the dose.

    Level times dose is the exposure, so that the curve of the heights over the levels tells what a larger
    dose would do to their slope over g(dose * level): d ln slope / d ln dose = cov(T, T g') / cov(T, g), T
    the blurred levels. Of a parabola that is one plus the share that its square has in the slope; in a
    saturated print it is negative.
    """
    seen = np.isfinite(one.height)
    level, height = one.topography[seen].astype(np.float64), one.height[seen]
    from_mean = level - level.mean()
    slope = float((from_mean * height).sum())
    square = float(np.polyfit(level, height, 2)[0]) * float((from_mean * level**2).sum())
    growth = 1 + square / slope if slope else 0.0
    return slope / max(float((from_mean**2).sum()), 1e-12), growth


def _traded_doses(rising: Mapping[float, tuple[float, int]], scatter: float) -> dict[float, str]:
    """What is said of the doses that must change places for the height per level to rise with the dose.

    Two may have been swapped, or the order of all turned round.

    Args:
        rising: per dose, of those where more dose should raise it: log of the height per level, and scans.
        scatter: of the log of one scan.
    """
    doses = sorted(rising)
    values = np.array([rising[dose][0] for dose in doses])
    error = scatter / np.sqrt([rising[dose][1] for dose in doses])
    clear = _CLEAR_SIGMA * np.hypot.outer(error, error)

    def falls(order: np.ndarray) -> bool:
        return bool((np.triu(order[:, None] - order[None, :] - clear, 1) > 0).any())

    count = len(doses)
    trades = [[(i, j)] for i in range(count) for j in range(i + 1, count)]
    trades.append([(i, count - 1 - i) for i in range(count // 2)])
    rights = []
    for trade in trades:
        order = values.copy()
        for i, j in trade:
            order[[i, j]] = values[[j, i]]
        if not falls(order):
            rights.append((float(order @ np.arange(count)), trade))
    if not falls(values) or not rights:
        return {}
    return {
        doses[k]: f"height per level falls from dose {doses[i]:g} to {doses[j]:g}: are these two swapped?"
        for i, j in max(rights)[1]
        for k in (i, j)
    }
