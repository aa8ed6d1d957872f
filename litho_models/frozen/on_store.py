"""Apply a frozen model to a file of levels or to a store, and find the scans on which it was trained."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from litho_data.level.scan import write_heights
from litho_data.readers.exported import export_of
from litho_data.readers.layout import read_layout
from litho_data.store import PrintedScan, Store
from litho_models.frozen.simulator import FrozenSimulator
from litho_models.scan_terms.background import Background


def predict_file(model: FrozenSimulator, layout: str | Path, out: str | Path) -> np.ndarray:
    """Predict the print of a layout of levels, and write its height to ``out``; return the height, (ny, nx)
    µm.

    Args:
        layout: TIFF, PNG, BMP or NPY file of integer levels, or of grey values that represent levels, sampled
            at the model's pitch. Any export of the design package is also accepted, because its sidecar
            states the pitch and the level height.
        out: a ``.gsf`` (opens in Gwyddion) or ``.npy`` file.

    Raises:
        InputError: the layout cannot be read or has levels beyond the calibrated range, or ``out`` has
            another suffix.
    """
    pitch_um = model.pitch_um
    levels = read_layout(layout, levels=model.card["levels"])
    says = {"pitch_um": pitch_um, "level_height_um": model.card["level_height_um"], **export_of(Path(layout))}
    height = model.predict(levels * np.float32(says["level_height_um"]), pitch_um=says["pitch_um"])
    write_heights(out, height, pitch_um=(pitch_um, pitch_um), title=f"{Path(layout).name} by {model.name}")
    return height


def predict_frozen(model: FrozenSimulator, scan: PrintedScan) -> np.ndarray:
    """Predict the height of a scan with a frozen model, float32 (ny, nx) µm."""
    model.check_geometry(scan.pitch_um, scan.level_height_um)
    return model.predict(scan.layout_um)


def card_background(model: FrozenSimulator, scans: Sequence[PrintedScan]) -> Background | None:
    """Return the background in a model's card, if the card has one for scans of this size."""
    stated = model.card["background"]
    learned = Background.model_validate(stated) if stated is not None else None
    return learned if learned is not None and all(learned.fits(scan) for scan in scans) else None


def trained_ids(model: FrozenSimulator, dataset: Store) -> set[str]:
    """Return the scans on which the model was trained; none if it was made from other prints."""
    return set(model.card["training"].get("scan_ids", [])) if made_of_these_prints(model, dataset) else set()


def made_of_these_prints(model: FrozenSimulator, dataset: Store) -> bool:
    """Return whether a model was made from the prints in a store: from the same dataset, or with the same
    locked scans.
    """
    same_dataset = (model.card["dataset"] or {}).get("sha256") == dataset.sha256
    return same_dataset or bool(locked_by_the_card(model, dataset))


def locked_by_the_card(model: FrozenSimulator, dataset: Store) -> list[str]:
    """Return the scans of a store that were locked when the model was made, identified by their raw files.

    Another recipe or registration changes every height of a store, and an added or missing scan changes the
    choice of locked scans. Neither changes a raw file. If a card lists no raw files, return the ids in its
    lock box, but only for a dataset of the same name.
    """
    split = model.card["split"]
    if files := split.get("lock_box_files_sha256"):
        return [scan_id for scan_id, file in dataset.files_sha256(dataset.ids).items() if file in files]
    same_name = (model.card["dataset"] or {}).get("name") == dataset.name
    return [scan_id for scan_id in split.get("lock_box", []) if same_name and scan_id in dataset.ids]
