"""Elements of more than a millimetre: designed in bands by one or several processes, scored from disk."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.images.targets import Target, load_target
from litho_design.judging.score import JudgedScore, ScoreResult
from litho_design.large.bands import Bands, Ranks
from litho_design.large.cost import disk_gib, fit_cost, measure_size, sent_gib
from litho_design.large.hologram import BandedHologram
from litho_design.large.lens import RingLens, judge_rings
from litho_design.large.score import (
    image_figures,
    image_from_disk,
    in_fields_from_disk,
    on_disk,
    preview,
    print_from_disk,
)
from litho_design.lenses.settings import LensSettings, lens_settings
from litho_design.optics.source import require_one_wave
from litho_design.optimisation.stitching import Stitching
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printer, load_printers
from litho_design.reports.design import write_design_report
from litho_design.reports.score import write_score_report
from litho_design.tasks.design import (
    HEIGHT_FILE,
    IMAGE_FILE,
    LEVELS_FILE,
    TARGET_FILE,
    Design,
    read_array,
)
from litho_design.tasks.run import run_design

BAND_PX = 512


def design_large_hologram(
    target: str | Path | np.ndarray | Target,
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: HologramSettings | None = None,
    band_px: int = BAND_PX,
    device: Device = "cpu",
    extrapolate: bool = False,
    announce: bool = True,
) -> Design:
    """Optimise the layout of a hologram in bands of rows, in this process or shared by those of torchrun.

    Args:
        target, model, out, settings, device, extrapolate, announce: as for ``design_hologram``; with ``cuda``
            each process takes a GPU of its own. The model has to have a finite reach.
        band_px: most rows of a band. Memory for the print grows with its square, and bands are the most
            processes that can share the element; below some four times the model's reach most of the time
            goes into what is printed twice.

    Raises:
        InputError: as ``design_hologram``; settings or a model that a large element cannot have, or more
            processes than bands.
    """
    made, ranks = settings or hologram_settings(), Ranks.joined()
    layout = made.layout
    printer = load_printer(model, layout, device=ranks.device(device), extrapolate=extrapolate)
    bands = Bands(layout.size_px, band_px, ranks, layout.cell_px)
    task = BandedHologram(made, printer, load_target(target, layout.size_px), bands)
    return run_design(task, out, write_design_report, announce=announce)


def design_large_lens(
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: LensSettings | None = None,
    tile_px: int = BAND_PX,
    device: Device = "cpu",
    extrapolate: bool = False,
    announce: bool = True,
) -> Design:
    """Optimise the rings of a lens that focuses light; nothing of the plane is made, up to 10 mm and more.

    Args:
        model, out, settings, device, extrapolate, announce: as for ``design_lens``.
        tile_px: length of the tiles in which the strip along a radius is printed.

    Raises:
        InputError: as ``design_lens``; settings or a model that a lens of rings cannot have.
    """
    made = settings or lens_settings()
    printer = load_printer(model, made.layout, device=device, extrapolate=extrapolate)
    return run_design(RingLens(made, printer, tile_px), out, write_design_report, announce=announce)


def score_from_disk(
    design: str | Path,
    out: str | Path,
    *,
    judges: Iterable[str | Printer],
    band_px: int = BAND_PX,
    stitch: Stitching | None = None,
    extrapolate: bool = False,
) -> ScoreResult:
    """Score the layout of a hologram by models as ``score`` does, with everything large on disk.

    Needs room in ``out`` for 54 bytes per pixel, for the time that it takes.

    Args:
        stitch: write fields that the prints are made of; one draw of their places, as there are many.

    Raises:
        InputError: as ``score``; a design that is no hologram of a thin element, or a judge without a
            finite reach.
    """
    folder, record = Path(design), Design.read(design)
    layout, optics = record.layout, record.optics
    if record.task != "hoe" or optics.element != "thin":
        got, hint = f"{record.task}, {optics.element}", "without --stream" if record.in_rings else ""
        raise InputError("design to score from disk", got=got, wanted="a hologram, thin", hint=hint)
    require_one_wave(optics, "a design to score from disk")
    level, expected, seen, target = (
        read_array(folder, name, on_disk=True) for name in (LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE, TARGET_FILE)
    )
    printers = load_printers(judges, layout, extrapolate=extrapolate)
    if not printers:
        raise InputError("score", got="nothing to judge with", wanted="a judge")
    bands = Bands(layout.size_px, band_px)
    with growing_folder(out, ScoreResult.FILE_NAME):
        scores, pictures = [], {"in design": preview(seen, bands)}
        for printer in printers.values():
            judge = printer.record()
            with tempfile.TemporaryDirectory(prefix=".large-", dir=out) as name:
                room = Path(name)
                height, image = (
                    np.memmap(room / file, np.float32, "w+", shape=level.shape)
                    for file in ("height", "image")
                )
                print_from_disk(level, printer, bands, height)
                printed: np.ndarray = height
                if stitch is not None:
                    printed = in_fields_from_disk(
                        height, layout.pitch_um, stitch, bands, on_disk(room)
                    ).numpy()
                zero_order = image_from_disk(printed, layout.pitch_um, optics, bands, image, on_disk(room))
                off_um = _difference(printed, expected, bands)
                figures = image_figures(image, target, bands) | {"zero_order_share": zero_order}
                pictures[f"printed by {judge.name}"] = preview(image, bands)
            scores.append(JudgedScore.of_print(record, judge, off_um, figures, stitching=stitch))
        result = ScoreResult.of(folder, record, scores)
        brightest = {title: picture / picture.max() for title, picture in pictures.items()}
        write_score_report(Path(out), result, brightest, layout.size_um, {}, layout.size_um)
        result.write(out)
    return result


def score_rings(
    design: str | Path,
    out: str | Path,
    *,
    judges: Iterable[str | Printer],
    tile_px: int = BAND_PX,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> ScoreResult:
    """Score the rings of ``design_large_lens`` as models print them, along the radius.

    Raises:
        InputError: as ``score``, or a judge without a finite reach.
    """
    folder, record = Path(design), Design.read(design)
    printers = load_printers(judges, record.layout, device=device, extrapolate=extrapolate)
    if not printers:
        raise InputError("score", got="nothing to judge with", wanted="a judge")
    with growing_folder(out, ScoreResult.FILE_NAME):
        scores, pictures, side_um = judge_rings(folder, record, list(printers.values()), tile_px)
        result = ScoreResult.of(folder, record, scores)
        shown = {title: np.sqrt(psf / psf.max()) for title, psf in pictures.items()}
        write_score_report(Path(out), result, shown, side_um, {}, side_um)
        result.write(out)
    return result


def estimate_large(
    model: str | Path | Printer,
    settings: HologramSettings,
    measure_px: Sequence[int],
    ranks: int = 1,
    band_px: int = BAND_PX,
    *,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> list[str]:
    """What ``design_large_hologram`` would take with these settings, from small elements measured here.

    Args:
        measure_px: sides of elements, to the largest of which the model of the cost is fitted.
        ranks: processes that would share the element, each on a machine like this one.

    Returns:
        One sentence for each size that was measured, and those of the estimate.

    Raises:
        InputError: no size, sizes that cells do not fill, or what ``design_large_hologram`` refuses.
    """
    sizes = sorted(set(measure_px))
    if not sizes:
        raise InputError("sizes to measure", got="none", wanted="at least one")
    layout, search = settings.layout, settings.search
    Bands(layout.size_px, band_px, Ranks(0, ranks), layout.cell_px)
    printer = load_printer(model, layout, device=device, extrapolate=extrapolate)
    measured = [measure_size(settings, printer, size, band_px) for size in sizes]
    cost, size = fit_cost(measured), layout.size_px
    lines = [
        f"measured: {one.size_px} px, {one.iteration_s:.2f} s per iteration, {one.transforms_s:.2f} s of it "
        f"for the transforms; {one.peak_memory_gib:.2f} GiB"
        for one in measured
    ]
    hours = cost.search_s(size, settings, ranks) / 3600
    lines.append(
        f"estimate for {size} px ({layout.size_um / 1000:.3g} mm), {search.iterations} iterations: "
        f"{cost.iteration_s(size, ranks):.3g} s per iteration, {hours:.3g} h in all; memory "
        f"{cost.memory_of_rank_gib(size, ranks):.3g} GiB{' in each process' if ranks > 1 else ''}; folder of "
        f"{disk_gib(size):.3g} GiB"
    )
    if ranks > 1:
        lines.append(
            f"{ranks} processes on as many machines like this one; each sends "
            f"{sent_gib(size, ranks):.3g} GiB per iteration, whose time is not in the estimate"
        )
    return lines


def _difference(height: np.ndarray, expected: np.ndarray, bands: Bands) -> tuple[float, float]:
    """Mean and rms of one print minus the other, µm."""
    total = square = 0.0
    for band in bands.own():
        off = np.asarray(height[band], np.float64) - expected[band]
        total += float(off.sum())
        square += float(np.square(off).sum())
    pixels = bands.size_px**2
    return total / pixels, float(np.sqrt(square / pixels))
