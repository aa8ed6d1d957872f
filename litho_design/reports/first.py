"""The page of a first result: the wanted image, and both designs as they would be printed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from litho_data.reports.page import Page, capitalised
from litho_design.judging.gap import GapResult, design_folder
from litho_design.judging.loaded import LoadedDesign
from litho_design.printers.printer import Printer
from litho_design.reports.parts import picture_grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The design for a perfect printer, the model that the other was made through, and a further judge.
WITHOUT, DESIGNER, JUDGE = "none", "pbl", "physics"
_NAMES = {WITHOUT: "designed without the model", DESIGNER: "designed with the model"}


def write_first_report(folder: Path, result: GapResult, printers: Mapping[str, Printer]) -> Path:
    """Write ``report.html`` and its table."""
    designs = {
        arm: LoadedDesign(design_folder(folder, arm, result.seeds[0]), device=printers[arm].device)
        for arm in _NAMES
    }
    scores = psnr_db(result)
    page = Page(
        "The same hologram, designed without and with a model of the printer",
        "A printer blurs and shrinks what it prints. A layout made for a perfect printer suffers from "
        "that; a layout made through the model of the printer has already taken it into account.",
        run=result,
        facts={"seed": result.seeds[0]},
    )
    gain, judged = (scores[DESIGNER, by] - scores[WITHOUT, by] for by in (DESIGNER, JUDGE))
    better, doubt = (("better" if one >= 0 else "worse") for one in (gain, judged))
    page.verdict(
        f"Designed with the model, the printed hologram shows the image {abs(gain):.1f} dB {better}: "
        f"{scores[DESIGNER, DESIGNER]:.1f} dB instead of {scores[WITHOUT, DESIGNER]:.1f} dB. That is what "
        f"{DESIGNER} expects of its own design; {JUDGE}, a model that had no part in it, finds it "
        f"{abs(judged):.1f} dB {doubt}. One hologram, so nothing is said about chance."
    )
    page.figure(
        draw_images(designs, printers[DESIGNER], scores),
        "First the wanted image, then what the printed holograms would show, at matched scale.",
    )
    page.note(*(f"{capitalised(note)}." for note in designs[WITHOUT].record.notes))
    page.paragraph(
        "dB is the scale-invariant peak signal-to-noise ratio of the image: higher is better. The prints "
        f"are those that the model {DESIGNER} predicts. One of the layouts was designed through this very "
        f"model, so its figure is an expectation and no measurement; through {JUDGE} neither was designed."
    )
    page.heading("Layouts and prints")
    page.figure(
        _draw_prints(designs, printers[DESIGNER]),
        f"Layouts at their nominal heights, and what the model {DESIGNER} prints of them; all on one scale.",
    )
    page.heading("In numbers", folded=True)
    rows = [
        {"hologram": name} | {f"printed by {judge}, dB": scores[arm, judge] for judge in printers}
        for arm, name in _NAMES.items()
    ]
    page.table(rows, "none: a perfect printer, which prints every level at its height", "scores.csv")
    places = {arm: design_folder(Path(), arm, result.seeds[0]) / "report.html" for arm in _NAMES}
    page.heading("Reports of the two holograms")
    page.links([(places[arm].as_posix(), f"Report of the hologram {name}") for arm, name in _NAMES.items()])
    return page.write(folder)


def psnr_db(result: GapResult) -> dict[tuple[str, str], float]:
    """Scale-invariant PSNR by arm and judge, dB."""
    return {(entry.arm, entry.judge): entry.judged["si_psnr_db"] for entry in result.entries}


def draw_images(
    designs: Mapping[str, LoadedDesign], printer: Printer, scores: Mapping[tuple[str, str], float]
) -> Figure:
    """The wanted image, and the images of the designs as ``printer`` prints them."""
    first = next(iter(designs.values()))
    assert first.target is not None
    pictures = {"wanted": first.target.cpu().numpy()}
    for arm, design in designs.items():
        title = f"{_NAMES[arm]}:\n{scores[arm, DESIGNER]:.1f} dB"
        pictures[title] = design.display(design.image(design.printed_um(printer)))
    return picture_grid({"": pictures}, first.window_um)


def _draw_prints(designs: Mapping[str, LoadedDesign], printer: Printer) -> Figure:
    layout = next(iter(designs.values())).record.layout
    rows = {
        _NAMES[arm]: {
            "layout": (design.level * layout.level_height_um).cpu().numpy(),
            f"its print, predicted by {printer.name}": design.printed_um(printer).cpu().numpy(),
        }
        for arm, design in designs.items()
    }
    highest_um = (layout.levels - 1) * layout.level_height_um
    return picture_grid(rows, layout.size_um, "viridis", highest_um, "height, µm")
