"""Scores of a hologram that is printed band by band."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from litho_data.foundation.errors import InputError
from litho_design.holograms.bench import zero_order_share
from litho_design.judging.score import JudgedScore, Judgement
from litho_design.large.bands import Bands
from litho_design.large.figures import image_figures, preview
from litho_design.large.hologram import BandedBench
from litho_design.large.printing import check_printer, print_bands
from litho_design.optics import element_field
from litho_design.optics.source import require_one_wave
from litho_design.optimisation.stitching import Stitching
from litho_design.printers.printer import Printer
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Design, read_array


@torch.no_grad()
def judge_in_bands(
    folder: Path, record: Design, judges: Sequence[Printer], band_px: int, stitch: Stitching | None
) -> Judgement:
    """Score the layout of a hologram as models print it band by band, in 64 bytes per pixel.

    Args:
        stitch: write fields of the prints; one draw of their displacements is enough, as there are many.

    Raises:
        InputError: a design that is no thin hologram, or a judge without a finite reach.
    """
    layout, optics = record.layout, record.optics
    if record.task != "hoe" or optics.element != "thin":
        got = f"{record.task}, {optics.element}"
        raise InputError("design to score in bands", got=got, wanted="a thin hologram")
    require_one_wave(optics, "a design to score in bands")
    level, expected, seen, target = (
        read_array(folder, name) for name in (LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE, TARGET_FILE)
    )
    bands = Bands(layout.size_px, band_px)
    bench: BandedBench | None = None
    scores, pictures = [], {"in design": preview(seen, bands)}
    for printer in judges:
        judge = printer.record()
        check_printer(printer, bands)
        bench = bench or BandedBench(layout.pitch_um, optics, bands, printer.device)
        height = print_bands(torch.from_numpy(level).float().to(printer.device), printer, bands)
        if stitch is not None:
            height = stitch.drawn(height, layout.pitch_um, [0])
        image = bench(height).cpu().numpy()
        element = element_field(height, bench.grid, optics)
        off = height.cpu().numpy() - expected
        off_um = float(off.mean(dtype=float)), float(np.sqrt(np.square(off).mean(dtype=float)))
        figures = image_figures(image, target, bands) | {"zero_order_share": zero_order_share(element)}
        pictures[f"printed by {judge.name}"] = preview(image, bands)
        scores.append(JudgedScore.of_print(record, judge, off_um, figures, stitching=stitch))
    brightest = {title: picture / picture.max() for title, picture in pictures.items()}
    return Judgement(scores, brightest, layout.size_um)
