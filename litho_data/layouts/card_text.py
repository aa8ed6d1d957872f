"""Write a set of layouts to disk: one TIFF file per layout, a table, and a dataset card to which scans can be
added later.
"""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from litho_data.cards.card import check_card
from litho_data.foundation import YX, Array, Facts
from litho_data.store.schema import Instrument

CARD_NAME = "card.toml"
TABLE_NAME = "scans.csv"


def write_card(
    folder: Path,
    *,
    name: str,
    title: str,
    pitch_um: float,
    level_height_um: float,
    levels: int,
    scan_size_um: YX,
    scan_format: str = "text-matrix",
    levelled: bool = False,
    instrument: Instrument = "afm",
    **tables: Facts,
) -> Path:
    """Write a dataset card for layouts in the subfolder ``layouts`` and their scans in the subfolder
    ``scans``.

    The scans may be added later.

    Args:
        folder: folder in which the card is written. It contains both subfolders.
        name: name of the dataset.
        title: title of the dataset, on one line.
        pitch_um: pixel pitch of the layouts, µm.
        level_height_um: nominal height of a level, µm.
        levels: number of levels.
        scan_size_um: extent of a scan along y and along x, µm.
        scan_format: format of the microscope's files.
        levelled: whether the scan files will contain levelled heights, which a build uses as they are.
        instrument: kind of instrument that makes the scans.
        tables: further tables of the card, such as ``ids`` and ``write``; values that are None are omitted.

    Raises:
        InputError: a value is not allowed in a card.
    """
    plain = scan_format == "text-matrix"  # files of other formats state the unit and the size themselves
    scan = {
        "files": f"scans/{{id}}.{'txt' if plain else scan_format}",
        "format": scan_format,
        "unit": "m" if plain else None,
        "size_um": [round(side, 9) for side in scan_size_um] if plain else None,
        "fast_axis": "x",
        "levelled": levelled or None,
        "instrument": None if instrument == "afm" else instrument,
    }
    layout = {
        "files": "layouts/{id}.tif",
        "pitch_um": float(pitch_um),
        "level_height_um": float(level_height_um),
        "levels": levels,
    }
    card: dict[str, Any] = {"name": name, "title": title, "layout": layout, "scan": scan, **tables}
    card = {key: _stated(value) if isinstance(value, Mapping) else value for key, value in card.items()}
    check_card(card, "card to write")
    text = _toml({"name": name, "title": title})
    for key, table in card.items():
        if isinstance(table, Mapping):
            text += f"\n[{key}]\n{_toml(table)}"
    path = folder / CARD_NAME
    path.write_text(text, encoding="utf-8")
    return path


def _stated(table: Facts) -> dict[str, Any]:
    return {key: value for key, value in table.items() if value is not None}


def _toml(table: Facts) -> str:
    # Strings, numbers, booleans and lists of them look the same in JSON and in TOML.
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in table.items())


def write_layout(folder: Path, scan_id: str, level: Array) -> Path:
    """Write one layout as a TIFF of level numbers."""
    import tifffile

    path = folder / "layouts" / f"{scan_id}.tif"
    path.parent.mkdir(parents=True, exist_ok=True)
    # Without a description in the TIFF, the bytes of the file depend only on the levels.
    tifffile.imwrite(path, level, compression="zlib", metadata=None, software=False)
    return path


def write_table(folder: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> Path:
    """Write the CSV table of facts about each scan, to which the card refers."""
    path = folder / TABLE_NAME
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(rows)
    return path
