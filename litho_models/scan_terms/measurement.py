"""The measurement model. It describes how the microscope, the registration and the levelling change the
height map of a print. It includes only changes that several scans have in common.

In a scan, the image of the print is displaced by the uneven motion of the scanner, multiplied by a gain,
levelled, and added to a background. Some of these changes are the same in all scans or in all scans of a
group. They are learned from training scans and applied to predictions of other scans. Nothing is fitted to a
scored scan. The measurement model is not part of the printer and is not used in a design.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Literal, TypeVar

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
Scan = TypeVar("Scan", bound=PrintedScan)
# The displacements, in the order of the axes.
_SHIFTS = ("shift-y", "shift-x")

# Surfaces that the microscope software may have fitted to whole scan files and subtracted from them. Each
# surface is given by the numbers of its terms in the list of polynomials x, y, x², xy, y², counted from 1.
LEVELLED: dict[Levelling, tuple[int, ...]] = {
    "none": (),
    "plane": (1, 2),
    "twist": (1, 2, 4),
    "bow": (1, 2, 3, 4, 5),
}


class SharedPart(Record):
    """One part of the measurement model: a background, a displacement or a gain that several scans share.

    Attributes:
        what: kind of the part. A background or a displacement is a sum of terms. Each term is a product of
            Legendre polynomials of x and of y, with a total degree of at most ``degree``. The coordinates x
            and y run from -1 to 1 over the field. A gain is a single number, the relative change of the
            height.
        by: name of the grouping whose groups have separate coefficients.
        coefficients: coefficients for each label of the grouping, in µm. For a gain, there is one
            dimensionless coefficient. A part without coefficients changes nothing.
        shrinking: weight of the prior, which pulls the coefficients towards zero in the fit. The prior weighs
            as much as this number of scans.
    """

    what: Shared
    by: str
    degree: int
    shrinking: float
    coefficients: dict[str, list[float]]

    @property
    def numbers(self) -> int:
        """Return the number of fitted coefficients."""
        return sum(len(own) for own in self.coefficients.values())

    def of(self, scan: PrintedScan) -> list[float]:
        """Return the coefficients of the group to which the scan belongs. The list is empty if this group has
        no coefficients.
        """
        return self.coefficients.get(label_of(scan, self.by), [])

    def map_um(self, scan: PrintedScan) -> FloatMap:
        """Return this part, which must be a background or a displacement, as a map over the field of the
        scan, µm, of shape (ny, nx). A background has no constant term.
        """
        own = self.of(scan)
        return np.tensordot(own, polynomials(scan.shape, self.degree)[-len(own) :], axes=1)


class MeasurementModel(Record):
    """The changes that the measurement makes to several scans in the same way.

    Attributes:
        levelling: kind of surface that is assumed to have been fitted to whole scan files and subtracted. The
            same kind of surface is fitted to predictions and subtracted from them.
        parts: the changes other than the levelling, in the order in which they were found.
        field_um: size (y, x) of the fields of the training scans, µm.
        scans: number of training scans.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    levelling: Levelling
    parts: list[SharedPart]
    field_um: tuple[float, float]
    scans: int

    @property
    def numbers(self) -> int:
        """Return the number of fitted coefficients."""
        return sum(part.numbers for part in self.parts)

    def fits(self, scan: PrintedScan) -> bool:
        """Return whether the field of the scan is as large as the fields of the training scans."""
        return is_of_size(scan, self.field_um)

    def expected_um(self, scan: PrintedScan, prediction_um: np.ndarray) -> FloatMap:
        """From the predicted height of the print, return the map that the scan is expected to show. Both maps
        have shape (ny, nx) and are in µm.

        If the field of the scan differs in size from the fields of the training scans, only the levelling is
        applied.
        """
        seen = self.displaced_um(scan, prediction_um)
        for part in self.parts_of(scan):
            if part.what == "gain":
                seen = seen + part.of(scan)[0] * (seen - seen.mean())
        return levelled(seen, scan.usable, self.levelling) + self.background_um(scan)

    def freed(self, scan: Scan, prediction_um: np.ndarray) -> Scan:
        """Return the scan minus the changes that this model makes to the predicted height. ``prediction_um``
        is the predicted height of the print, µm, of shape (ny, nx).
        """
        added = self.expected_um(scan, prediction_um) - prediction_um
        return replace(scan, height_um=(scan.height_um - added).astype(np.float32))

    def between_groups(self) -> MeasurementModel:
        """Return a model that contains only the differences between groups. From the coefficients of each
        part, the mean over all labels is subtracted.

        The levelling and the parts that are the same in all scans are left out. Gains are left out, too,
        because a difference in gain between prints may come from the printer.
        """
        kept = []
        for part in self.parts:
            if part.by == ALL or part.what == "gain":
                continue
            mean = np.mean([*part.coefficients.values()], axis=0)
            own = {label: (np.array(one) - mean).tolist() for label, one in part.coefficients.items()}
            kept.append(part.model_copy(update={"coefficients": own}))
        return self.model_copy(update={"parts": kept, "levelling": "none"})

    def displaced_um(self, scan: PrintedScan, prediction_um: np.ndarray) -> FloatMap:
        """Return the predicted height of the print with the displacements of this model. Both maps have shape
        (ny, nx) and are in µm.
        """
        prediction = np.asarray(prediction_um, np.float64)
        moves = [part for part in self.parts_of(scan) if part.what in _SHIFTS]
        if not moves:
            return prediction
        places = np.indices(scan.shape, np.float64)
        for part in moves:
            places[_SHIFTS.index(part.what)] += part.map_um(scan) / scan.pitch_um
        return map_coordinates(prediction, places, order=3, mode="nearest")

    def background_um(self, scan: PrintedScan) -> FloatMap:
        """Return the background on the field of the scan, µm, of shape (ny, nx)."""
        backgrounds = (part for part in self.parts_of(scan) if part.what == "background")
        return sum((part.map_um(scan) for part in backgrounds), np.zeros(scan.shape))

    def parts_of(self, scan: PrintedScan) -> list[SharedPart]:
        """Return the parts that apply to the scan; there are none if its field has another size."""
        return [part for part in self.parts if part.of(scan)] if self.fits(scan) else []


def levelled(field: np.ndarray, usable: np.ndarray, levelling: Levelling) -> FloatMap:
    """Fit a surface of the given kind to the usable pixels of a height map. Subtract this surface, but leave
    the mean height of these pixels unchanged.
    """
    if levelling == "none":
        return field
    shapes = polynomials(field.shape, 2)[[0, *LEVELLED[levelling]]]
    basis = shapes[:, usable]
    surface = np.tensordot(least_squares(basis, field[usable])[1:], shapes[1:], axes=1)
    return field - surface + surface[usable].mean()


@lru_cache(maxsize=8)
def polynomials(shape: tuple[int, ...], degree: int) -> FloatMap:
    """Return maps of all products of Legendre polynomials of y and x up to a total degree, ordered by total
    degree. The result has shape (k, ny, nx).
    """
    y, x = (legendre.legvander(np.linspace(-1, 1, n), degree).T for n in shape)
    maps = [np.outer(y[by_y], x[total - by_y]) for total in range(degree + 1) for by_y in range(total + 1)]
    found = np.stack(maps)
    found.setflags(write=False)
    return found


def polynomial_count(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2
