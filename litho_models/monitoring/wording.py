"""The text of a check, from templates: the verdict and the notes beside it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.reports.page import filled
from litho_models.monitoring.change_point import SOON
from litho_models.monitoring.prints import WATCHED, FigureCheck, in_order
from litho_models.scan_terms import Blocks
from litho_models.scoring.printer_state import ScanFigures

# A layout this much flatter, higher or steeper than every reference layout is of another kind.
_OTHER_KIND = 1.1
# Largest optimism of a fit, in spreads, with which the rate of false alarms still holds.
_BEARABLE_OPTIMISM = 0.25


def verdict(checks: Sequence[FigureCheck], rate: float) -> list[str]:
    """The verdict in sentences, the most important first."""
    return _sentences("verdict", checks=checks, rate=rate, soon=SOON)


def notes(
    reference: Sequence[ScanFigures],
    new: Sequence[ScanFigures],
    checks: Sequence[FigureCheck],
    parameters: int = 0,
) -> list[str]:
    """Notes on the limits of the verdict; ``parameters``: number of parameters of the model."""
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
    """Whether the reference's errors are too small to compare errors on unseen prints with.

    On a fit's own scans an error is too small by the ratio of parameters to independent pixels. Neighbours
    within a correlation length of the residual count once.
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
