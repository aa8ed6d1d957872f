"""Draw the picture at the head of the README and keep its figures: `python docs/figures/draw_first.py`."""

from __future__ import annotations

import tempfile
from pathlib import Path

from litho_data.commands.progress import run_script
from litho_design import first, load_design, load_printer
from litho_design.judging.gap import design_folder
from litho_design.reports.pictures import Panel, panels_figure
from litho_design.workflows.first import DESIGNER, WITHOUT

FOLDER = Path(__file__).parents[1] / "results" / "first"


def main() -> None:
    """Run what `litho-design first` runs; a committed picture has to be small."""
    with tempfile.TemporaryDirectory() as folder:
        result = first(folder)
        printer = load_printer(f"zoo:{DESIGNER}", result.settings.layout)
        figures = {one.arm: one.judged["si_psnr_db"] for one in result.entries if one.judge == DESIGNER}
        pictures = {}
        for arm, told in {WITHOUT: "without", DESIGNER: "with"}.items():
            design = load_design(design_folder(Path(folder), arm, 0))
            assert design.target is not None
            pictures.setdefault("wanted", design.target.numpy())
            title = f"designed {told} the model:\n{figures[arm]:.1f} dB"
            pictures[title] = design.display(design.image(design.printed_um(printer)))
        figure = panels_figure([[Panel(*shown, design.window_um) for shown in pictures.items()]])
    result.write(FOLDER)
    figure.savefig(FOLDER / "first.jpg", dpi=90, bbox_inches="tight", pil_kwargs={"quality": 85})


if __name__ == "__main__":
    run_script(main)
