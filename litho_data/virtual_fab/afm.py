"""Simulate the microscope: the shape of its tip, the lag of its feedback, drift, line offsets, tilt, bow, the
datum (height zero) and the quantisation of heights.
"""

import numpy as np
import scipy.ndimage

from litho_data.foundation import YX, Array
from litho_data.virtual_fab.geometry import ScanFrame
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Noise

_TIP_OVERSAMPLING = 10
_DRIFT_DECAY_ROWS = 0.15


def scan_surface(
    surface_um: Array,
    frame: ScanFrame,
    noise: Noise,
    knobs: KnobBoard,
    job: Job,
    rng: np.random.Generator,
) -> Array:
    """Return the heights, in µm, that the microscope reports for a surface.

    The fast axis is x, and the top line is scanned first. Lines run from left to right in trace, and from
    right to left in retrace. The tip spends the same time on every pixel, so it moves more slowly over small
    pixels. The feedback lags by a fixed time. If the pixels are smaller, the tip moves a shorter distance
    during this time.

    Args:
        surface_um: true heights at the pixels of the scan, in µm.
        frame: position and pitch of the scan.
        noise: standard deviations of the default noise.
        knobs: the effects that are added to plain printing and scanning.
        job: the field that is scanned, the direction of the lines, and the tip.
        rng: random generator for the default noise of this scan.
    """
    height, scan_index = surface_um, job.index
    if strength := (job.tip == 1) * knobs["tip-dilation"]:
        height = _dilate_by_tip(height, frame.pitch_um, (strength, strength))
    if strength := (job.tip == 1) * knobs["asymmetric-tip"]:
        tip_rng = knobs.machine_rng("asymmetric-tip")
        radii_um = tip_rng.permutation([strength, strength / tip_rng.uniform(3, 6)])
        height = _dilate_by_tip(height, frame.pitch_um, (radii_um[0], radii_um[1]))
    if strength := knobs["feedback-lag"]:
        onwards = slice(None, None, int(job.direction))
        lag_um = strength * job.pixel_size
        height = _follow_surface(height[:, onwards], frame.pitch_um, lag_um)[:, onwards]
    if strength := knobs["z-gain"]:
        height = height * (1 + strength * knobs.scan_rng("z-gain", scan_index).standard_normal())
    height = height + 1e-3 * _additive_nm(frame, noise, knobs, scan_index, rng)
    if strength := knobs["resampling-blur"]:
        blur_px = strength / frame.layout_pitch_um
        height = scipy.ndimage.gaussian_filter(height, blur_px, mode="nearest", truncate=5.0)
    if strength := knobs["scars-and-spikes"]:
        height = _scar(height, strength, knobs.scan_rng("scars-and-spikes", scan_index))
    if strength := knobs["min-to-zero-datum"]:
        height = height - strength * height.min()
    if strength := knobs["quantisation"]:
        step_um = 1e-3 * strength
        height = np.floor(height / step_um) * step_um
    return height


def _dilate_by_tip(height: Array, pitch_um: float, radii_um: YX) -> Array:
    """Return the heights at which a tip shaped like a paraboloid touches the surface h. Along each axis, they
    are the maximum of ``h(x − u) − u²/2R`` over all distances u from the axis of the tip. ``radii_um``
    contains the radii R along y and x.

    The tip may touch the surface between two pixels.
    """
    # A paraboloid is a sum of two parabolas, so the maximum can be computed along one axis after the other.
    columns_done = _dilate_columns(height, pitch_um, radii_um[0])
    return _dilate_columns(columns_done.T, pitch_um, radii_um[1]).T


def _dilate_columns(height: Array, pitch_um: float, radius_um: float) -> Array:
    from scipy.interpolate import CubicSpline

    fine_um = pitch_um / _TIP_OVERSAMPLING
    # The tip touches the surface where the tip's slope u/R equals the slope of the surface. The steepest
    # slope therefore limits the distance u that must be searched.
    steepest = np.abs(np.diff(height, axis=0)).max() / pitch_um
    reach = int(np.ceil(1.5 * radius_um * steepest / fine_um)) + 1
    rows = height.shape[0]
    at = np.arange(-reach, (rows - 1) * _TIP_OVERSAMPLING + reach + 1) / _TIP_OVERSAMPLING
    fine = CubicSpline(np.arange(rows), height, axis=0)(np.clip(at, 0, rows - 1))
    highest = np.full_like(height, -np.inf)
    for offset in range(-reach, reach + 1):
        start = reach + offset
        touched = fine[start : start + (rows - 1) * _TIP_OVERSAMPLING + 1 : _TIP_OVERSAMPLING]
        np.maximum(highest, touched - (offset * fine_um) ** 2 / (2 * radius_um), out=highest)
    return highest


def _follow_surface(height: Array, pitch_um: float, lag_um: float) -> Array:
    """Return the heights that a first-order feedback reports along the scan lines. The feedback follows
    falling edges more slowly than rising edges.
    """
    falling, rising = (1 - np.exp(-pitch_um / length) for length in (lag_um, lag_um / 3))
    followed = np.empty_like(height)
    at = height[:, 0].copy()
    followed[:, 0] = at
    for column in range(1, height.shape[1]):
        error = height[:, column] - at
        at = at + np.where(error < 0, falling, rising) * error
        followed[:, column] = at
    return followed


def _additive_nm(
    frame: ScanFrame, noise: Noise, knobs: KnobBoard, scan_index: int, rng: np.random.Generator
) -> Array:
    """Return the sum, in nm, of all height errors of the microscope that do not depend on the surface."""
    y, x = frame.unit_axes
    lines = noise.line_nm * rng.standard_normal((frame.shape[0], 1))
    pixels = noise.pixel_nm * rng.standard_normal(frame.shape)
    total = lines + pixels + noise.datum_nm * rng.standard_normal()
    if strength := knobs["datum-offset"]:
        total = total + strength * knobs.scan_rng("datum-offset", scan_index).standard_normal()
    if strength := knobs["tilt-bow"]:
        shapes = (x, y, x**2 - 1 / 3, x * y, y**2 - 1 / 3)
        weights = knobs.scan_rng("tilt-bow", scan_index).standard_normal(len(shapes))
        surface = sum(
            weight * shape / np.sqrt(np.mean(shape**2)) for weight, shape in zip(weights, shapes, strict=True)
        )
        total = total + strength * surface / len(shapes) ** 0.5
    if strength := knobs["slow-drift"]:
        creep = np.exp(-(y + 1) / 2 / _DRIFT_DECAY_ROWS)
        total = (
            total
            + strength * knobs.scan_rng("slow-drift", scan_index).standard_normal() * creep / creep.std()
        )
    if strength := knobs["scan-line-stripes"]:
        stripes = knobs.scan_rng("scan-line-stripes", scan_index).standard_normal((frame.shape[0], 1))
        total = total + strength * stripes
    return total


def _scar(height: Array, scars_per_row: float, rng: np.random.Generator) -> Array:
    """Return a copy of the heights, to which scars along the fast axis and spikes of a single pixel have been
    added. Each scar and each spike has a random sign.
    """
    scarred = height.copy()
    ny, nx = height.shape
    for _ in range(rng.poisson(scars_per_row * ny)):
        row, start, length = rng.integers(ny), rng.integers(nx), rng.integers(16, 61)
        scarred[row, start : start + length] += rng.choice([-1, 1]) * rng.uniform(0.05, 0.3)
    for _ in range(rng.poisson(scars_per_row * ny / 3)):
        scarred[rng.integers(ny), rng.integers(nx)] += rng.choice([-1, 1]) * rng.uniform(0.05, 0.3)
    return scarred
