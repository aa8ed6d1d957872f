"""Find scans that were combined with a wrong layout or a wrong dose, because ids, files or doses were mixed
up.

A scan that could be registered may still show a similar layout, a mirror image of its layout, or its layout
printed at another dose. A scan that could not be registered may show another layout of the dataset.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from litho_data.foundation import YX, Array, Facts
from litho_data.register.orientation import search_orientation
from litho_data.register.refine import interior_of
from litho_data.register.scan import at_layout_pitch
from litho_data.register.topography import predicted_topography, remove_bow

_BLUR_PX = 3.0
_SIDE_PX = 128
# Number of outermost pixels whose heights are compared with those of the inner pixels.
_EDGE_PX = 2
# A scan is reported if its correlation with another layout exceeds its correlation with its own layout by
# more than this.
_BETTER = 0.02
# An unregistered scan is said to show a layout if its correlation with this layout is at least the first
# value, and exceeds the correlation with every other layout by more than the second value. At the best shift,
# a print has a correlation of about 0.9 with its own layout, and of 0.3 to 0.5 with another layout.
_FITS, _LEAD = 0.6, 0.15
MIRRORED = ("flip-x", "flip-y", "transpose", "anti-transpose")
# Standard deviation, from scan to scan, of the logarithm of the height per level at one dose. The first value
# holds for prints of the same layout, the second for prints of different layouts.
_SCATTER_SAME, _SCATTER_OTHER = 0.01, 0.03
_CLEAR_SIGMA = 4.0


@dataclass(frozen=True)
class Print:
    """One registered scan. Its heights and its blurred layout are sampled at a few points.

    ``response`` contains the height per level in µm, and the relative growth of this height with the dose.
    ``edge_times`` is the rms deviation of the heights from the blurred layout at the outermost pixels,
    divided by the rms deviation at the inner pixels. ``dihedral`` is the orientation that the registration
    found, and ``turned`` is true if the card states that the print was rotated under the microscope. Scans in
    the same ``group`` should have the same height per level. The group is the dose if the card states it, and
    the print otherwise.
    """

    id: str
    topography: Array
    height: Array
    response: tuple[float, float]
    edge_times: float
    highest_level: int
    layout: str
    dihedral: str
    turned: bool
    group: float | str


def prints_of(records: Sequence[Facts], load: Callable[[str], Mapping[str, Array]]) -> list[Print]:
    """Return a ``Print`` for every record of a registered scan.

    Args:
        records: the records of the scans of a dataset.
        load: function that takes the id of a scan and returns a mapping with its arrays ``mask_level`` and
            ``height_um``.
    """
    return [_print(record, load(record["id"])) for record in records if "dihedral" in record["quality"]]


def doubts(prints: Sequence[Print]) -> dict[str, str]:
    """Return reasons to suspect that scans do not show their own layout, keyed by the id of the scan.

    Scans that are not suspected are left out.
    """
    said: dict[str, list[str]] = {one.id: [] for one in prints}
    for name, text in (*_other_layouts(prints), *_orientations(prints), *_gains(prints)):
        said[name].append(text)
    return {name: "; ".join(texts) for name, texts in said.items() if texts}


def fitting_layout(
    height_um: Array,
    scan_pitch_um: YX,
    layouts: Mapping[str, Array],
    pitch_um: float,
) -> str:
    """Return the id of the layout that a scan shows, whatever the scan's orientation. If no layout clearly
    fits best, return "".

    Args:
        height_um: heights of the scan in µm, shape (ny, nx), NaN where not measured.
        scan_pitch_um: pitch (y, x) of the scan in µm.
        layouts: levels of every layout, keyed by id. Each array has shape (ny, nx).
        pitch_um: pitch of the layouts in µm.
    """
    flat = remove_bow(at_layout_pitch(height_um, scan_pitch_um, pitch_um))
    scores = [(0.0, ""), (0.0, "")]
    for name, level in layouts.items():
        found = search_orientation(flat, predicted_topography(level, _BLUR_PX))
        scores += [(one.ncc, name) for one in found if one.polarity == 1][:1]
    (best, fitting), (rival, _) = sorted(scores, reverse=True)[:2]
    return fitting if best >= _FITS and best - rival > _LEAD else ""


def _print(record: Facts, arrays: Mapping[str, Array]) -> Print:
    level = arrays["mask_level"]
    step = max(1, -(-max(level.shape) // _SIDE_PX))
    sparse = (slice(step // 2, None, step),) * 2
    whole = predicted_topography(level, _BLUR_PX)
    topography, height = whole[sparse], arrays["height_um"][sparse]
    dose = record["columns"].get("dose")
    response = _response(topography, height)
    return Print(
        id=record["id"],
        # The sampled arrays are copied, because views would keep the whole arrays in memory.
        topography=topography[::2, ::2].copy(),
        height=height[::2, ::2].copy(),
        response=response,
        edge_times=_edge_times(whole, arrays["height_um"], response[0]),
        highest_level=int(level.max()),
        layout=sha256(level.tobytes()).hexdigest(),
        dihedral=str(record["quality"]["dihedral"]),
        turned=bool(record["columns"].get("turned_deg")),
        group=float(dose) if dose is not None and np.isfinite(dose) else str(record["print"]),
    )


def _other_layouts(prints: Sequence[Print]) -> Iterator[tuple[str, str]]:
    """Yield the id and a message for every scan whose heights fit another layout of the dataset better than
    the layout onto which it was registered.
    """
    for shape in {one.topography.shape for one in prints}:
        alike = [one for one in prints if one.topography.shape == shape]
        # A layout that was printed more than once is named after the first of its ids.
        distinct = list({one.layout: one for one in reversed(alike)}.values())
        layouts = np.stack([one.topography.ravel() for one in distinct])
        for one in alike:
            found = _correlations(one.height.ravel(), layouts)
            own = found[next(k for k, other in enumerate(distinct) if other.layout == one.layout)]
            if found.max() > own + _BETTER:
                best = distinct[int(found.argmax())].id
                better = f"correlation {found.max():.3f}, with its own layout {own:.3f}"
                yield one.id, f"its heights fit the layout of {best} better: {better}"


def _correlations(height: Array, layouts: Array) -> Array:
    """Return the correlation of the heights with each of n layouts. The result has shape (n,).

    ``height`` has shape (pixels,), and ``layouts`` has shape (n, pixels). Pixels whose height is NaN are
    ignored. The correlation is 0 for a flat layout and for flat heights.
    """
    seen = np.isfinite(height)
    own, others = (one - one.mean(axis=-1, keepdims=True) for one in (height[seen], layouts[:, seen]))
    energy = (others**2).sum(axis=1, dtype=float) * (own**2).sum(dtype=float)
    products: Array = (others * own).sum(axis=1, dtype=float)
    return products / np.sqrt(np.where(energy > 0, energy, np.inf))


def _orientations(prints: Sequence[Print]) -> Iterator[tuple[str, str]]:
    """Yield the id and a message for every scan that is mirrored relative to its layout, or whose rotation
    differs from the rotation of most scans. Scans for which the card states that the print was rotated are
    ignored.
    """
    upright = [one for one in prints if not one.turned]
    usual, count = Counter(one.dihedral for one in upright).most_common(1)[0] if upright else ("", 0)
    for one in upright:
        if one.dihedral != usual and 2 * count > len(upright):
            mirrored = (one.dihedral in MIRRORED) != (usual in MIRRORED)
            what = "a mirror image of its layout" if mirrored else f"rotated ({one.dihedral})"
            yield one.id, f"{what}, unlike the other scans: is its layout file the right one?"
        elif one.dihedral in MIRRORED:
            yield one.id, f"a mirror image of its layout ({one.dihedral}): is its file mirrored?"


def _gains(prints: Sequence[Print]) -> Iterator[tuple[str, str]]:
    """Yield the id and a message for every scan that seems to belong to another group (dose or print). The
    height per level of such a scan differs clearly from the value of its own group, and is closest to the
    value of another group. Scans whose doses seem to be swapped are yielded too.
    """
    same_layout = Counter(one.layout for one in prints)
    repeated = len(prints) > 0 and min(same_layout.values()) > 1
    scatter = _SCATTER_SAME if repeated else _SCATTER_OTHER
    logs = np.array([np.log(max(abs(one.response[0]), 1e-12)) for one in prints])
    if repeated:
        layouts = np.array([one.layout for one in prints])
        logs -= [np.median(logs[layouts == layout]) for layout in layouts]
    groups = {
        group: np.array([one.group == group for one in prints]) for group in {one.group for one in prints}
    }
    middle = {group: float(np.median(logs[members])) for group, members in groups.items()}
    for k, one in enumerate(prints):
        if groups[one.group].sum() < 3:
            continue
        off = abs(logs[k] - middle[one.group])
        nearest = min(middle, key=lambda group: abs(logs[k] - middle[group]))
        if off > _CLEAR_SIGMA * scatter and nearest != one.group:
            percent = 100 * np.expm1(logs[k] - middle[one.group])
            text = f"height per level differs by {percent:+.0f} % from that of the others of {one.group}"
            yield one.id, f"{text}, but agrees with {nearest}: is its id or dose the right one?"
    growth = np.array([one.response[1] for one in prints])
    rising = {
        group: (middle[group], int(members.sum()))
        for group, members in groups.items()
        if isinstance(group, float) and np.median(growth[members]) > 0
    }
    traded = _traded_doses(rising, scatter)
    yield from (
        (one.id, traded[one.group]) for one in prints if isinstance(one.group, float) and one.group in traded
    )


def _response(topography: Array, height: Array) -> tuple[float, float]:
    """Return the slope of the heights against the blurred levels of the layout, in µm per level, and the
    relative growth of this slope with the dose, d ln slope / d ln dose.

    The exposure is the level times the dose. Let g(T) be the heights as a function of the blurred levels T.
    If the dose becomes larger by a factor c, the heights become g(c T), so the growth is cov(T, T g') /
    cov(T, g). Here, g is a fitted parabola, and the growth is one plus the share of the slope that comes from
    the quadratic term. This share is negative if the print saturates, and the growth may then be negative
    too.
    """
    seen = np.isfinite(height)
    level, height = topography[seen].astype(float), height[seen].astype(float)
    from_mean = level - level.mean()
    slope = float((from_mean * height).sum())
    square = float(np.polyfit(level, height, 2)[0]) * float((from_mean * level**2).sum())
    growth = 1 + square / slope if slope else 0.0
    return slope / max(float((from_mean**2).sum()), 1e-12), growth


def _edge_times(topography: Array, height: Array, slope: float) -> float:
    """Return the rms deviation of the outermost pixels from the layout, divided by the rms deviation of the
    inner pixels.

    The deviation is the height minus ``slope`` (in µm per level) times the blurred level. The result is 0 if
    no outermost or no inner pixel was measured.
    """
    seen = np.isfinite(height)
    inner = seen & interior_of(height.shape, _EDGE_PX)
    edge = seen & ~inner
    if not inner.any() or not edge.any():
        return 0.0
    off = height - slope * topography
    off = (off - off[inner].mean()) ** 2
    return float(np.sqrt(off[edge].mean() / max(off[inner].mean(), 1e-12)))


def _traded_doses(rising: Mapping[float, tuple[float, int]], scatter: float) -> dict[float, str]:
    """Return messages for the doses that seem to be swapped, keyed by dose. Doses seem to be swapped if the
    height per level is clearly smaller at a larger dose. If this is the case for no pair of doses, the result
    is empty.

    Args:
        rising: for each dose, the median logarithm of the height per level and the number of scans. Doses are
            left out if, according to the shape of their prints, the height does not grow with the dose.
        scatter: standard deviation, from scan to scan, of the logarithm of the height per level at one dose.
    """
    doses = sorted(rising)
    values = np.array([rising[dose][0] for dose in doses])
    error = scatter / np.sqrt([rising[dose][1] for dose in doses])
    falls = values[:, None] - values - _CLEAR_SIGMA * np.hypot.outer(error, error)
    if not (np.triu(falls, 1) > 0).any():
        return {}
    # The height per level should rise with the dose. The k-th smallest height per level therefore belongs to
    # the k-th smallest dose.
    pairs = {k: sorted((k, int(rank))) for k, rank in enumerate(np.argsort(np.argsort(values)))}
    return {
        doses[k]: f"height per level falls from dose {doses[i]:g} to {doses[j]:g}: are these two swapped?"
        for k, (i, j) in pairs.items()
        if i != j
    }
