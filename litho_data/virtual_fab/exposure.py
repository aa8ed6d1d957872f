"""Simulate the exposure of the resist, which is written in hatch lines and slices. Effects of the beam, the
galvo scanner and the write field are included.
"""

import numpy as np
import scipy.ndimage

from litho_data.foundation import Array
from litho_data.layouts.random_layout import random_layout
from litho_data.virtual_fab.canvas import (
    GUARD_PX,
    Canvas,
    apply_transfer,
    blur,
    cut_layout,
    frequencies_per_um,
    set_layout,
)
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.settings import Printer

_SLICE_STEEPNESS = 20.0
_SLICE_THRESHOLD = 0.5


def accumulate_dose(
    canvas: Canvas,
    printer: Printer,
    knobs: KnobBoard,
    *,
    relative_dose: float = 1.0,
    order: float = 0.0,
    scan_index: int = 0,
) -> Array:
    """Return the two-photon dose on the canvas. It is 1 in the middle of a wide block of the highest level.

    Each row of the canvas is one hatch line. In slice k, the laser is on where the level is at least k.
    Absorption is proportional to the squared intensity of the spot. The dose, summed over all slices, is
    therefore the array of levels convolved with the squared intensity.

    Args:
        canvas: the canvas that is written.
        printer: the printer, whose spot and number of levels are used.
        knobs: the effects that are added to plain printing.
        relative_dose: two-photon dose of this print relative to the nominal dose.
        order: position in the order of printing, from −0.5 (first) to 0.5 (last).
        scan_index: number of the print. Random draws that differ from print to print depend on it.
    """
    nominal = canvas.level / (printer.levels - 1)
    if strength := knobs["unseen-neighbours"]:
        around = random_layout(
            nominal.shape,
            levels=printer.levels,
            pitch_um=printer.pitch_um,
            seed=knobs.scan_rng("unseen-neighbours", scan_index),
        )
        mixed = (1 - strength) * nominal + strength * (around / (printer.levels - 1))
        nominal = set_layout(mixed, cut_layout(nominal))
    if strength := knobs["level-error"]:
        wrong_level = int(knobs.machine_rng("level-error").integers(3, max(4, printer.levels - 4)))
        nominal = nominal + (canvas.level == wrong_level) * (strength / printer.full_height_um)
    if strength := knobs["stitching"]:
        side_px = round(printer.stitch_field_um / canvas.pitch_um)
        starts = [field_starts(size, side_px) for size in nominal.shape]
        rng = knobs.scan_rng("stitching", scan_index)
        offset_px = rng.standard_normal((len(starts[0]), len(starts[1]), 2)) * (strength / canvas.pitch_um)
        nominal = write_in_fields(nominal, starts, offset_px)
    if strength := knobs["galvo-nonlinearity"]:
        nominal = _unevenly_written(nominal, canvas, strength)
    line_energy = relative_dose * (1 + knobs["laser-drift"] * order) * _field_response(canvas, knobs)
    spot = _spot_transfer(canvas, printer, knobs)
    dose = apply_transfer(nominal * line_energy, spot)
    if strength := knobs["layer-stacking"]:
        dose = (1 - strength) * dose + strength * _slice_by_slice(nominal, line_energy, spot, printer)
    if strength := knobs["long-range-proximity"]:
        reach_um = knobs.machine_rng("long-range-proximity").uniform(2.0, 5.0)
        dose = (dose + strength * blur(dose, canvas.pitch_um, reach_um)) / (1 + strength)
    if strength := knobs["write-order-memory"]:
        decay_um = knobs.machine_rng("write-order-memory").uniform(1.0, 4.0)
        dose = dose - strength * _earlier_lines(dose, canvas.pitch_um, decay_um)
    # No dose is negative, but rounding in spectral filters can give values below zero.
    dose = np.maximum(dose, 0.0)
    if strength := knobs["dose-exponent"]:
        dose = dose ** (1 + strength)
    return dose


def _unevenly_written(nominal: Array, canvas: Canvas, strength: float) -> Array:
    """Return the nominal dose if positions along the hatch lines have an error. The dose that the layout
    places at x is written at x + strength·x(1 − x/L).

    The coordinate x runs from 0 to L, where L is the side of the write field.
    """
    side_um = canvas.write_field_um
    at_um = canvas.field_offset_um()[1] + side_um / 2
    # The equation x + strength·x(1 − x/L) = at has two roots. The point that is written at ``at`` is the root
    # that is 0 for at = 0.
    onwards = 1 + strength
    inside = np.clip(at_um, 0, side_um)
    meant_um = 2 * inside / (onwards + np.sqrt(onwards**2 - 4 * strength * inside / side_um))
    rows, columns = np.indices(nominal.shape, dtype=float)
    meant = columns + (meant_um - inside) / canvas.pitch_um
    # Cubic interpolation overshoots at the edges of levels. The spot smooths this overshoot.
    return scipy.ndimage.map_coordinates(nominal, [rows, meant], order=3, mode="nearest")


def field_starts(size_px: int, side_px: int) -> list[int]:
    """Return the first pixel of each write field along one axis of the canvas.

    The first and the last write field include the guard frame.
    """
    return [0, *range(GUARD_PX + side_px, size_px - GUARD_PX, side_px)]


def write_in_fields(nominal: Array, starts: list[list[int]], offset_px: Array) -> Array:
    """Displace every write field by its own offset, and return the resulting nominal dose. Where displaced
    fields overlap, their doses add up.

    Args:
        nominal: nominal dose on the canvas.
        starts: two lists: the first row of every field along y, and the first column of every field along x,
            in pixels of the canvas.
        offset_px: displacements (y, x) of the fields in pixels, shape (fields along y, fields along x, 2).
            The dose of a displaced pixel is divided among the four pixels that it covers.
    """
    written = np.zeros_like(nominal)
    ends = [[*first[1:], size] for first, size in zip(starts, nominal.shape, strict=True)]
    for row, column in np.ndindex(offset_px.shape[:2]):
        field = slice(starts[0][row], ends[0][row]), slice(starts[1][column], ends[1][column])
        alone = np.zeros_like(nominal)
        alone[field] = nominal[field]
        written += scipy.ndimage.shift(alone, offset_px[row, column], order=1, mode="grid-constant")
    return written


def _field_response(canvas: Canvas, knobs: KnobBoard) -> Array | float:
    """Return the dose at every pixel, relative to the dose at the centre of the write field."""
    if not (strength := knobs["vignetting"]):
        return 1.0
    y_um, x_um = canvas.field_offset_um()
    corner_um2 = canvas.write_field_um**2 / 2
    return np.maximum(1 - strength * (y_um**2 + x_um**2) / corner_um2, 0.0)


def _spot_transfer(canvas: Canvas, printer: Printer, knobs: KnobBoard) -> Array:
    """Return the transfer function of the spot's squared intensity. It includes the ellipticity of the spot,
    a ghost spot and the lag of the galvo scanner.
    """
    frequency_y, frequency_x = frequencies_per_um(canvas.level.shape, canvas.pitch_um)
    # The square of a Gaussian is a Gaussian that is narrower by a factor of √2.
    sigma_um = printer.spot_sigma_um / 2**0.5
    transfer = np.exp(-2 * (np.pi * sigma_um) ** 2 * (frequency_y**2 + frequency_x**2))
    if strength := knobs["elliptical-psf"]:
        axis = knobs.machine_rng("elliptical-psf").uniform(0, np.pi)
        along = frequency_x * np.cos(axis) + frequency_y * np.sin(axis)
        transfer = transfer * np.exp(-2 * (np.pi * strength * along) ** 2)
    if strength := knobs["galvo-lag"]:
        transfer = transfer / (1 + 2j * np.pi * frequency_x * strength)
    if strength := knobs["ghost-spot"]:
        rng = knobs.machine_rng("ghost-spot")
        distance_um, direction = rng.uniform(0.8, 2.0), rng.uniform(0, 2 * np.pi)
        shift = frequency_x * np.cos(direction) + frequency_y * np.sin(direction)
        transfer = transfer * (1 + strength * np.exp(-2j * np.pi * distance_um * shift))
    return transfer


def _slice_by_slice(nominal: Array, line_energy: Array | float, spot: Array, printer: Printer) -> Array:
    """Return the effective dose of a resist that responds to every slice separately, and not to the sum of
    all doses. A slice is exposed only where its own dose exceeds a threshold.
    """
    slices = printer.levels - 1
    passed = np.zeros_like(nominal)
    for index in range(slices):
        exposed = np.clip(nominal * slices - index, 0.0, 1.0) * line_energy
        dose = apply_transfer(exposed, spot)
        passed += _soft_step(dose) / slices
    return passed


def _soft_step(dose: Array) -> Array:
    """Return a logistic function of the dose, scaled so that it is exactly 0 at dose 0 and exactly 1 at dose
    1.
    """
    low, high = (1 / (1 + np.exp(-_SLICE_STEEPNESS * (edge - _SLICE_THRESHOLD))) for edge in (0.0, 1.0))
    return (1 / (1 + np.exp(-_SLICE_STEEPNESS * (dose - _SLICE_THRESHOLD))) - low) / (high - low)


def _earlier_lines(dose: Array, pitch_um: float, decay_um: float) -> Array:
    """Return, for every hatch line, the weighted mean dose of the lines above it, which were written earlier.
    The weights fall exponentially with the distance of these lines, with the decay length ``decay_um``.
    """
    memory = np.exp(-pitch_um / decay_um)
    from scipy.signal import lfilter  # its import takes a second

    return lfilter([0.0, 1 - memory], [1.0, -memory], dose, axis=0)
