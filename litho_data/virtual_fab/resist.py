"""Simulate the resist and its development: conversion, diffusion, shrinkage, loss of material and residue."""

import numpy as np
import scipy.ndimage

from litho_data.foundation import Array
from litho_data.virtual_fab.canvas import Canvas, blur
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.random_curves import perlin_curve, smooth_map
from litho_data.virtual_fab.settings import Printer

_NARROW_UM = 1.5


def develop(dose: Array, canvas: Canvas, printer: Printer, knobs: KnobBoard) -> Array:
    """Return the heights of the developed and dried print on the canvas, in µm above the zero height of the
    scans.

    The conversion of a column of resist is a logistic function of its dose. When the print dries, a column in
    a denser polymer network shrinks less.

    Args:
        dose: two-photon dose on the canvas; the full dose is 1.
        canvas: the canvas that was written.
        printer: the properties of the resist.
        knobs: the effects that are added to plain printing.
    """
    conversion = _convert(dose, printer, knobs["threshold-softness"])
    if strength := knobs["diffusion-blur"]:
        conversion = blur(conversion, canvas.pitch_um, strength)
    height = printer.full_height_um * conversion
    if strength := knobs["height-saturation"]:
        height = height / (1 + strength * height)
    if strength := knobs["interface-offset"]:
        height = np.maximum(height - strength, 0.0)
    if strength := knobs["field-curvature"]:
        height = height + strength * _field_shape(canvas, knobs) * (canvas.level > 0)
    density = blur(conversion, canvas.pitch_um, printer.network_reach_um)
    height = height * (printer.loose_retention + (1 - printer.loose_retention) * density)
    height = _shrink(height, conversion, canvas, printer, knobs)
    height = _lose_and_leave(height, canvas, knobs)
    if strength := knobs["perlin-gain-y"]:
        height = height * (1 + strength * perlin_curve(canvas.y_um, 6.0, knobs.machine_rng("perlin-gain-y")))
    if strength := knobs["position-bump"]:
        bump = smooth_map(canvas.y_um, canvas.x_um, 8.0, knobs.machine_rng("position-bump"))
        height = height + 1e-3 * strength * bump
    return height + printer.base_um


def _convert(dose: Array, printer: Printer, extra_steepness: float) -> Array:
    """Return the conversion of the resist, a logistic function of the dose. The function is shifted and
    scaled so that the conversion is 0 without dose and 1 at full dose.
    """
    steepness = printer.threshold_steepness * (1 + extra_steepness)

    def logistic(at: Array | float) -> Array:
        return 1 / (1 + np.exp(-steepness * (np.asarray(at) - printer.threshold_dose)))

    return (logistic(dose) - logistic(0.0)) / (logistic(1.0) - logistic(0.0))


def _field_shape(canvas: Canvas, knobs: KnobBoard) -> Array:
    """Return the sum of a random tilt and a random bow over the write field. The sum is scaled so that its
    magnitude does not exceed 1 in the write field.
    """
    rng = knobs.machine_rng("field-curvature")
    y_um, x_um = canvas.field_offset_um()
    half_um = canvas.write_field_um / 2
    tilt_y, tilt_x, bow = rng.uniform(-1, 1, 3)
    shape = tilt_y * y_um / half_um + tilt_x * x_um / half_um + bow * (y_um**2 + x_um**2) / (2 * half_um**2)
    return shape / (abs(tilt_y) + abs(tilt_x) + abs(bow))


def _shrink(height: Array, conversion: Array, canvas: Canvas, printer: Printer, knobs: KnobBoard) -> Array:
    """Return the heights after the shrinkage that knobs cause. ``height`` already includes the shrinkage of
    plain drying.
    """
    if strength := knobs["vertical-shrinkage"]:
        height = height * (1 - strength)
    if strength := knobs["dose-dependent-shrinkage"]:
        reach_um = knobs.machine_rng("dose-dependent-shrinkage").uniform(0.5, 1.0)
        height = height * (1 - strength * (1 - blur(conversion, canvas.pitch_um, reach_um)))
    if strength := knobs["lateral-shrinkage"]:
        size_y_um, size_x_um = canvas.size_um
        pull = strength * height / printer.full_height_um
        rows, columns = np.indices(height.shape, dtype=float)
        rows += pull * (canvas.y_um - size_y_um / 2) / canvas.pitch_um
        columns += pull * (canvas.x_um - size_x_um / 2) / canvas.pitch_um
        height = scipy.ndimage.map_coordinates(height, [rows, columns], order=3, mode="nearest")
    return height


def _lose_and_leave(height: Array, canvas: Canvas, knobs: KnobBoard) -> Array:
    """Return the heights after capillary forces and the developer have changed narrow features and steep
    flanks. The knobs state how strong these effects are.
    """
    window_px = 2 * round(_NARROW_UM / canvas.pitch_um / 2) + 1
    if strength := knobs["feature-collapse"]:
        surroundings = scipy.ndimage.grey_opening(height, size=(window_px, window_px), mode="nearest")
        height = height - strength * (height - surroundings)
    if strength := knobs["trench-residue"]:
        closed = scipy.ndimage.grey_closing(height, size=(window_px, window_px), mode="nearest")
        height = height + strength * (closed - height)
    if knobs.any("slope-thinning", "slope-thinning-x", "slope-thinning-y", "edge-bead"):
        slope_y, slope_x = np.gradient(height, canvas.pitch_um)
        both = knobs["slope-thinning"]
        loss = (both + knobs["slope-thinning-y"]) * slope_y**2 + (
            both + knobs["slope-thinning-x"]
        ) * slope_x**2
        height = height - loss + knobs["edge-bead"] * np.hypot(slope_y, slope_x)
    return height
