"""Define the virtual fab, which consists of a printer and a microscope with their knobs and noise. The module
also simulates the print and the scan of one field.
"""

from dataclasses import dataclass

import numpy as np

from litho_data.foundation import Array
from litho_data.virtual_fab.afm import scan_surface
from litho_data.virtual_fab.canvas import cut_layout
from litho_data.virtual_fab.geometry import ScanFrame, place_scan, sample_surface
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.printer import Cause, Job, print_clean, surface_noise
from litho_data.virtual_fab.settings import Microscope, Noise, Printer


@dataclass(frozen=True)
class Fab:
    """A virtual fab. It consists of a printer and a microscope, the knobs (effects that can be added) and the
    noise of both, and the seed of all random draws.

    ``cause`` is an optional effect that you define yourself and that is not a knob.
    """

    printer: Printer
    microscope: Microscope
    noise: Noise
    knobs: KnobBoard
    seed: int
    cause: Cause | None = None


@dataclass(frozen=True)
class FabScan:
    """One simulated scan.

    Args:
        job: the field that was printed and scanned.
        frame: the position of the scan on the layout.
        height_um: heights that the microscope reports, in µm, float64 with the shape (ny, nx) of the scan.
        noiseless_um: heights that the microscope would report without the default noise and without
            roughness, in µm.
        clean_um: heights of the print without roughness, on the layout's grid, in µm.
        surface_um: heights of the print with its roughness, on the layout's grid, in µm.
    """

    job: Job
    frame: ScanFrame
    height_um: Array
    noiseless_um: Array
    clean_um: Array
    surface_um: Array


def scan_job(fab: Fab, job: Job) -> FabScan:
    """Print and scan one field. The result depends only on the fab and the job. It does not depend on the
    other fields of a run.
    """
    geometry_seed, _, instrument_seed = _seeds(fab, job.index)
    roughness_seed = _seeds(fab, job.printed)[1]
    frame = place_scan(
        job.level.shape,
        fab.printer.pitch_um,
        fab.microscope,
        np.random.default_rng(geometry_seed),
        job.turned_deg,
        job.pixel_size,
    )
    surface = print_clean(job, fab.printer, fab.knobs, fab.cause)
    rough = surface_noise(job, fab.printer, fab.noise, fab.knobs, np.random.default_rng(roughness_seed))

    def scan(true_surface: Array, noise: Noise) -> Array:
        sampled = sample_surface(true_surface, frame, fab.knobs, job.index, job.direction)
        if fab.cause is not None:
            sampled = fab.cause.on_scan(sampled, frame, job)
        instrument = np.random.default_rng(instrument_seed)
        return scan_surface(sampled, frame, noise, fab.knobs, job, instrument)

    return FabScan(
        job=job,
        frame=frame,
        height_um=scan(surface + rough, fab.noise),
        noiseless_um=scan(surface, Noise.off()),
        clean_um=cut_layout(surface),
        surface_um=cut_layout(surface + rough),
    )


def _seeds(fab: Fab, index: int) -> list[np.random.SeedSequence]:
    """Return three seeds for the number ``index`` of a scan or a print. The first seed determines the scan's
    position, the second the roughness of the surface, and the third the noise of the microscope.
    """
    return np.random.SeedSequence(fab.seed, spawn_key=(index, 1)).spawn(3)
