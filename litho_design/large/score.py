"""Print and score of an existing layout of any size: arrays stay on disk, and one band is in memory.

The figures have the names and meanings of ``HologramScore``; those that need the whole image at once (camera,
resolved target, uniformity) are left out.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.grid import PixelGrid
from litho_design.images.similarity import SSIM_WINDOW_PX, ssim_map
from litho_design.judging.score import JudgedScore, Judgement
from litho_design.large.bands import Allocate, Bands
from litho_design.large.printing import check_printer, print_band
from litho_design.large.propagator import BandedPropagator
from litho_design.optics import Optics, element_field, intensity_share
from litho_design.optics.source import require_one_wave
from litho_design.optimisation.stitching import Stitching, in_fields
from litho_design.printers.printer import Printer
from litho_design.tasks.design import HEIGHT_FILE, IMAGE_FILE, LEVELS_FILE, TARGET_FILE, Design, read_array

_PREVIEW_PX = 1024


def on_disk(folder: Path) -> Allocate:
    """Room for arrays in files of a folder, which are gone from it at once and from the disk when unused."""

    def allocate(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        file = folder / "array.bin"
        kind = torch.empty(0, dtype=dtype).numpy().dtype
        array = np.memmap(file, kind, "w+", shape=shape)
        file.unlink()
        return torch.from_numpy(array)

    return allocate


def judge_from_disk(
    folder: Path,
    record: Design,
    judges: Sequence[Printer],
    band_px: int,
    stitch: Stitching | None,
    out: Path,
) -> Judgement:
    """Score the layout of a hologram by models, with everything large on disk.

    Needs room in ``out`` for 54 bytes per pixel, for the time that it takes.

    Args:
        stitch: write fields that the prints are made of; one draw of their places, as there are many.

    Raises:
        InputError: a design that is no hologram of a thin element, or a judge without a finite reach.
    """
    layout, optics = record.layout, record.optics
    if record.task != "hoe" or optics.element != "thin":
        got = f"{record.task}, {optics.element}"
        raise InputError("design to score from disk", got=got, wanted="a hologram, thin")
    require_one_wave(optics, "a design to score from disk")
    level, expected, seen, target = (
        read_array(folder, name, on_disk=True) for name in (LEVELS_FILE, HEIGHT_FILE, IMAGE_FILE, TARGET_FILE)
    )
    bands = Bands(layout.size_px, band_px)
    scores, pictures = [], {"in design": preview(seen, bands)}
    for printer in judges:
        judge = printer.record()
        with tempfile.TemporaryDirectory(prefix=".large-", dir=out) as name:
            room = Path(name)
            height, image = (
                np.memmap(room / file, np.float32, "w+", shape=level.shape) for file in ("height", "image")
            )
            print_from_disk(level, printer, bands, height)
            printed: np.ndarray = height
            if stitch is not None:
                printed = in_fields_from_disk(height, layout.pitch_um, stitch, bands, on_disk(room)).numpy()
            zero_order = image_from_disk(printed, layout.pitch_um, optics, bands, image, on_disk(room))
            off_um = _difference(printed, expected, bands)
            figures = image_figures(image, target, bands) | {"zero_order_share": zero_order}
            pictures[f"printed by {judge.name}"] = preview(image, bands)
        scores.append(JudgedScore.of_print(record, judge, off_um, figures, stitching=stitch))
    brightest = {title: picture / picture.max() for title, picture in pictures.items()}
    return Judgement(scores, brightest, layout.size_um)


@torch.no_grad()
def print_from_disk(level: np.ndarray, printer: Printer, bands: Bands, height_um: np.ndarray) -> None:
    """Print levels (size, size) into ``height_um`` (size, size), µm, band by band; both may be on disk."""
    check_printer(printer, bands)
    halo, size = printer.halo_px, bands.size_px
    for band in bands.own():
        around = torch.zeros(band.stop - band.start + 2 * halo, size)
        first, last = max(band.start - halo, 0), min(band.stop + halo, size)
        above = first - (band.start - halo)
        around[above : above + last - first] = torch.from_numpy(level[first:last].astype(np.float32))
        height_um[band] = print_band(around.to(printer.device), printer, bands.band_px).cpu().numpy()


@torch.no_grad()
def in_fields_from_disk(
    height_um: np.ndarray, pitch_um: float, stitch: Stitching, bands: Bands, allocate: Allocate
) -> Tensor:
    """A print (size, size), µm, made of write fields that lie off their places, band by band."""
    size, offsets_um = bands.size_px, stitch.offsets_um(bands.size_px, pitch_um, [0])
    reach = math.ceil(np.abs(offsets_um[..., 0]).max() / pitch_um) + 1
    moved = allocate((size, size), torch.float32)
    for band in bands.own():
        first, last = max(band.start - reach, 0), min(band.stop + reach, size)
        part = torch.from_numpy(np.array(height_um[first:last]))
        found = in_fields(part, pitch_um, stitch.field_px(pitch_um), offsets_um, first)
        moved[band] = found[band.start - first : band.stop - first]
    return moved


@torch.no_grad()
def image_from_disk(
    height_um: np.ndarray,
    pitch_um: float,
    optics: Optics,
    bands: Bands,
    image: np.ndarray,
    allocate: Allocate,
) -> float:
    """Share of the incident power behind a print (size, size), into ``image``; returns the zero order."""
    propagator = BandedPropagator(pitch_um, optics, bands, allocate)
    grid, size = propagator.source, bands.size_px
    mean = torch.zeros((), dtype=torch.complex128)

    def wave(band: slice) -> Tensor:
        nonlocal mean
        part = part_of_grid(grid, range(band.start, band.stop))
        field = element_field(torch.from_numpy(np.array(height_um[band])), part, optics, pixels=size**2)
        mean = mean + field.sum(dtype=torch.complex128)
        return field

    def keep(band: slice, field: Tensor) -> None:
        image[band] = intensity_share(field, grid).numpy()

    propagator.carry(wave, keep)
    # A thin element has the same amplitude everywhere, so that its power is known.
    return float(mean.abs().square()) * pitch_um**2 / size**2


def part_of_grid(grid: PixelGrid, rows: range) -> PixelGrid:
    """Some rows of a grid."""
    top = grid.origin_um[0] + rows.start * grid.pitch_um[0]
    return replace(grid, shape=(len(rows), grid.shape[1]), origin_um=(top, grid.origin_um[1]))


def image_figures(image: np.ndarray, target: np.ndarray, bands: Bands) -> dict[str, float]:
    """Figures of an image (size, size), share of the incident power, against its target in [0, 1]."""
    signal = paper = dark = power = square = both = wanted = wanted_square = lit_square = 0.0
    lit = 0
    for band in bands.own():
        share, aim = (np.asarray(one[band], np.float64) for one in (image, target))
        bright = aim > 0.5
        lit += int(bright.sum())
        signal += float(share[bright].sum())
        lit_square += float(np.square(share[bright]).sum())
        dark += float(share[~bright].sum())
        paper += float(share[aim > 0].sum())
        power += float(share.sum())
        square += float(np.square(share).sum())
        both += float((share * aim).sum())
        wanted += float(aim.sum())
        wanted_square += float(np.square(aim).sum())
    pixels = bands.size_px**2
    scale, average = both / max(square, 1e-300), both / wanted
    likeness, clipped = _likeness(image, target, scale, bands)
    mean = signal / lit
    return {
        "eff_signal": signal,
        "eff_paper": paper,
        "eff_window": power,
        "si_psnr_db": -10 * math.log10(max((wanted_square - scale * both) / pixels, 1e-30)),
        "rmse_paper": math.sqrt((square / average**2 - 2 * both / average + wanted_square) / pixels),
        "ssim": likeness,
        "clipped_share": clipped,
        "speckle_contrast": math.sqrt(max(lit_square / lit - mean**2, 0.0)) / mean,
        "background_ratio": mean / (dark / (pixels - lit)),
    }


def preview(image: np.ndarray, bands: Bands) -> np.ndarray:
    """An image of at most about 1,024 px a side: means over squares of pixels."""
    step = -(-bands.size_px // _PREVIEW_PX)
    side = bands.size_px // step
    rows = [
        np.asarray(image[row * step : (row + 1) * step, : side * step], np.float64) for row in range(side)
    ]
    return np.stack([row.reshape(step, side, step).mean((0, 2)) for row in rows])


def _likeness(image: np.ndarray, target: np.ndarray, scale: float, bands: Bands) -> tuple[float, float]:
    """SSIM at the matched scale, and the share of pixels that it clips."""
    around = SSIM_WINDOW_PX // 2
    size, total, clipped = bands.size_px, 0.0, 0
    for band in bands.own():
        first, last = max(band.start - around, 0), min(band.stop + around, size)
        seen = scale * np.asarray(image[first:last], np.float64)
        clipped += int((seen[band.start - first : band.stop - first] > 1).sum())
        found = ssim_map(np.clip(seen, 0, 1), np.asarray(target[first:last], np.float64))
        # Windows that reach over the edge of the element do not count.
        inner = slice(max(band.start, around) - first, min(band.stop, size - around) - first)
        total += float(found[inner, around : size - around].sum())
    return total / (size - 2 * around) ** 2, clipped / size**2


def _difference(height: np.ndarray, expected: np.ndarray, bands: Bands) -> tuple[float, float]:
    """Mean and rms of one print minus the other, µm."""
    total = square = 0.0
    for band in bands.own():
        off = np.asarray(height[band], np.float64) - expected[band]
        total += float(off.sum())
        square += float(np.square(off).sum())
    pixels = bands.size_px**2
    return total / pixels, float(np.sqrt(square / pixels))
