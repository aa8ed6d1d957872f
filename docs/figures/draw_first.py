"""Draw the picture at the head of the README and keep its figures: `python docs/figures/draw_first.py`."""

from __future__ import annotations

import tempfile
from pathlib import Path

from litho_data.commands.progress import run_script
from litho_design import first, load_design, load_printer
from litho_design.judging.gap import design_folder
from litho_design.reports.first import DESIGNER, WITHOUT, draw_images, psnr_db

FOLDER = Path(__file__).parents[1] / "results" / "first"


def main() -> None:
    """Run what `litho-design first` runs; a committed picture has to be small."""
    with tempfile.TemporaryDirectory() as folder:
        result = first(folder)
        designs = {arm: load_design(design_folder(Path(folder), arm, 0)) for arm in (WITHOUT, DESIGNER)}
        printer = load_printer(f"zoo:{DESIGNER}", result.settings.layout)
        figure = draw_images(designs, printer, psnr_db(result))
    result.write(FOLDER)
    figure.savefig(FOLDER / "first.jpg", dpi=90, bbox_inches="tight", pil_kwargs={"quality": 85})


if __name__ == "__main__":
    run_script(main)
