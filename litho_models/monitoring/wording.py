"""Write the verdict and the notes of a check in sentences, which are filled into templates."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.reports.page import filled
from litho_models.monitoring.change_point import SOON
from litho_models.monitoring.prints import WATCHED, FigureCheck, in_order
from litho_models.scan_terms import Blocks
from litho_models.scoring.printer_state import ScanFigures

# The new layouts count as layouts of another kind in two cases: every new relief exceeds the largest relief
# of the reference scans by more than this factor, or every new relief is smaller than the smallest relief of
# the reference scans by more than this factor. The same rule is applied to the steepness.
_OTHER_KIND = 1.1
# The error on training scans is smaller than on unseen scans. A difference up to this value, in units of the
# spread of the error between reference scans, does not raise the rate of false alarms noticeably.
_BEARABLE_OPTIMISM = 0.25


def verdict(checks: Sequence[FigureCheck], rate: float) -> list[str]:
    """Return the verdict as a list of sentences, with the most important sentence first."""
    return _sentences("verdict", checks=checks, rate=rate, soon=SOON)


def notes(
    reference: Sequence[ScanFigures],
    new: Sequence[ScanFigures],
    checks: Sequence[FigureCheck],
    parameters: int = 0,
) -> list[str]:
    """Return sentences about the limits of the verdict. ``parameters`` is the number of parameters of the
    model.
    """
    return _sentences(
        "notes",
        checks=checks,
        new=new,
        parameters=parameters,
        optimistic=too_optimistic(reference, parameters),
        other_layouts=_other_layouts(reference, new),
        scans_per_print=[len(rows) / len(in_order(rows)) for rows in (reference, new)],
    )


def _sentences(template: str, **values: object) -> list[str]:
    return filled(Path(__file__).with_name(f"{template}.jinja"), watched=WATCHED, **values).splitlines()


def too_optimistic(reference: Sequence[ScanFigures], parameters: int) -> bool:
    """Return True if the model was trained on the reference scans and its errors on them are too small to
    compare with errors on unseen prints.

    On scans that were used in the fit, a model has a smaller error than on unseen scans. The relative
    difference is about the number of parameters divided by the number of independent pixels. A square of
    pixels whose side is the correlation length of the residual counts as one independent pixel.
    """
    independent = sum(row.pixels for row in reference if not row.held_out) / Blocks().buffer_px ** 2
    spread = float(np.std([WATCHED["error"].of(row) for row in reference], ddof=1))
    return independent > 0 and parameters > _BEARABLE_OPTIMISM * spread * independent


def _other_layouts(reference: Sequence[ScanFigures], new: Sequence[ScanFigures]) -> bool:
    for name in ("relief_nm", "steepness"):
        known, now = ([getattr(row, name) for row in rows] for rows in (reference, new))
        if min(now) > _OTHER_KIND * max(known) or max(now) < min(known) / _OTHER_KIND:
            return True
    return False
