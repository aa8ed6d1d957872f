"""Draw the plots of the noise report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.reports.pictures import LIGHT, new_figure
from litho_models.noise.calibration import SpreadAnalysis
from litho_models.noise.dose import DoseMatrix
from litho_models.noise.staircase import READABLE_AT
from litho_models.noise.surface import without_background

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from litho_models.noise.references import Reference


def surfaces(references: Sequence[Reference]) -> Figure:
    """Draw the height map of each reference scan, minus its mean. The maps of substrates and of flat prints
    share one colour scale.
    """
    figure = new_figure(3.1 * len(references) + 0.6, 3.2)
    grid = figure.subplots(1, len(references), squeeze=False)[0]
    rough = [one for one in references if one.use != "steps"]
    widest = max((np.nanstd(without_background(one.height_um, "offset")) for one in rough), default=0.01)
    for axes, one in zip(grid, references, strict=True):
        height_nm = NM_PER_UM * without_background(one.height_um, "offset")
        ny, nx = height_nm.shape
        extent = (0, nx * one.pitch_um[1], ny * one.pitch_um[0], 0)
        bound = None if one.use == "steps" else 3 * NM_PER_UM * float(widest)
        low = None if bound is None else -bound
        image = axes.imshow(height_nm, extent=extent, cmap="viridis", vmin=low, vmax=bound)
        axes.set_title(f"{one.use}: {one.id}", fontsize=9)
        axes.set_xlabel("x, µm", fontsize=9)
        figure.colorbar(image, ax=axes, shrink=0.75, label="nm")
    return figure


def dose(found: DoseMatrix) -> Figure:
    """Draw the height of each level at each dose, and the readability as a function of the dose. Doses at
    which steps are lost are shaded.
    """
    figure = new_figure(8.5, 3.2)
    left, right = figure.subplots(1, 2)
    doses = np.array([row.dose for row in found.rows])
    for row in found.rows:
        levels = [entry.level for entry in row.levels]
        share = (row.dose - doses.min()) / np.ptp(doses)
        left.plot(
            levels,
            [entry.height_nm for entry in row.levels],
            color=(0.1 + 0.8 * share, 0.3, 0.8 - 0.7 * share),
            lw=1,
            label=f"{row.dose:.3g}",
        )
    left.set(xlabel="level", ylabel="height above the lowest level, nm")
    left.legend(fontsize=8, title="dose", title_fontsize=8)
    right.plot(doses, [row.worst_readability for row in found.rows], "o-", color="#0b6aa2", ms=4)
    right.axhline(READABLE_AT, color="#9aa7b5", ls="--", lw=1)
    right.set(xlabel="relative dose", ylabel="worst step over σ")
    right.axvline(found.recommended_dose, color="#2d8a4e", lw=1.2)
    width = np.ptp(doses) / max(1, len(doses) - 1) / 2
    for row in found.rows:
        if row.lost_low or row.lost_high:
            right.axvspan(row.dose - width, row.dose + width, color="#d99b00", alpha=0.15, lw=0)
    return figure


def spread(found: SpreadAnalysis) -> Figure:
    """Draw the rms of the residual in ranges of each covariate. Points show the measured rms, and a line
    shows the predicted rms.
    """
    names = list(dict.fromkeys(row.covariate for row in found.bins if row.covariate != "all"))
    figure = new_figure(2.8 * len(names), 2.9)
    grid = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for axes, name in zip(grid, names, strict=True):
        rows = [row for row in found.bins if row.covariate == name]
        centre = [(row.low + row.high) / 2 for row in rows]
        axes.plot(centre, [row.rms_nm for row in rows], "o", color=LIGHT["ink"], ms=4, label="measured")
        axes.plot(centre, [row.predicted_nm for row in rows], "-", color="#0b6aa2", label="predicted")
        axes.set_xlabel(name)
        axes.grid(alpha=0.3)
    grid[0].set_ylabel("rms of the residual, nm")
    grid[0].set_ylim(bottom=0)
    grid[0].legend(fontsize=8)
    return figure


def calibration(found: SpreadAnalysis) -> Figure:
    """Draw the coverage of the 90 % interval for each scan, and the histogram of the probability integral
    transform (``Calibration.pit``).
    """
    figure = new_figure(9.5, 3.2)
    left, right = figure.subplots(1, 2)
    for number, described in enumerate(found.calibrations):
        at = described.levels.index(0.9)
        covered = [100 * row.coverage[at] for row in described.scans]
        left.plot(range(len(covered)), covered, "o-", ms=3, lw=0.8, color=f"C{number}", label=described.name)
        edges = np.linspace(0, 1, len(described.pit) + 1)
        right.stairs(np.array(described.pit) * len(described.pit), edges, color=f"C{number}", lw=1.2)
    scans = [row.scan for row in found.calibrations[0].scans]
    left.set_xticks(range(len(scans)), scans, rotation=90, fontsize=8)
    left.axhline(90, color="#9aa7b5", lw=1)
    left.set_ylabel("pixels inside the 90 % interval, %")
    left.legend(fontsize=8)
    right.axhline(1, color="#9aa7b5", lw=1)
    right.set(xlabel="Φ(residual / σ)", ylabel="density (flat if σ is right)")
    return figure
