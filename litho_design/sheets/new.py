"""Make a sheet that a lab prints and scans. It contains random layouts, witness (test) patterns, and two
versions of a hologram.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.foundation.begun import growing_folder
from litho_data.foundation.files import atomic_file
from litho_data.foundation.run_facts import run_facts
from litho_data.layouts.card_text import TABLE_NAME, write_card, write_layout, write_table
from litho_data.layouts.patterns import flat, framed_ladder
from litho_data.layouts.random_layout import random_layout
from litho_data.reports.page import filled
from litho_design.exports.files import export
from litho_design.exports.job import Format
from litho_design.holograms.settings import HologramSettings
from litho_design.images.targets import Target
from litho_design.judging.gap import design_folder
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.source import Device
from litho_design.sheets.record import ARMS, HOLOGRAM, SCANS_OF_HOLOGRAMS, Field, Sheet
from litho_design.workflows.compare import compare
from litho_design.workflows.first import small_hologram

TO_PRINTER, PAGE = "to-printer", "sheet.md"
# Cut-off frequencies, in cycles per µm, which successive random layouts use in turn. The layouts of the
# published measured prints have the same cut-off frequencies.
_CUTOFFS_PER_UM = (0.25, 0.5)
# Number of steps of the staircase pattern. The pattern covers only three fifths of a side, and the printer
# rounds the edges of the steps. Few steps are therefore used, so that they are wide.
_TREADS = 10
_WITNESSES = {
    "substrate": "bare substrate without a print, which shows the zero, tilt and bow of the microscope",
    "flat": "one level everywhere, which shows the noise floor",
    "steps": "a stair in a random frame, which shows height against level",
}
_HOLOGRAMS = {
    "without": "the hologram, designed for a perfect printer",
    "with": "the hologram, designed through the model",
}


def new_sheet(
    out: str | Path,
    *,
    model: str = "zoo:pbl",
    format: Format = "stl",
    target: str | Path | np.ndarray | Target = "text",
    settings: HologramSettings | None = None,
    layouts: int = 12,
    seed: int = 0,
    device: Device = "cpu",
    announce: bool = True,
) -> Sheet:
    """Write a sheet into ``out``: files for the printer, a dataset card, and a page of instructions for the
    lab.

    Args:
        out: folder of the sheet; an interrupted run in it resumes.
        model: model with which one version of the hologram is designed. The other version is designed without
            a model.
        format: format of the files for the printer, as for ``export``.
        target: target image of the hologram.
        settings: settings of both versions of the hologram, by default those of ``small_hologram``. All
            fields of the sheet have the size, pitch and number of levels of the hologram.
        layouts: number of random layouts from which the printer model is learned.
        seed: seed of the random layouts.
        device, announce: as for ``design_hologram``.

    Raises:
        InputError: ``compare`` or ``export`` rejects an argument, or the fields are too small for the
            staircase pattern.
    """
    made = settings or small_hologram()
    asked = {"model": str(model), "format": format, "layouts": layouts, "seed": seed}
    asked |= {"design": made.model_dump(mode="json")}
    geometry = made.layout
    with growing_folder(out, Sheet.FILE_NAME, {"settings": asked}) as begun:
        folder = begun.folder
        levels = _layouts(geometry, layouts, seed)
        gap = compare(
            made, {"without": "none", "with": model}, folder / HOLOGRAM, target=target, seeds=(0,),
            device=device, announce=announce,
        )  # fmt: skip
        fields: list[Field] = []
        for name, level in levels.items():
            write_layout(folder, name, level)
            what = _WITNESSES.get(name, "a random layout, to fit the printer model")
            file = "" if name == "substrate" else _exported(level, format, folder, name, geometry)
            fields.append(Field(order=len(fields), id=name, file=file, what=what))
        for arm in ARMS:
            design = design_folder(folder / HOLOGRAM, arm, 0)
            file = _exported(design, format, folder, f"{HOLOGRAM}-{arm}", geometry)
            fields.append(Field(order=len(fields), id=arm, file=file, what=_HOLOGRAMS[arm]))
        rows = [(one.id, one.order, one.id if one.id in _WITNESSES else "dataset") for one in fields]
        write_table(folder, ("id", "order", "use"), rows[: len(levels)])
        write_card(
            folder,
            name="printed-sheet",
            title="Prints and scans of one sheet, for learning a printer model",
            scan_size_um=(geometry.size_um, geometry.size_um),
            pitch_um=geometry.pitch_um,
            level_height_um=geometry.level_height_um,
            levels=geometry.levels,
            ids={"table": TABLE_NAME},
            write={"slow_axis": "y"},
        )
        sheet = Sheet(
            **run_facts(),
            settings=asked,
            side_um=geometry.size_um,
            level_height_um=geometry.level_height_um,
            levels=geometry.levels,
            fields=fields,
            expected_db={one.arm: one.judged["si_psnr_db"] for one in gap.entries if one.judge == "with"},
        )
        with atomic_file(folder / PAGE) as temporary:
            page = Path(__file__).with_name(f"{PAGE}.jinja")
            text = filled(page, sheet=sheet, holograms=ARMS, place=SCANS_OF_HOLOGRAMS)
            temporary.write_text(text, encoding="utf-8")
        sheet.write(folder)
    return sheet


def _layouts(geometry: LayoutSettings, count: int, seed: int) -> dict[str, np.ndarray]:
    """Return the levels of the fields from which a model of the printer is learned, keyed by field id. The
    witness patterns come first, followed by the random layouts.
    """
    shape = geometry.size_px, geometry.size_px

    def random(number: int) -> np.ndarray:
        return random_layout(
            shape,
            levels=geometry.levels,
            cutoff_per_um=_CUTOFFS_PER_UM[number % len(_CUTOFFS_PER_UM)],
            pitch_um=geometry.pitch_um,
            seed=np.random.SeedSequence(seed, spawn_key=(number,)),
        )

    highest = geometry.levels - 1
    digits = len(str(count))
    return {
        "substrate": flat(shape, level=0),
        "flat": flat(shape, level=highest // 2),
        "steps": framed_ladder(random(count), highest=highest, tread_px=geometry.size_px // _TREADS),
        **{f"L{number + 1:0{digits}}": random(number) for number in range(count)},
    }


def _exported(
    source: np.ndarray | Path, format: Format, folder: Path, name: str, geometry: LayoutSettings
) -> str:
    """Write the printer's file for one field, and return the path of this file relative to the folder of the
    sheet.
    """
    size = geometry.pitch_um, geometry.level_height_um
    file = export(source, format, folder / TO_PRINTER / name, pitch_um=size[0], level_height_um=size[1])
    return file.relative_to(folder).as_posix()
