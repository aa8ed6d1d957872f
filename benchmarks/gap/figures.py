"""Draw the figures of the comparison: images, point spread functions (PSFs) and spectra, as designed and
after printing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.reports.pictures import new_figure
from litho_design.judging.gap import GapResult, design_folder
from litho_design.judging.loaded import LoadedDesign
from litho_design.printers.printer import Printer
from litho_design.printers.source import load_printer

_DETAIL_PX = 160


def draw_images(folder: Path, gap: GapResult, judge: tuple[str, str] | None, path: Path) -> None:
    """Draw the holograms, with one column per arm. A column shows the image that the design predicted, the
    image after printing, and the centre of the print.
    """
    judged = _judged(folder, gap, judge)
    figure = new_figure(2.4 * len(judged) + 0.4, 7.4)
    axes = figure.subplots(3, len(judged), squeeze=False)
    for column, (arm, (judging, printer)) in enumerate(judged.items()):
        height = judging.printed_um(printer)
        expected = judging.image(judging.expected_um)
        pictures = [judging.display(expected), judging.display(judging.image(height))]
        for row, picture in enumerate(pictures):
            axes[row, column].imshow(picture, cmap="inferno", vmin=0, vmax=1.5)
        axes[2, column].imshow(_middle(height.cpu().numpy()), cmap="viridis", vmin=0, vmax=1.2)
        axes[0, column].set_title(f"designed with {arm}", fontsize=9)
        axes[1, column].set_title(f"printed by {printer.name}", fontsize=9)
        axes[2, column].set_title("centre of the print, 0 to 1.2 µm", fontsize=9)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    axes[0, 0].set_ylabel("in design")
    axes[1, 0].set_ylabel("after printing")
    axes[2, 0].set_ylabel("print")
    # Lossless formats compress speckle badly.
    figure.savefig(path, dpi=90, pil_kwargs={"quality": 80})


def draw_lens(folder: Path, gap: GapResult, judge: tuple[str, str] | None, path: Path) -> None:
    """Draw the lenses, with one column per arm. A column shows a line through the PSF and its spectrum, both
    as designed and as printed.
    """
    judged = _judged(folder, gap, judge)
    figure = new_figure(2.5 * len(judged) + 0.4, 4.8)
    axes = figure.subplots(2, len(judged), squeeze=False, sharey="row")
    pitch = gap.settings.layout.pitch_um
    for column, (arm, (judging, printer)) in enumerate(judged.items()):
        prints = {"in design": judging.expected_um, "printed": judging.printed_um(printer)}
        for name, height in prints.items():
            psf = judging.image(height)
            x = (np.arange(psf.shape[0]) - (psf.shape[0] - 1) / 2) * pitch
            axes[0, column].plot(x, 1e4 * psf[psf.shape[0] // 2], label=name)
            spectrum = np.abs(np.fft.rfft(psf.sum(0)))
            axes[1, column].plot(np.fft.rfftfreq(psf.shape[0], pitch), spectrum)
        axes[0, column].set_title(f"designed with {arm}", fontsize=9)
        axes[0, column].set(xlim=(-6, 6), xlabel="x, µm")
        axes[1, column].set(xlim=(0, 0.6), xlabel="cycles/µm")
    axes[0, 0].set_ylabel("share per pixel, 1e-4")
    axes[1, 0].set_ylabel("|spectrum|")
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, dpi=80)


def _judged(
    folder: Path, gap: GapResult, judge: tuple[str, str] | None
) -> dict[str, tuple[LoadedDesign, Printer]]:
    """Return, for each arm, its first design and the printer that judges it. Without a judge, each arm is
    judged by the last of the other arms.
    """
    names = list(gap.arms)
    judged = {}
    for arm in names:
        if judge is None:
            other = [name for name in names if name not in (arm, "none")][-1]
            name, source = other, gap.arms[other].source
        else:
            name, source = judge
        printer = load_printer(source, gap.settings.layout, name=name)
        judged[arm] = (LoadedDesign(design_folder(folder, arm, gap.seeds[0])), printer)
    return judged


def _middle(height: np.ndarray) -> np.ndarray:
    side = min(height.shape[0], _DETAIL_PX)
    first = (height.shape[0] - side) // 2
    return height[first : first + side, first : first + side]
