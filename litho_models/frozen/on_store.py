"""Apply a frozen model to a layout file or to the scans of a store, and find the scans on which it was
trained.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from litho_data.level.scan import write_heights
from litho_data.readers.exported import export_of
from litho_data.readers.layout import read_layout
from litho_data.store import PrintedScan, Store
from litho_models.frozen.simulator import FrozenSimulator
from litho_models.scan_terms.background import Background


def predict_file(model: FrozenSimulator, layout: str | Path, out: str | Path) -> tuple[np.ndarray, str]:
    """Predict the print of a layout file, and write its height to ``out``. Return the height in µm, as an
    array of shape (ny, nx), and a phrase that says what was assumed beyond the edge of the layout.

    If ``litho-design`` exported the file, it contains an element that stands alone on the substrate, so level
    0 is assumed beyond the edge of the layout. Every other layout is continued by repeating its outermost
    pixels.

    Args:
        layout: TIFF, PNG, BMP or NPY file, sampled at the pitch of the model. The file contains the level
            number of each pixel, or grey values that represent level numbers. A file that ``litho-design``
            exported is also accepted. The pitch and the level height of such an export are in a second file
            that ``litho-design`` wrote beside the first; both values are checked.
        out: file for the height: ``.gsf`` (opens in Gwyddion) or ``.npy``.

    Raises:
        InputError: the layout cannot be read, its pitch or level height is not that of the model, its heights
            are beyond the calibrated range, or ``out`` has neither of the two suffixes.
    """
    pitch_um = model.pitch_um
    levels = read_layout(layout, levels=model.card["levels"])
    exported = export_of(Path(layout))
    says = {"pitch_um": pitch_um, "level_height_um": model.card["level_height_um"], **exported}
    model.check_geometry(says["pitch_um"], says["level_height_um"])
    around_px = model.guard_px if exported else 0
    nominal_um = np.pad(levels.astype(np.float32) * np.float32(says["level_height_um"]), around_px)
    height = model.inside(torch.from_numpy(nominal_um)[None, None], around_px)[0, 0].numpy()
    write_heights(out, height, pitch_um=(pitch_um, pitch_um), title=f"{Path(layout).name} by {model.name}")
    return height, "surrounded by level 0" if exported else "continued by its outermost levels"


def predict_frozen(model: FrozenSimulator, scan: PrintedScan) -> np.ndarray:
    """Predict the printed height of a scan from its exposure. The result is in µm, float32 of shape (ny,
    nx).
    """
    model.check_geometry(scan.pitch_um, scan.level_height_um)
    return model.predict(scan.exposed_um)


def card_background(model: FrozenSimulator, scans: Sequence[PrintedScan]) -> Background | None:
    """Return the background (mean contribution of the microscope) stored in the model's card. Return None if
    the card has no background for scans of this size.
    """
    stated = model.card["background"]
    learned = Background.model_validate(stated) if stated is not None else None
    return learned if learned is not None and all(learned.fits(scan) for scan in scans) else None


def trained_ids(card: Mapping[str, Any], dataset: Store) -> set[str]:
    """Return the ids of the scans on which the model with this card was trained. The set is empty if the
    model was trained on other prints.
    """
    return set(card["training"].get("scan_ids", [])) if made_of_these_prints(card, dataset) else set()


def made_of_these_prints(card: Mapping[str, Any], dataset: Store) -> bool:
    """Return True if the model with this card was trained on the prints in this store. The prints are taken
    to be the same if the card states the hash of this dataset, or if the store contains scans that were
    locked when the model was trained.
    """
    same_dataset = (card["dataset"] or {}).get("sha256") == dataset.sha256
    return same_dataset or bool(locked_by_the_card(card, dataset))


def locked_scans(card: Mapping[str, Any], dataset: Store) -> list[str]:
    """Return the sorted ids of the scans in a store that count as locked for a model: the scans that the
    store locks, and the scans that were locked when the model was trained.
    """
    return sorted({*dataset.locked_ids, *locked_by_the_card(card, dataset)})


def locked_by_the_card(card: Mapping[str, Any], dataset: Store) -> list[str]:
    """Return the ids of the scans in a store that were locked when the model was trained. The scans are
    recognised by their raw files.

    Raw files are compared because a new build of the store leaves them unchanged. The heights in the store
    change with the settings for levelling and registration, and other scans may be locked if scans are added
    to the store or removed from it. If the card lists no raw files, the scans are recognised by their ids
    instead, but only if the store has the dataset name that the card states.
    """
    split = card["split"]
    if files := split.get("lock_box_files_sha256"):
        return [scan_id for scan_id, file in dataset.files_sha256(dataset.ids).items() if file in files]
    same_name = (card["dataset"] or {}).get("name") == dataset.name
    return [scan_id for scan_id in split.get("lock_box", []) if same_name and scan_id in dataset.ids]
