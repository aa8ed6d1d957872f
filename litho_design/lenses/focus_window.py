"""The process window of a lens: how sharp its focus stays over defocus and print gain.

The dose of the printer and the distance of the sensor both drift. The gain of the printed height represents
the dose. As in a Bossung plot, there is one curve over defocus for each gain.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.results import Record
from litho_design.lenses.bench import LensBench
from litho_design.lenses.score import half_maximum_width_um

_GAINS = (0.85, 0.925, 1.0, 1.075, 1.15)
_DEFOCUS_STEPS = 7
# Half a Rayleigh depth of focus on each side is lambda / (2 NA^2); the sweep covers one and a half.
_SWEEP_DEPTHS = 0.75
# Share of the modelled print's peak that still counts as in focus (Marechal's limit for a perfect lens).
_KEPT_PEAK = 0.8


class FocusWindow(Record):
    """Strehl ratio and FWHM over gain (rows) and defocus (columns), and the ranges that stay in focus.

    ``depth_of_focus_um`` and ``gain_latitude`` are the widths of the ranges around the modelled print in
    which the peak is at least 80 % of the best in the sweep; the edges of the sweep limit them.
    """

    defocus_um: list[float]
    gain: list[float]
    strehl: list[list[float]]
    fwhm_um: list[list[float]]
    depth_of_focus_um: float
    gain_latitude: float


@torch.no_grad()
def focus_window(bench: LensBench, height_um: Tensor) -> FocusWindow:
    """Sweep a print (size, size), µm, through focus and gain in the optics of ``bench``."""
    optics, layout = bench.optics, bench.layout
    depth = optics.wavelength_um / bench.numerical_aperture**2
    reach = min(_SWEEP_DEPTHS * depth, 0.5 * optics.distance_um)
    defocus = np.linspace(-reach, reach, _DEFOCUS_STEPS)
    peak = float(bench(bench.ideal_height_um()).max())
    strehl = np.empty((len(_GAINS), len(defocus)))
    width = np.empty_like(strehl)
    for column, shift in enumerate(defocus):
        shifted = optics.model_copy(update={"distance_um": optics.distance_um + float(shift)})
        here = LensBench(layout, shifted, bench.view).to(height_um.device)
        for row, gain in enumerate(_GAINS):
            psf = here(height_um * gain).double()
            strehl[row, column] = float(psf.max()) / peak
            width[row, column] = half_maximum_width_um(psf, layout.pitch_um)
    limit = _KEPT_PEAK * strehl.max()
    return FocusWindow(
        defocus_um=defocus.tolist(),
        gain=list(_GAINS),
        strehl=strehl.tolist(),
        fwhm_um=width.tolist(),
        depth_of_focus_um=range_above(defocus, strehl[_GAINS.index(1.0)], limit),
        gain_latitude=range_above(np.array(_GAINS), strehl[:, len(defocus) // 2], limit),
    )


def range_above(positions: np.ndarray, values: np.ndarray, limit: float) -> float:
    """Width of the range around the largest value in which ``values`` stay above ``limit``.

    Linear between samples; an end of the samples ends the range.
    """
    best = int(np.argmax(values))
    if values[best] < limit:
        return 0.0
    ends = []
    for step in (-1, 1):
        at = best
        while 0 <= at + step < len(values) and values[at + step] >= limit:
            at += step
        end = float(positions[at])
        if 0 <= at + step < len(values):
            part = (values[at] - limit) / (values[at] - values[at + step])
            end += part * float(positions[at + step] - positions[at])
        ends.append(end)
    return ends[1] - ends[0]
