"""Collect the monitored values of the new scans and of the reference scans. The reference is another store,
other prints of the same store, or the values in the model's card.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import first_error
from litho_data.store import Store, open_store
from litho_models.frozen.on_store import locked_scans, made_of_these_prints, predict_frozen, trained_ids
from litho_models.frozen.simulator import FrozenSimulator
from litho_models.scoring.printer_state import ScanFigures, scan_figures

FEWEST_REFERENCE_PRINTS = 4
# If the measured heights of the reference prints are less than half or more than twice the predicted heights,
# the model is taken to describe another printer.
_OWN_GAIN = (0.5, 2.0)


class Figures(NamedTuple):
    """The monitored values of the reference scans and of the new scans. ``dropped`` lists the excluded scans,
    each with the reason. ``words`` is a text that describes the reference.

    ``between`` is True if new prints may have been made between reference prints.
    """

    reference: list[ScanFigures]
    new: list[ScanFigures]
    dropped: list[str]
    words: str
    between: bool = False


def gather(
    frozen: FrozenSimulator, dataset: Store, reference: str | Path | None, new: Sequence[str]
) -> Figures:
    """Compute the monitored values of the scans of the new prints and of the reference prints. Scans are
    dropped if they state a dose other than the most frequent dose of the reference scans.

    Raises:
        InputError: there is no reference, or more than one; a print is unknown; a store has another pitch or
            level height than the model; a scan is both in the store of the new prints and in the store of the
            reference prints; or there are too few prints.
    """
    if reference is not None and new:
        raise InputError("reference", got="both a store and --new", wanted="only one of these")
    frozen.check_geometry(dataset.pitch_um, dataset.level_height_um)
    dropped: list[str] = []
    if reference is not None:
        other = open_store(reference)
        _check_apart(dataset, other)
        frozen.check_geometry(other.pitch_um, other.level_height_um)
        known, words = _rows(frozen, other, dropped), f"{other.name}, {reference}"
    elif not new:
        known, words = _of_card(frozen, dataset), f"the prints in the card of {frozen.name}"
    rows = _rows(frozen, dataset, dropped)
    if new:
        _require_prints(new, rows, dataset)
        known, words = [row for row in rows if row.print not in new], f"the other prints of {dataset.name}"
        rows = [row for row in rows if row.print in new]
    found = _of_one_dose(Figures(known, rows, dropped, words, between=bool(new)))
    _check_reference(found.reference, frozen)
    if not found.new:
        raise InputError(
            f"scans of {dataset.path}",
            got="none to compare",
            wanted="at least one that has the same dose as the reference",
        )
    return found


def _require_prints(names: Sequence[str], rows: Sequence[ScanFigures], dataset: Store) -> None:
    known = list(dict.fromkeys(row.print for row in rows))
    if unknown := [name for name in names if name not in known]:
        raise InputError(
            "--new", got=unknown[0], wanted=f"a print of {dataset.path}: {', '.join(known[:30])}"
        )


def _of_card(frozen: FrozenSimulator, dataset: Store) -> list[ScanFigures]:
    """Return the monitored values of the prints on which the model was trained. The values are read from the
    model's card. Raise an InputError if the store contains these prints.
    """
    hint = "use --reference STORE, or --new PRINT to compare it with the other prints of this store"
    if not frozen.card["baseline"]:
        raise InputError(
            f"card of {frozen.name}",
            got="no values of reference prints",
            wanted="reference values",
            hint=hint,
        )
    if made_of_these_prints(frozen.card, dataset):
        raise InputError(
            f"store {dataset.path}",
            got="the prints from which the model was made",
            wanted="new prints",
            hint=hint,
        )
    try:
        return [ScanFigures.model_validate(row) for row in frozen.card["baseline"]]
    except ValidationError as error:
        raise InputError(f"baseline in the card of {frozen.name}", got=first_error(error)) from error


def _rows(frozen: FrozenSimulator, store: Store, dropped: list[str]) -> list[ScanFigures]:
    """Compute the monitored values of the scans of a store. Add excluded scans to ``dropped``: scans of flat
    layouts and, if the model was trained on prints of this store, locked scans.
    """
    seen, locked = trained_ids(frozen.card, store), []
    if made_of_these_prints(frozen.card, store):
        locked = locked_scans(frozen.card, store)
        dropped += [f"{scan_id}: lock box" for scan_id in locked]
    rows = []
    for scan in (store.scan(scan_id) for scan_id in store.ids if scan_id not in locked):
        row = scan_figures(scan, predict_frozen(frozen, scan), held_out=scan.id not in seen)
        if row is None:
            dropped.append(f"{scan.id}: a flat layout has no gain")
        else:
            rows.append(row)
    return rows


def _of_one_dose(found: Figures) -> Figures:
    """Keep only the scans at the dose that is most frequent among the reference scans. At another dose, which
    was set on purpose, the gain is different, so these scans are excluded. Scans that state no dose are kept.
    """
    doses = Counter(row.dose for row in found.reference if row.dose is not None)
    if not doses:
        return found
    dose = doses.most_common(1)[0][0]
    kept = [[row for row in rows if row.dose in (None, dose)] for rows in (found.reference, found.new)]
    others = [row for row in (*found.reference, *found.new) if row.dose not in (None, dose)]
    dropped = [*found.dropped, *(f"{row.scan}: dose {row.dose:g}, not {dose:g}" for row in others)]
    return found._replace(reference=kept[0], new=kept[1], dropped=dropped)


def _check_apart(dataset: Store, other: Store) -> None:
    files, known = (set(store.files_sha256(store.ids).values()) for store in (dataset, other))
    if dataset.sha256 == other.sha256 or files & known:
        raise InputError(
            "reference",
            got=f"{other.path}, which shares scans with {dataset.path}",
            wanted="a store without the checked scans",
            hint="use --new PRINT to compare some prints of a store with its other prints",
        )


def _check_reference(rows: Sequence[ScanFigures], frozen: FrozenSimulator) -> None:
    prints = len({row.print for row in rows})
    if prints < FEWEST_REFERENCE_PRINTS:
        raise InputError(
            "prints in the reference",
            got=prints,
            wanted=f"at least {FEWEST_REFERENCE_PRINTS}, which show how much unchanged prints differ",
        )
    gain = float(np.median([row.gain for row in rows]))
    if not _OWN_GAIN[0] < gain < _OWN_GAIN[1] or min(row.gain for row in rows) <= 0:
        raise InputError(
            f"heights of the reference prints, compared with model {frozen.name}",
            got=f"{gain:.2f} times the predicted heights",
            wanted=f"{_OWN_GAIN[0]:g} to {_OWN_GAIN[1]:g}",
            hint="the model describes another printer, or scans and layouts do not belong together",
        )
