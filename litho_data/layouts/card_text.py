"""A set of layouts on disk: one TIFF per layout, a table, and a dataset card to which scans can be added."""

import csv
import json
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from litho_data.cards.card import check_card
from litho_data.foundation.kinds import YX, Array

CARD_NAME = "card.toml"
TABLE_NAME = "scans.csv"


@dataclass(frozen=True)
class CardText:
    """What a card says about a set of layouts and their scans.

    Args:
        name: name of the dataset.
        title: one line for people.
        pitch_um: pitch of the layouts, µm.
        level_height_um: nominal height of one level, µm.
        levels: number of levels.
        scan_size_um: (y, x) extent of a scan, µm.
        print_pattern: regular expression with a group ``print``, or empty.
        table: whether a table lies beside the card.
        slow_axis: axis across the hatch lines, or empty if it is not stated.
        write_field_um: side of the write field, µm, or None if it is not stated.
        plan_of: hash of the dataset that the layouts were planned from, or empty.
        scan_format: of the files of the microscope.
        grating_um: period of the grating that scans of this use show, or None.
        levelled: whether a build is to take the heights as they are in the files.
    """

    name: str
    title: str
    pitch_um: float
    level_height_um: float
    levels: int
    scan_size_um: YX
    print_pattern: str = ""
    table: bool = True
    slow_axis: str = ""
    write_field_um: float | None = None
    plan_of: str = ""
    scan_format: str = "text-matrix"
    grating_um: float | None = None
    levelled: bool = False

    def toml(self) -> str:
        """The card's text."""
        lines = [
            f"name = {json.dumps(self.name)}",
            f"title = {json.dumps(self.title, ensure_ascii=False)}",
            "",
            "[layout]",
            'files = "layouts/{id}.tif"',
            f"pitch_um = {float(self.pitch_um)}",
            f"level_height_um = {float(self.level_height_um)}",
            f"levels = {self.levels}",
            "",
            "[scan]",
            f'files = "scans/{{id}}.{"txt" if self.scan_format == "text-matrix" else self.scan_format}"',
            f'format = "{self.scan_format}"',
        ]
        if self.scan_format == "text-matrix":
            # The others state both.
            size_y, size_x = (round(side, 9) for side in self.scan_size_um)
            lines += ['unit = "m"', f"size_um = [{size_y}, {size_x}]"]
        lines += ['fast_axis = "x"', *["levelled = true"] * self.levelled]
        if self.print_pattern or self.table:
            lines += ["", "[ids]"]
            lines += [f"print = '{self.print_pattern}'"] * bool(self.print_pattern)
            lines += [f"table = {json.dumps(TABLE_NAME)}"] * self.table
        if self.slow_axis or self.write_field_um is not None:
            lines += ["", "[write]"]
            lines += [f'slow_axis = "{self.slow_axis}"'] * bool(self.slow_axis)
            if self.write_field_um is not None:
                lines.append(f"field_um = {float(self.write_field_um)}")
        if self.plan_of:
            lines += ["", "[plan]", f"dataset_sha256 = {json.dumps(self.plan_of)}"]
        if self.grating_um is not None:
            lines += ["", "[grating]", f"period_um = {float(self.grating_um)}"]
        return "\n".join(lines) + "\n"

    def write(self, folder: Path) -> Path:
        """Write the card into ``folder``.

        Raises:
            InputError: a value that a card may not have.
        """
        path = folder / CARD_NAME
        text = self.toml()
        check_card(tomllib.loads(text), "card to write")
        path.write_text(text, encoding="utf-8")
        return path


def write_layout(folder: Path, scan_id: str, level: Array) -> Path:
    """Write one layout as an 8-bit TIFF of level numbers."""
    import tifffile

    path = folder / "layouts" / f"{scan_id}.tif"
    path.parent.mkdir(parents=True, exist_ok=True)
    # Without a description, the bytes of the file depend only on the levels.
    tifffile.imwrite(path, level, compression="zlib", metadata=None, software=False)
    return path


def write_table(folder: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> Path:
    """Write the card's table."""
    path = folder / TABLE_NAME
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(rows)
    return path
