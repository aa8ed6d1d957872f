"""The measurement model: what microscope, registration and levelling make of a print, as scans share it.

A scan shows the print levelled as its file was, displaced where the scanner ran unevenly, with a gain, on a
background. What of this all scans have in common, or all scans of a group, is learned on training scans and
added to the prediction of any other; nothing of it is fitted to a scan that is scored. It is no part of the
printer: no design sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.polynomial import legendre
from pydantic import ConfigDict
from scipy.ndimage import map_coordinates

from litho_data.foundation.results import Record
from litho_data.store import PrintedScan
from litho_models.scan_terms.background import is_of_size
from litho_models.scan_terms.cross_fit import least_squares
from litho_models.scan_terms.grouped import ALL, label_of
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
        return np.tensordot(own, polynomials(scan.shape, self.degree)[-len(own) :], axes=1)


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
        seen = displaced(scan, prediction_um, parts)
        for part in parts:
            if part.what == "gain":
                seen = seen + part.of(scan)[0] * (seen - seen.mean())
        return levelled(seen, scan.usable, self.levelling) + self.background_um(scan)

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


def displaced(scan: PrintedScan, prediction_um: np.ndarray, parts: Sequence[SharedPart]) -> FloatMap:
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


def levelled(field: np.ndarray, usable: np.ndarray, levelling: Levelling) -> FloatMap:
    """A field without the surface that fits it best on the usable pixels; its mean stays."""
    if levelling == "none":
        return field
    shapes = polynomials(field.shape, 2)[[0, *LEVELLED[levelling]]]
    basis = shapes[:, usable]
    surface = np.tensordot(least_squares(basis, field[usable])[1:], shapes[1:], axes=1)
    return field - surface + surface[usable].mean()


@lru_cache(maxsize=8)
def polynomials(shape: tuple[int, ...], degree: int) -> FloatMap:
    """Products of Legendre polynomials of y and x up to a total degree, ordered by it: (k, ny, nx)."""
    y, x = (legendre.legvander(np.linspace(-1, 1, n), degree).T for n in shape)
    maps = [np.outer(y[by_y], x[total - by_y]) for total in range(degree + 1) for by_y in range(total + 1)]
    found = np.stack(maps)
    found.setflags(write=False)
    return found


def polynomial_count(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2
