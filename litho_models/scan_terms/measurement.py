"""The measurement model: what microscope, registration and levelling make of a print, as scans share it.

A scan shows the print levelled as its file was, displaced where the scanner ran unevenly, with a gain, on a
background. What of this all scans have in common, or all scans of a group, is learned on training scans and
added to the prediction of any other; nothing of it is fitted to a scan that is scored. It is no part of the
printer: no design sees it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.polynomial import legendre
from pydantic import ConfigDict
from scipy.ndimage import map_coordinates

from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_data.store.lock_box import drawing_key
from litho_models.scan_terms.background import field_um, is_of_size
from litho_models.scan_terms.blocks import thinned
from litho_models.scan_terms.cross_fit import least_squares
from litho_models.scan_terms.grouped import ALL, Block, Products, groupings, label_of
from litho_models.scan_terms.term import FloatMap

Shared = Literal["background", "shift-x", "shift-y", "gain"]
Levelling = Literal["none", "plane", "twist", "bow"]

# Surfaces that a file may have been freed of, structure included: which of x, y, x², xy, y², from 1.
LEVELLED: dict[Levelling, tuple[int, ...]] = {
    "none": (),
    "plane": (1, 2),
    "twist": (1, 2, 4),
    "bow": (1, 2, 3, 4, 5),
}
_HIGHEST, _LATERAL = 11, 3
# What is tried, the most likely first. A background of degree 11 turns over 9 µm in a field of 54 µm.
_OFFERS: tuple[tuple[Shared, int, bool], ...] = (
    ("background", 2, False),
    ("background", 4, False),
    ("background", _HIGHEST, False),
    ("background", 3, True),
    ("background", _HIGHEST, True),
    ("shift-x", _LATERAL, False),
    ("shift-x", _LATERAL, True),
    ("shift-y", _LATERAL, False),
    ("shift-y", _LATERAL, True),
    ("gain", 0, True),
)
# Scans' worth of evidence for no difference between groups: the spread within groups over that between them.
_SHRINKING = (0.3, 1.0, 3.0)
# A part stays if the held-out squared error falls by more than so many standard errors, and by such a share.
_LEAST_Z, _LEAST_SHARE = 0.5, 0.003
_SAMPLED_PX = 16384
# Displacements are found by their derivative; the second time around it is taken at the displaced print.
_ROUNDS = 2
_INNER_FOLDS = 5


# What may be shared: its degree, its columns by group. A scan with its predicted print (ny, nx), µm.
_Offer = tuple[Shared, int, Block]
_Pair = tuple[PrintedScan, np.ndarray]


class SharedPart(Record):
    """One thing that scans have in common.

    Attributes:
        what: ``background`` and the displacements are sums of Legendre polynomials of x and y, -1 to 1 over
            the field, of ``degree`` in all; the gain is one number, relative.
        by: grouping; ``coefficients``: by label, µm, or 1 for the gain. One without any adds nothing.
        shrinking: scans' worth of evidence for no such thing that the fit went by.
    """

    what: Shared
    by: str
    degree: int
    shrinking: float
    coefficients: dict[str, list[float]]

    @property
    def numbers(self) -> int:
        """Fitted numbers."""
        return sum(len(own) for own in self.coefficients.values())

    def of(self, scan: PrintedScan) -> list[float]:
        """The coefficients of the scan's group; empty where it has none."""
        return self.coefficients.get(label_of(scan, self.by), [])

    def map_um(self, scan: PrintedScan) -> FloatMap:
        """The polynomials on the scan's field, (ny, nx) µm; a background has none of degree 0."""
        own = self.of(scan)
        return np.tensordot(own, _polynomials(scan.shape, self.degree)[-len(own) :], axes=1)


class MeasurementModel(Record):
    """What scans share beside their prints.

    Attributes:
        levelling: surface that the files were freed of, structure included; taken off predictions alike.
        parts: the rest, in the order in which it was found.
        field_um: size (y, x) of the fields it was learned on; ``scans``: how many.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    levelling: Levelling
    parts: list[SharedPart]
    field_um: tuple[float, float]
    scans: int

    @property
    def numbers(self) -> int:
        """Fitted numbers."""
        return sum(part.numbers for part in self.parts)

    def fits(self, scan: PrintedScan) -> bool:
        """Whether the scan's field has the size that this was learned on."""
        return is_of_size(scan, self.field_um)

    def expected_um(self, scan: PrintedScan, prediction_um: np.ndarray) -> FloatMap:
        """The map (ny, nx) that the microscope should show of a predicted print (ny, nx), µm.

        A field of another size has its levelling only.
        """
        parts = self._parts(scan)
        seen = _displaced(scan, prediction_um, parts)
        for part in parts:
            if part.what == "gain":
                seen = seen + part.of(scan)[0] * (seen - seen.mean())
        return _levelled(seen, scan.usable, self.levelling) + self.background_um(scan)

    def freed(self, scan: PrintedScan, prediction_um: np.ndarray) -> PrintedScan:
        """The scan without what this adds to its predicted print (ny, nx), µm."""
        added = self.expected_um(scan, prediction_um) - prediction_um
        return replace(scan, height_um=(scan.height_um - added).astype(np.float32))

    def between_groups(self) -> MeasurementModel:
        """Only what differs between groups: the mean over the labels of a part is taken out of each of them.

        Nor is a gain kept: what prints differ in may be the printer's.
        """
        kept = []
        for part in self.parts:
            if part.by == ALL or part.what == "gain":
                continue
            mean = np.mean([*part.coefficients.values()], axis=0)
            own = {label: (np.array(one) - mean).tolist() for label, one in part.coefficients.items()}
            kept.append(part.model_copy(update={"coefficients": own}))
        return self.model_copy(update={"parts": kept, "levelling": "none"})

    def background_um(self, scan: PrintedScan) -> FloatMap:
        """The background alone on the scan's field, (ny, nx) µm."""
        backgrounds = (part for part in self._parts(scan) if part.what == "background")
        return sum((part.map_um(scan) for part in backgrounds), np.zeros(scan.shape))

    def _parts(self, scan: PrintedScan) -> list[SharedPart]:
        """Those that say something of the scan."""
        return [part for part in self.parts if part.of(scan)] if self.fits(scan) else []


def learn_measurement(
    scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], *, seed: int = 0
) -> MeasurementModel:
    """Choose and fit what these scans share beside the predicted prints (ny, nx), µm.

    Parts are added one at a time as long as they lower the error on scans that they were not fitted to, dealt
    into folds among these scans, and only if they do so beyond the scatter over scans. Where fields differ in
    size, those of the most frequent one are learned from.
    """
    usual_um = Counter(map(field_um, scans)).most_common(1)[0][0]
    model = MeasurementModel(levelling="none", parts=[], field_um=usual_um, scans=0)
    pairs = [pair for pair in zip(scans, predictions_um, strict=True) if model.fits(pair[0])]
    model = model.model_copy(update={"levelling": _best_levelling(pairs, model), "scans": len(pairs)})
    chosen: list[_Offer] = []
    for _ in range(_ROUNDS):
        products = _products(pairs, model)
        chosen = chosen or _chosen(products, _deal([scan.id for scan, _ in pairs], seed))
        model = model.model_copy(update={"parts": _fitted(products, chosen)})
        if not chosen:
            break
    return model


def _products(pairs: Sequence[_Pair], model: MeasurementModel) -> Products:
    """Inner products of what could be shared, at a model of the measurement so far."""
    grams = []
    for scan, prediction in pairs:
        rows = _rows(scan, prediction, model)
        grams.append(rows @ rows.T / rows.shape[1])
    return Products(np.stack(grams), groupings([scan for scan, _ in pairs], by_order=False))


def _chosen(products: Products, fold_of: np.ndarray) -> list[_Offer]:
    """What to add, beginning with nothing; ``fold_of``: (scans,)."""
    chosen: list[_Offer] = []
    if len(fold_of) < 2:
        return chosen
    left = products.held_out([], fold_of)
    while offers := _offers(products.groups, chosen):
        tried = [products.held_out([block for *_, block in (*chosen, one)], fold_of) for one in offers]
        best = int(np.argmin([one.mean() for one in tried]))
        gain = left - tried[best]
        error = gain.std(ddof=1) / np.sqrt(len(gain))
        if gain.mean() <= max(_LEAST_Z * error, _LEAST_SHARE * left.mean()):
            break
        chosen.append(offers[best])
        left = tried[best]
    return chosen


def _offers(groups: Iterable[str], chosen: Sequence[_Offer]) -> list[_Offer]:
    taken = {(what, block.by) for what, _, block in chosen}
    return [
        (what, degree, Block(_columns_of(what, degree), by, shrinking))
        for what, degree, grouped in _OFFERS
        for by in groups
        if (by != ALL) == grouped and (what, by) not in taken
        for shrinking in (_SHRINKING if grouped else _SHRINKING[:1])
    ]


def _fitted(products: Products, chosen: Sequence[_Offer]) -> list[SharedPart]:
    """The parts with their strengths."""
    fitted = products.strengths([block for *_, block in chosen], np.arange(len(products.grams)))
    return [
        SharedPart(
            what=what,
            by=block.by,
            degree=degree,
            shrinking=block.shrinking,
            coefficients={label: own.tolist() for label, own in strengths.items()},
        )
        for (what, degree, block), strengths in zip(chosen, fitted, strict=True)
    ]


def _rows(scan: PrintedScan, prediction_um: np.ndarray, model: MeasurementModel) -> FloatMap:
    """What is to be explained and the columns (1 + m, n) at thinned pixels, without their means.

    What the parts of the model explain is put back, to first order: their strengths are then fitted anew as
    a whole, so that they are shrunk once, however often.
    """
    at = thinned(scan.usable, _SAMPLED_PX)
    seen = _displaced(scan, prediction_um, [part for part in model.parts if part.of(scan)])
    slope_y, slope_x = (slope.reshape(-1)[at] for slope in np.gradient(seen, scan.pitch_um))
    shapes = _polynomials(scan.shape, _HIGHEST).reshape(_count(_HIGHEST), -1)[:, at]
    residual = (scan.height_um - model.expected_um(scan, prediction_um)).reshape(-1)[at]
    own = shapes[: _count(_LATERAL)]
    moved = np.concatenate([own * slope_x, own * slope_y, seen.reshape(-1)[at][None]])
    # A background is added after the levelling, so that it is not levelled itself.
    surface = shapes[[0, *LEVELLED[model.levelling]]]
    moved -= least_squares(surface, moved.T).T @ surface
    rows = np.concatenate([residual[None], shapes[1:], moved])
    for part in model.parts:
        if known := part.of(scan):
            rows[0] += known @ rows[list(_columns_of(part.what, part.degree))]
    return rows - rows.mean(axis=1, keepdims=True)


def _columns_of(what: Shared, degree: int) -> tuple[int, ...]:
    """Where the columns of a part lie among the rows of a scan."""
    surface, lateral = _count(_HIGHEST), _count(_LATERAL)
    starts = {
        "background": 1,
        "shift-x": surface,
        "shift-y": surface + lateral,
        "gain": surface + 2 * lateral,
    }
    count = _count(degree) - (what == "background")
    return tuple(range(starts[what], starts[what] + count))


def _best_levelling(pairs: Sequence[_Pair], model: MeasurementModel) -> Levelling:
    """The levelling of predictions that comes closest to the scans, a shared bow and tilt taken out."""
    # Legendre polynomials are all but orthogonal over a field: their spread is the squared error.
    weights = np.mean(_polynomials(pairs[0][0].shape, 2) ** 2, axis=(1, 2))

    def error(levelling: Levelling) -> float:
        levelled = model.model_copy(update={"levelling": levelling})
        rests = []
        for scan, prediction in pairs:
            at = thinned(scan.usable, _SAMPLED_PX)
            rest = (scan.height_um - levelled.expected_um(scan, prediction)).reshape(-1)[at]
            rests.append(least_squares(_polynomials(scan.shape, 2).reshape(_count(2), -1)[:, at], rest))
        return float((np.var(rests, axis=0) * weights)[1:].sum())

    return min(LEVELLED, key=error)


def _displaced(scan: PrintedScan, prediction_um: np.ndarray, parts: Sequence[SharedPart]) -> FloatMap:
    """A predicted print looked up where the displacements of these parts say, (ny, nx) µm."""
    prediction = np.asarray(prediction_um, np.float64)
    moves = [part for part in parts if part.what in ("shift-x", "shift-y")]
    if not moves:
        return prediction
    y, x = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in scan.shape), indexing="ij")
    places = {"shift-y": y, "shift-x": x}
    for part in moves:
        places[part.what] += part.map_um(scan) / scan.pitch_um
    return map_coordinates(prediction, [*places.values()], order=3, mode="nearest")


def _levelled(field: np.ndarray, usable: np.ndarray, levelling: Levelling) -> FloatMap:
    """A field without the surface that fits it best on the usable pixels; its mean stays."""
    if levelling == "none":
        return field
    shapes = _polynomials(field.shape, 2)[[0, *LEVELLED[levelling]]]
    basis = shapes[:, usable]
    surface = np.tensordot(least_squares(basis, field[usable])[1:], shapes[1:], axes=1)
    return field - surface + surface[usable].mean()


@lru_cache(maxsize=8)
def _polynomials(shape: tuple[int, ...], degree: int) -> FloatMap:
    """Products of Legendre polynomials of y and x up to a total degree, ordered by it: (k, ny, nx)."""
    y, x = (legendre.legvander(np.linspace(-1, 1, n), degree).T for n in shape)
    maps = [np.outer(y[by_y], x[total - by_y]) for total in range(degree + 1) for by_y in range(total + 1)]
    found = np.stack(maps)
    found.setflags(write=False)
    return found


def _count(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2


def _deal(ids: Sequence[str], seed: int) -> np.ndarray:
    """Number of the inner fold of each scan, dealt by a hash of its id."""
    shuffled = sorted(ids, key=lambda scan_id: drawing_key(scan_id, seed))
    return np.array([shuffled.index(one) % min(_INNER_FOLDS, len(ids)) for one in ids])
