"""Simulate the printing of one field, from the layout to the dried surface."""

from dataclasses import dataclass

import numpy as np

from litho_data.cards.card import Use
from litho_data.foundation import YX, Array
from litho_data.virtual_fab.canvas import Canvas, frame_layout, gaussian_transfer
from litho_data.virtual_fab.exposure import accumulate_dose
from litho_data.virtual_fab.geometry import ScanFrame
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.random_curves import gaussian_field, line_roughness
from litho_data.virtual_fab.resist import develop
from litho_data.virtual_fab.settings import Noise, Printer

_SUBSTRATE_GRAIN_UM = 0.3
# Height of a calibration grating with a square profile, and width of its flanks, in µm.
_GRATING_UM, _FLANK_UM = 0.5, 0.2


@dataclass(frozen=True)
class Job:
    """One field to print and scan.

    Args:
        id: name of the scan.
        level: levels of the layout, uint8 of shape (ny, nx).
        index: number of the scan. The random draws for the scan depend on this number.
        order: position in the order of printing, from −0.5 (first) to 0.5 (last).
        dose: two-photon dose relative to the nominal dose.
        field_um: centre (y, x) of the layout in its write field, in µm from the write field's centre.
        write_field_um: side of the write field in µm. With None, the write field is as large as the layout.
        use: purpose of the scan. If it is ``substrate`` (a bare substrate) or ``grating`` (a calibration
            standard), nothing is printed.
        grating_um: period of the grating in µm.
        print_index: number of the print, for a print that is scanned more than once. With None, this number
            is equal to ``index``.
        turned_deg: rotation of the print under the microscope in degrees, a multiple of 90.
        direction: direction of the scan lines, 1 for trace and -1 for retrace.
        tip: number of the tip. Tip 1 is as blunt as the knobs state; every later tip is new and sharp.
        pixel_size: size of the scan's pixels, in pixels of the layout. The tip spends the same time on every
            pixel, whether the pixel is large or small.
    """

    id: str
    level: Array
    index: int = 0
    order: float = 0.0
    dose: float = 1.0
    field_um: YX = (0.0, 0.0)
    write_field_um: float | None = None
    use: Use = "dataset"
    grating_um: float | None = None
    print_index: int | None = None
    turned_deg: float = 0.0
    direction: float = 1.0
    tip: float = 1.0
    pixel_size: float = 1.0

    @property
    def printed(self) -> int:
        """Return the number of the print. The random draws for the print depend on this number. The random
        draws for the scan depend on ``index``.
        """
        return self.index if self.print_index is None else self.print_index

    def canvas(self, pitch_um: float) -> Canvas:
        """Return the canvas of the field, i.e. the layout with its guard frame. The canvas also states where
        the layout lies in the write field.
        """
        side_um = self.write_field_um or max(self.level.shape) * pitch_um
        return Canvas(frame_layout(self.level), pitch_um, self.field_um, side_um)


class Cause:
    """Base class for effects that you define yourself and that are not knobs. The base class itself changes
    nothing.

    A subclass overrides one or more of the methods. The result of a method may depend only on its arguments,
    because a field may be printed and scanned more than once.
    """

    def on_dose(self, dose: Array, canvas: Canvas, job: Job) -> Array:
        """Return the two-photon dose on the canvas after the effect has changed it. The full dose is 1, and
        no dose may be negative.
        """
        return dose

    def on_surface(self, surface_um: Array, canvas: Canvas, job: Job) -> Array:
        """Return the heights of the dried surface without roughness after the effect has changed them, on the
        canvas, in µm.
        """
        return surface_um

    def on_scan(self, height_um: Array, frame: ScanFrame, job: Job) -> Array:
        """Return the true heights at the pixels of the scan after the effect has changed them, in µm. The
        microscope adds its errors later.
        """
        return height_um


def print_clean(job: Job, printer: Printer, knobs: KnobBoard, cause: Cause | None = None) -> Array:
    """Return the heights of one print without roughness, on the canvas, in µm. A bare substrate has height
    0.
    """
    cause = cause or Cause()
    canvas = job.canvas(printer.pitch_um)
    if job.use == "substrate":
        return np.zeros(canvas.level.shape)
    if job.use == "grating" and job.grating_um is not None:
        return _GRATING_UM * np.minimum(
            *(_bars(at_um, job.grating_um) for at_um in (canvas.y_um, canvas.x_um))
        )
    dose = accumulate_dose(
        canvas, printer, knobs, relative_dose=job.dose, order=job.order, scan_index=job.printed
    )
    height = develop(cause.on_dose(dose, canvas, job), canvas, printer, knobs)
    if strength := knobs["hatch-ripple"]:
        rng = knobs.machine_rng("hatch-ripple")
        hatch_um = printer.pitch_um * (1 + rng.choice([-1, 1]) * rng.uniform(0.02, 0.04))
        ripple = np.cos(2 * np.pi * canvas.y_um / hatch_um + rng.uniform(0, 2 * np.pi))
        height = height + 1e-3 * strength * ripple * (canvas.level > 0)
    return cause.on_surface(height, canvas, job)


def _bars(at_um: Array, period_um: float) -> Array:
    """Return the profile of a grating at the given positions. The profile is 1 on the bars, which are half a
    period wide, and 0 between them. The flanks of the bars are straight lines.
    """
    away_um = np.abs(at_um % period_um - period_um / 2)
    return np.clip(0.5 + (away_um - period_um / 4) / _FLANK_UM, 0.0, 1.0)


def surface_noise(
    job: Job, printer: Printer, noise: Noise, knobs: KnobBoard, rng: np.random.Generator
) -> Array:
    """Return the heights of the surface's roughness, on the canvas, in µm."""
    canvas = job.canvas(printer.pitch_um)
    shape = canvas.level.shape
    if job.use in ("substrate", "grating"):
        grain_psd = gaussian_transfer(shape, printer.pitch_um, _SUBSTRATE_GRAIN_UM) ** 2
        return 1e-3 * noise.substrate_nm * gaussian_field(grain_psd, rng, shape)
    rough_nm = noise.roughness_nm * line_roughness(shape, printer.pitch_um, rng)
    if strength := knobs["line-roughness"]:
        more = line_roughness(shape, printer.pitch_um, knobs.scan_rng("line-roughness", job.printed))
        rough_nm = rough_nm + strength * more
    return 1e-3 * rough_nm
