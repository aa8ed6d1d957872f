"""Describe the state of the printer by values from single scans. For each scan, they are the gain of the
heights, the error of the model, and numbers that describe the layout.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.scan_terms import POLICIES, Blocks, cross_fit
from litho_models.scan_terms.cross_fit import fitted_terms
from litho_models.scoring.metrics import print_gain

_SURFACE = frozenset({"offset", "bow"})


class ScanFigures(Record):
    """Values that compare a scan with the prediction of a model, after the offset, tilt and bow of the scan
    are removed.

    ``gain`` is the slope of the measured height as a function of the predicted height. ``gain_error`` is the
    standard error of the gain (see ``print_gain``), or None if there is only one block. ``error_nm`` is the
    mean absolute error for the policy ``full``, i.e. after 7 terms including the gain are fitted to the scan.
    The terms are not fitted to the pixels on which the error is scored. ``order`` is the position of the scan
    in printing order. ``relief_nm`` and ``steepness`` are the standard deviation and the rms slope of the
    predicted height, which characterise the layout. ``held_out`` is True if the model was not trained on the
    scan.
    """

    scan: str
    print: str
    order: int
    gain: float
    gain_error: float | None
    error_nm: float
    pixels: int
    relief_nm: float
    steepness: float
    dose: float | None = None
    held_out: bool = True


def scan_figures(
    scan: PrintedScan, prediction_um: np.ndarray, *, held_out: bool = True
) -> ScanFigures | None:
    """Return the values that compare a scan with the prediction of a model. Return None for a flat layout,
    which has no gain.

    Offset, tilt and bow are removed from both the measured and the predicted height before the gain is
    fitted. This gives the same gain as a joint fit of all terms (Frisch and Waugh 1933).

    Args:
        scan: the scan.
        prediction_um: height that the model predicts, µm, of shape (ny, nx).
        held_out: True if the model was not trained on the scan.

    Raises:
        InputError: ``cross_fit`` cannot process the scan, for example because the scan is too small.
    """
    blocks = Blocks()
    residual = cross_fit(scan.height_um, prediction_um, scan.valid, POLICIES["full"], blocks).residual_um
    used = np.isfinite(residual)
    level = np.zeros(scan.shape)
    height, expected = (
        np.asarray(part, np.float64) - fitted_terms(part, level, used, _SURFACE)[1]
        for part in (scan.height_um, prediction_um)
    )
    line = print_gain(height, expected, used, block_px=blocks.block_px)
    if np.ptp(scan.mask_level) == 0 or line.slope is None:
        return None
    return ScanFigures(
        scan=scan.id,
        print=scan.print_id,
        order=scan.order,
        gain=line.slope,
        gain_error=line.slope_error,
        error_nm=NM_PER_UM * float(np.abs(residual[used]).mean()),
        pixels=int(used.sum()),
        relief_nm=NM_PER_UM * float(expected[used].std()),
        steepness=float(np.sqrt(sum(np.mean(part**2) for part in np.gradient(expected, scan.pitch_um)))),
        dose=scan.dose,
        held_out=held_out,
    )


def baseline_of(
    scans: Sequence[PrintedScan], predictions_um: Sequence[np.ndarray], *, held_out: bool
) -> list[dict[str, Any]]:
    """Return the ``ScanFigures`` of the scans on which a model was trained, as entries of the model card. The
    list is empty if the scans are too small.
    """
    pairs = zip(scans, predictions_um, strict=True)
    try:
        rows = [scan_figures(scan, expected, held_out=held_out) for scan, expected in pairs]
    except InputError:
        return []
    return [row.model_dump(mode="json") for row in rows if row is not None]
