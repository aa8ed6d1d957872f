"""Draw the pictures of docs/virtual_fab.md: `python docs/figures/draw_virtual_fab.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from litho_data.reports.pictures import new_figure
from litho_data.virtual_fab import KNOBS, Fab, Job, KnobSetting, Microscope, Noise, Printer, scan_job
from litho_data.virtual_fab.jobs import Plan, random_jobs
from litho_data.virtual_fab.knobs import KnobBoard

FOLDER = Path(__file__).parent
SEED = 5


def draw_prints() -> None:
    """Two plain prints of either cut-off, a flat print, a bare substrate and a staircase, as scanned."""
    fab = Fab(Printer(), Microscope(), Noise(), KnobBoard((), SEED), SEED)
    plan = Plan(count=2, size_px=(256, 256), fields_per_print=1, references=True)
    figure = new_figure(10.5, 6.4)
    for place, job in enumerate(random_jobs(plan, fab.printer, SEED), start=1):
        scan = scan_job(fab, job)
        height_nm = 1e3 * (scan.height_um - scan.height_um.mean())
        axes = figure.add_subplot(2, -(-plan.total // 2), place)
        shown = axes.imshow(height_nm, cmap="afmhot", extent=(0, 27, 27, 0))
        what = f"random, {(0.25, 0.5)[place - 1]} cycles/µm" if job.use == "dataset" else job.use
        axes.set_title(f"{what}\nSq {height_nm.std():.3g} nm", fontsize=10)
        axes.set_axis_off()
        figure.colorbar(shown, ax=axes, label="nm", shrink=0.8)
    _save(figure, "virtual_fab_prints.jpg")


def draw_knobs() -> None:
    """What every knob changes at a third of its range, without noise, on one layout."""
    job = next(random_jobs(Plan(count=2, size_px=(96, 96), fields_per_print=1), Printer(), SEED))
    plain = _noise_free(job, ())
    columns = 5
    rows = -(-len(KNOBS) // columns)
    figure = new_figure(2.1 * columns, 2.3 * rows)
    for place, knob in enumerate(KNOBS.values(), start=1):
        strength = knob.limit / 3
        change_nm = 1e3 * (_noise_free(job, (KnobSetting(knob.name, strength, SEED),)) - plain)
        if knob.name == "line-roughness":
            change_nm = 1e3 * _roughness(job, strength)
        largest = np.abs(change_nm).max()
        axes = figure.add_subplot(rows, columns, place)
        axes.imshow(change_nm, cmap="RdBu_r", vmin=-largest, vmax=largest)
        unit = "" if knob.unit == "1" else f" {knob.unit}"
        axes.set_title(
            f"{knob.name}\n{_two_digits(strength)}{unit}, {_two_digits(change_nm.std())} nm", fontsize=10
        )
        axes.set_axis_off()
    _save(figure, "virtual_fab_knobs.jpg")


def _two_digits(value: float) -> str:
    """A number with two digits and without a power of ten; what rounding left of nothing is nothing."""
    return f"{float(f'{value:.2g}') if value > 1e-6 else 0:g}"


def _save(figure: Figure, name: str) -> None:
    # Noise does not compress without loss; the pictures have to stay small in a repository.
    # On the page they are 690 px wide, where ten points then have nine pixels.
    figure.savefig(FOLDER / name, dpi=90, pil_kwargs={"quality": 60})


def _noise_free(job: Job, knobs: tuple[KnobSetting, ...]) -> np.ndarray:
    fab = Fab(Printer(), Microscope.aligned(), Noise.off(), KnobBoard(knobs, SEED), SEED)
    return scan_job(fab, job).noiseless_um


def _roughness(job: Job, strength_nm: float) -> np.ndarray:
    board = KnobBoard((KnobSetting("line-roughness", strength_nm, SEED),), SEED)
    scan = scan_job(Fab(Printer(), Microscope.aligned(), Noise.off(), board, SEED), job)
    return scan.height_um - scan.noiseless_um


if __name__ == "__main__":
    draw_prints()
    draw_knobs()
