"""Causes of another form than any that the loop has a name for: other laws, axes, reaches, scales.

They are written against the virtual fab alone. Neither this module nor the drawing reads the loop's catalogue
of effects, and none of these causes was used in development. What is drawn for a form (a direction, a
distance, a place) follows from the seed of its trial.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.ndimage
import scipy.signal
import scipy.special

from litho_data.virtual_fab import Cause, Job
from litho_data.virtual_fab.canvas import Canvas, apply_transfer, blur, frequencies_per_um
from litho_data.virtual_fab.geometry import ScanFrame

Stage = Literal["dose", "surface", "scan"]
# (field, strength, canvas or frame of the scan, job) to the changed field.
Law = Callable[..., np.ndarray]
Draw = Callable[[np.random.Generator], Law]

# The spot of the fab: sd of the squared intensity, µm.
_SPOT_UM = 0.2
_MOST_SCANS = 256


@dataclass(frozen=True)
class Form:
    """One form; ``draw`` fixes what is random in it and returns its law.

    Attributes:
        limit: largest strength, in ``unit``; at strength 0 a law changes nothing.
        meaning: what a strength of one unit does, and what is drawn.
    """

    name: str
    stage: Stage
    unit: str
    limit: float
    meaning: str
    draw: Draw


FORMS: dict[str, Form] = {}


class FormCause(Cause):
    """A form at a strength, as the fab applies it."""

    def __init__(self, name: str, strength: float, seed: int):
        self.form = FORMS[name]
        self.strength = strength
        self._law = self.form.draw(np.random.default_rng([seed, zlib.crc32(name.encode())]))

    def on_dose(self, dose: np.ndarray, canvas: Canvas, job: Job) -> np.ndarray:
        return np.maximum(self._at("dose", dose, canvas, job), 0.0)

    def on_surface(self, surface_um: np.ndarray, canvas: Canvas, job: Job) -> np.ndarray:
        return self._at("surface", surface_um, canvas, job)

    def on_scan(self, height_um: np.ndarray, frame: ScanFrame, job: Job) -> np.ndarray:
        return self._at("scan", height_um, frame, job)

    def _at(self, stage: Stage, field: np.ndarray, place: Canvas | ScanFrame, job: Job) -> np.ndarray:
        if stage != self.form.stage or not self.strength:
            return field
        return self._law(field, self.strength, place, job)


def _form(name: str, stage: Stage, unit: str, limit: float) -> Callable[[Draw], Draw]:
    """Enter a drawing function into the list; its docstring says what the form does."""

    def enter(draw: Draw) -> Draw:
        FORMS[name] = Form(name, stage, unit, limit, " ".join((draw.__doc__ or "").split()), draw)
        return draw

    return enter


# Exposure: other reaches and axes


@_form("far-copy", "dose", "1", 0.6)
def _far_copy(rng: np.random.Generator) -> Law:
    """Dose of a displaced copy; 6–15 µm away in a direction that is drawn."""
    distance_um, direction = rng.uniform(6, 15), rng.uniform(0, 2 * np.pi)

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        shift = distance_um / canvas.pitch_um * np.array([np.sin(direction), np.cos(direction)])
        # The copy may lie beyond the frame, where the outermost levels continue.
        rows, columns = (
            np.clip(np.arange(n) - round(s), 0, n - 1) for n, s in zip(dose.shape, shift, strict=True)
        )
        return dose + strength * dose[np.ix_(rows, columns)]

    return law


@_form("oriented-ringing", "dose", "1", 2.0)
def _oriented_ringing(rng: np.random.Generator) -> Law:
    """Relative gain at one period (2–5 µm) along one direction; it rings over 2–5 µm."""
    period_um, decay_um, direction = rng.uniform(2, 5), rng.uniform(2, 5), rng.uniform(0, np.pi)

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        along = _frequency_along(canvas, direction)

        def peak(at: np.ndarray | float) -> np.ndarray:
            return 1 / (1 + (2 * np.pi * decay_um * np.asarray(at)) ** 2)

        ringing = peak(along - 1 / period_um) + peak(along + 1 / period_um) - 2 * peak(1 / period_um)
        return apply_transfer(dose, 1 + strength * ringing)

    return law


@_form("oriented-proximity", "dose", "1", 1.0)
def _oriented_proximity(rng: np.random.Generator) -> Law:
    """Dose spread far along one direction only, 4–8 µm, relative to the focused dose."""
    reach_um, direction = rng.uniform(4, 8), rng.uniform(0, np.pi)

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        along = _frequency_along(canvas, direction)
        return _spread(dose, strength, np.exp(-2 * (np.pi * reach_um * along) ** 2))

    return law


@_form("halo-ring", "dose", "1", 3.0)
def _halo_ring(rng: np.random.Generator) -> Law:
    """Dose thrown onto a ring of 4–9 µm radius, relative to the focused dose."""
    radius_um = rng.uniform(4, 9)

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        frequency_y, frequency_x = frequencies_per_um(dose.shape, canvas.pitch_um)
        frequency = np.hypot(frequency_y, frequency_x)
        return _spread(dose, strength, scipy.special.j0(2 * np.pi * radius_um * frequency))

    return law


@_form("fast-axis-memory", "dose", "1", 0.6)
def _fast_axis_memory(rng: np.random.Generator) -> Law:
    """Share of the dose lost to what the same hatch line wrote before; fades over 3–8 µm."""
    decay_um = rng.uniform(3, 8)

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        keeps = np.exp(-canvas.pitch_um / decay_um)
        return dose - strength * scipy.signal.lfilter([0.0, 1 - keeps], [1.0, -keeps], dose, axis=1)

    return law


@_form("crowding", "dose", "1", 4.0)
def _crowding(rng: np.random.Generator) -> Law:
    """Relative gain of the dose at full density, with its cube; density over 2.5–5 µm."""
    reach_um = rng.uniform(2.5, 5)

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return dose * (1 + strength * blur(dose, canvas.pitch_um, reach_um) ** 3)

    return law


@_form("alternate-slices", "dose", "1", 2.0)
def _alternate_slices(rng: np.random.Generator) -> Law:
    """Slices that every second level gets too many or, by chance, too few."""
    odd, sign = rng.integers(2), rng.choice([-1, 1])

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        wrong = (canvas.level % 2 == odd) & (canvas.level > 0)
        return dose + sign * strength / 12 * blur(wrong.astype(float), canvas.pitch_um, _SPOT_UM)

    return law


@_form("focus-step", "dose", "µm", 2.0)
def _focus_step(rng: np.random.Generator) -> Law:
    """Sd that the spot gains from one print on; the print is drawn in the middle of the order."""
    first = rng.uniform(-0.25, 0.25)

    def law(dose: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return blur(dose, canvas.pitch_um, strength) if job.order > first else dose

    return law


# Resist and development: other laws


@_form("cubic-slope-loss", "surface", "µm", 8.0)
def _cubic_slope_loss(rng: np.random.Generator) -> Law:
    """Height lost per cubed slope, whichever way it faces."""

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return surface - strength * np.hypot(*np.gradient(surface, canvas.pitch_um)) ** 3

    return law


@_form("diagonal-slope-loss", "surface", "µm", 4.0)
def _diagonal_slope_loss(rng: np.random.Generator) -> Law:
    """Height lost per squared slope along a direction at 30–60° to the axes."""
    direction = rng.uniform(np.pi / 6, np.pi / 3) + rng.integers(2) * np.pi / 2

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return surface - strength * _slope_along(surface, canvas, direction) ** 2

    return law


@_form("lee-side-loss", "surface", "µm", 2.0)
def _lee_side_loss(rng: np.random.Generator) -> Law:
    """Height lost per slope on the flanks that fall in one direction; the others keep theirs."""
    direction = rng.uniform(0, 2 * np.pi)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return surface + strength * np.minimum(_slope_along(surface, canvas, direction), 0.0)

    return law


@_form("plateau", "surface", "1", 1.0)
def _plateau(rng: np.random.Generator) -> Law:
    """Share lost of the height between two heights 0.15–0.25 µm apart; 1 makes them one plateau."""
    lower_um, width_um = rng.uniform(0.3, 0.5), rng.uniform(0.15, 0.25)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return surface - strength * np.clip(surface - lower_um, 0.0, width_um)

    return law


@_form("fringes", "surface", "nm", 150.0)
def _fringes(rng: np.random.Generator) -> Law:
    """Amplitude of an error that is periodic in the height, with a period of 0.12–0.3 µm."""
    period_um, phase = rng.uniform(0.12, 0.3), rng.uniform(0, 2 * np.pi)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        wave = np.sin(2 * np.pi * surface / period_um + phase)
        return surface + 1e-3 * strength * wave

    return law


@_form("overshoot", "surface", "1", 2.0)
def _overshoot(rng: np.random.Generator) -> Law:
    """Gain of all that is finer than 0.6–1.2 µm: edges stand out on both sides."""
    reach_um = rng.uniform(0.6, 1.2)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return surface + strength * (surface - blur(surface, canvas.pitch_um, reach_um))

    return law


@_form("blur-with-height", "surface", "1/µm", 2.0)
def _blur_with_height(rng: np.random.Generator) -> Law:
    """Share of a blurred surface (0.5–1 µm) in the print, growing with the height."""
    reach_um = rng.uniform(0.5, 1)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        blurred = blur(surface, canvas.pitch_um, reach_um)
        return surface + np.clip(strength * blurred, 0.0, 1.0) * (blurred - surface)

    return law


# Place: jumps and gradients over the field


@_form("blur-across-field", "surface", "1", 1.0)
def _blur_across_field(rng: np.random.Generator) -> Law:
    """Share of a blurred surface (0.7–1.2 µm) at one side of the field; none at the other side."""
    reach_um, side = rng.uniform(0.7, 1.2), int(rng.integers(4))

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        across = _across(canvas, axis=side // 2)
        weight = np.clip(across if side % 2 else 1 - across, 0.0, 1.0)
        return surface + strength * weight * (blur(surface, canvas.pitch_um, reach_um) - surface)

    return law


@_form("seam-in-gain", "surface", "1", 0.6)
def _seam_in_gain(rng: np.random.Generator) -> Law:
    """Share of the height lost on one side of a seam in the middle of the field."""
    side, place = int(rng.integers(4)), rng.uniform(0.35, 0.65)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return surface * (1 - strength * _beyond(canvas, side, place))

    return law


@_form("seam-in-height", "surface", "nm", 300.0)
def _seam_in_height(rng: np.random.Generator) -> Law:
    """Step of the height at a seam in the middle of the field."""
    side, place = int(rng.integers(4)), rng.uniform(0.35, 0.65)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        return surface + 1e-3 * strength * _beyond(canvas, side, place)

    return law


@_form("seam-in-place", "surface", "µm", 1.5)
def _seam_in_place(rng: np.random.Generator) -> Law:
    """Displacement along the seam of what lies on one side of it."""
    side, place = int(rng.integers(4)), rng.uniform(0.35, 0.65)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        shift = np.zeros(2)
        shift[1 - side // 2] = strength / canvas.pitch_um
        moved = scipy.ndimage.shift(surface, shift, order=3, mode="nearest")
        return np.where(_beyond(canvas, side, place), moved, surface)

    return law


@_form("rim", "surface", "1", 1.0)
def _rim(rng: np.random.Generator) -> Law:
    """Relative gain of the height at the edge of the layout; fades inwards over 1.5–3 µm."""
    reach_um = rng.uniform(1.5, 3)

    def law(surface: np.ndarray, strength: float, canvas: Canvas, job: Job) -> np.ndarray:
        (size_y, size_x), y, x = canvas.size_um, canvas.y_um, canvas.x_um
        inwards = np.minimum(np.minimum(y, size_y - y), np.minimum(x, size_x - x))
        return surface * (1 + strength * np.exp(-np.maximum(inwards, 0.0) / reach_um))

    return law


# Microscope


@_form("periodic-lines", "scan", "nm", 150.0)
def _periodic_lines(rng: np.random.Generator) -> Law:
    """Amplitude of line offsets with a period of 6–20 lines; the phase is new in every scan."""
    period, phases = rng.uniform(6, 20), rng.uniform(0, 2 * np.pi, _MOST_SCANS)

    def law(height: np.ndarray, strength: float, frame: ScanFrame, job: Job) -> np.ndarray:
        line = np.arange(frame.shape[0])[:, None]
        return height + 1e-3 * strength * np.sin(2 * np.pi * line / period + phases[job.index % _MOST_SCANS])

    return law


def _spread(dose: np.ndarray, strength: float, transfer: np.ndarray) -> np.ndarray:
    """The dose beside ``strength`` times itself spread, by a transfer function that is 1 at rest."""
    return apply_transfer(dose, (1 + strength * transfer) / (1 + strength))


def _frequency_along(canvas: Canvas, direction: float) -> np.ndarray:
    frequency_y, frequency_x = frequencies_per_um(canvas.level.shape, canvas.pitch_um)
    return frequency_x * np.cos(direction) + frequency_y * np.sin(direction)


def _slope_along(surface: np.ndarray, canvas: Canvas, direction: float) -> np.ndarray:
    slope_y, slope_x = np.gradient(surface, canvas.pitch_um)
    return slope_x * np.cos(direction) + slope_y * np.sin(direction)


def _across(canvas: Canvas, axis: int) -> np.ndarray:
    """Place over the layout along an axis (0: y, 1: x), 0 at its first edge, 1 at its last."""
    at_um = (canvas.y_um, canvas.x_um)[axis]
    return np.broadcast_to(at_um / canvas.size_um[axis], canvas.level.shape)


def _beyond(canvas: Canvas, side: int, place: float) -> np.ndarray:
    """True on one side of a seam; ``side`` says across which axis, and which of the two."""
    across = _across(canvas, axis=side // 2)
    return across > place if side % 2 else across < place
