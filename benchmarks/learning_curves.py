"""Learning curves of the paper's recipe: error by epoch, and what they let expect of further epochs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.markdown_table import markdown_table
from litho_data.foundation.report_pictures import new_figure
from litho_models.evaluation.fit_cache import FitRecord
from litho_models.fitting.config import PAPER_BATCH, PAPER_CROPS, PAPER_EPOCHS

STEPS_PER_EPOCH = PAPER_CROPS // PAPER_BATCH
# Errors are averaged over the last fifth of all epochs, and over the same fifth of the first half of them.
_LAST = 0.8
_COLOURS = {"pbl": "#0b6aa2", "fno": "#c2571a", "physics": "#5b7f3b"}


def curve_table(fits: Sequence[FitRecord]) -> str:
    """One row per curve: the error after half and all of the epochs, and what that change would lead to."""
    trained = fits[0].steps[-1] / STEPS_PER_EPOCH
    doublings = math.log2(PAPER_EPOCHS / trained)
    rows = []
    for fit in fits:
        epochs = np.array(fit.steps) / STEPS_PER_EPOCH
        for label, errors in _curves(fit).items():
            half, whole = (_last_fifth(epochs, errors, end) for end in (trained / 2, trained))
            rows.append(
                (
                    fit.model,
                    label,
                    f"{errors.min():.2f} nm, epoch {epochs[errors.argmin()]:.0f}",
                    *(f"{mean:.2f} ± {spread:.2f} nm" for mean, spread in (half, whole)),
                    f"{whole[0] * (whole[0] / half[0]) ** doublings:.1f} nm",
                )
            )
    heads = ("model", "error on", "lowest", f"epoch {trained / 2:.0f}", f"epoch {trained:.0f}")
    return markdown_table(
        (*heads, f"epoch {PAPER_EPOCHS:,}, if it went on so"),
        rows,
        "Training: absolute error of the steps, datum included. Choosing quadrants: the two that choose the "
        "checkpoint, datum-free. Mean and standard deviation over a fifth of the epochs up to the one named. "
        f"The last column is no measurement: each of the {doublings:.1f} doublings that are missing changes "
        "the error by the factor of the last one.",
    )


def draw_curves(fits: Sequence[FitRecord], path: Path) -> None:
    """Error by epoch, both axes logarithmic."""
    figure = new_figure(8, 4.2)
    axes = figure.subplots()
    for fit in fits:
        epochs = np.array(fit.steps) / STEPS_PER_EPOCH
        for (label, errors), style in zip(_curves(fit).items(), (":", "-"), strict=True):
            colour = _COLOURS[fit.model]
            axes.loglog(epochs, errors, style, color=colour, linewidth=1.4, label=f"{fit.model}, {label}")
    axes.set_xlabel(f"epochs, of the paper's {PAPER_EPOCHS:,}")
    axes.set_ylabel("mean absolute error (nm)")
    shown = [4, 10, 40, 100, 400]
    axes.set_xticks(shown, [str(epoch) for epoch in shown])
    ticks = [15, 20, 30, 40, 60, 100, 200, 300]
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def _curves(fit: FitRecord) -> dict[str, NDArray[np.float64]]:
    return {
        "training": np.array(fit.training_mae_nm),
        "choosing quadrants": np.array(fit.validation_mae_datum_free_nm),
    }


def _last_fifth(epochs: NDArray[np.float64], errors: NDArray[np.float64], end: float) -> tuple[float, float]:
    inside = errors[(epochs > _LAST * end) & (epochs <= end)]
    return float(inside.mean()), float(inside.std(ddof=1))
