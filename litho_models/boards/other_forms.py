"""Causes whose functional form is not in the loop's catalogue of effects, and printers that the Physics model
cannot represent.

The forms differ from the effects in the catalogue in their law, axis, range or scale. Neither this module nor
``draws`` reads the catalogue. The seed of a trial determines the random values of its forms, such as a
direction, a distance or a position.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.ndimage
import scipy.signal
import scipy.special

from litho_data.foundation.kinds import Array
from litho_data.virtual_fab import Cause, Job, Printer
from litho_data.virtual_fab.canvas import Canvas, apply_transfer, blur, frequencies_per_um
from litho_data.virtual_fab.geometry import ScanFrame

Rng = np.random.Generator
Stage = Literal["dose", "surface", "scan"]
Deck = Literal["both", "mixtures", "base"]
# A function with the arguments (field, strength, canvas or frame of the scan, job). It returns the field with
# the effect added.
Law = Callable[..., Array]
Draw = Callable[[Rng], Law]

# Spot size of the virtual fab: standard deviation of the squared intensity, µm.
_SPOT_UM = 0.2
_MOST_SCANS = 256


@dataclass(frozen=True)
class Form:
    """One functional form of a cause. Its function ``draw`` draws the random values of the form and returns a
    ``Law``, i.e. a function that applies the form.

    Attributes:
        limit: largest allowed strength, in ``unit``. At strength 0 the form has no effect.
        meaning: text that says what the strength is and which values are drawn.
        deck: which boards draw this form as a cause. A form with the value ``base`` is never drawn as a
            cause; it changes the printer itself in some trials of the board ``mixtures``.
        names: names in the loop's catalogue that count as a right answer. For most forms there is no such
            name.
    """

    name: str
    stage: Stage
    unit: str
    limit: float
    meaning: str
    draw: Draw
    deck: Deck
    names: tuple[str, ...]


FORMS: dict[str, Form] = {}


class FormCause(Cause):
    """Several forms with their strengths, as one cause of the virtual fab. The fab applies the forms of each
    stage (dose, surface, scan) one after the other.
    """

    def __init__(self, strengths: Mapping[str, float], seed: int):
        self._laws = [
            (FORMS[name].stage, strength, FORMS[name].draw(np.random.default_rng([seed, _number(name)])))
            for name, strength in strengths.items()
            if strength
        ]

    def on_dose(self, dose: Array, canvas: Canvas, job: Job) -> Array:
        return np.maximum(self._at("dose", dose, canvas, job), 0.0)

    def on_surface(self, surface_um: Array, canvas: Canvas, job: Job) -> Array:
        return self._at("surface", surface_um, canvas, job)

    def on_scan(self, height_um: Array, frame: ScanFrame, job: Job) -> Array:
        return self._at("scan", height_um, frame, job)

    def _at(self, stage: Stage, field: Array, place: Canvas | ScanFrame, job: Job) -> Array:
        for own, strength, law in self._laws:
            if own == stage:
                field = law(field, strength, place, job)
        return field


def _number(name: str) -> int:
    return zlib.crc32(name.encode())


def _form(
    name: str, stage: Stage, unit: str, limit: float, deck: Deck = "both", names: tuple[str, ...] = ()
) -> Callable[[Draw], Draw]:
    """Return a decorator that registers a drawing function as a form. The docstring of the function becomes
    the form's ``meaning``.
    """

    def enter(draw: Draw) -> Draw:
        meaning = " ".join((draw.__doc__ or "").split())
        FORMS[name] = Form(name, stage, unit, limit, meaning, draw, deck, names)
        return draw

    return enter


# Exposure: other ranges and axes


@_form("far-copy", "dose", "1", 0.6)
def _far_copy(rng: Rng) -> Law:
    """Dose of a copy of the exposure, relative to the exposure itself; the copy is displaced by 6–15 µm in a
    random direction.
    """
    distance_um, direction = rng.uniform(6, 15), rng.uniform(0, 2 * np.pi)

    def law(dose: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        shift = distance_um / canvas.pitch_um * np.array([np.sin(direction), np.cos(direction)])
        # The copy may reach beyond the frame, where the outermost levels are repeated.
        rows, columns = (
            np.clip(np.arange(n) - round(s), 0, n - 1) for n, s in zip(dose.shape, shift, strict=True)
        )
        return dose + strength * dose[np.ix_(rows, columns)]

    return law


@_form("oriented-ringing", "dose", "1", 2.0)
def _oriented_ringing(rng: Rng) -> Law:
    """Relative increase of the dose at one period (2–5 µm) along one direction; the ringing fades over
    2–5 µm.
    """
    period_um, decay_um, direction = rng.uniform(2, 5), rng.uniform(2, 5), rng.uniform(0, np.pi)

    def law(dose: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        along = _frequency_along(canvas, direction)

        def peak(at: Array | float) -> Array:
            return 1 / (1 + (2 * np.pi * decay_um * np.asarray(at)) ** 2)

        ringing = peak(along - 1 / period_um) + peak(along + 1 / period_um) - 2 * peak(1 / period_um)
        return apply_transfer(dose, 1 + strength * ringing)

    return law


@_form("oriented-proximity", "dose", "1", 1.0)
def _oriented_proximity(rng: Rng) -> Law:
    """Dose that is spread over 4–8 µm along one direction, relative to the focused dose."""
    reach_um, direction = rng.uniform(4, 8), rng.uniform(0, np.pi)
    return lambda dose, strength, canvas, job: _spread(
        dose, strength, np.exp(-2 * (np.pi * reach_um * _frequency_along(canvas, direction)) ** 2)
    )


@_form("halo-ring", "dose", "1", 1.0)
def _halo_ring(rng: Rng) -> Law:
    """Dose on a ring of 4–9 µm radius, relative to the focused dose."""
    radius_um = rng.uniform(4, 9)

    def law(dose: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        frequency = np.hypot(*frequencies_per_um(dose.shape, canvas.pitch_um))
        return _spread(dose, strength, scipy.special.j0(2 * np.pi * radius_um * frequency))

    return law


@_form("fast-axis-memory", "dose", "1", 0.6)
def _fast_axis_memory(rng: Rng) -> Law:
    """Share of the dose that is lost because of earlier writing in the same hatch line; the loss fades over
    3–8 µm.
    """
    decay_um = rng.uniform(3, 8)

    def law(dose: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        keeps = np.exp(-canvas.pitch_um / decay_um)
        return dose - strength * scipy.signal.lfilter([0.0, 1 - keeps], [1.0, -keeps], dose, axis=1)

    return law


@_form("crowding", "dose", "1", 4.0)
def _crowding(rng: Rng) -> Law:
    """Relative increase of the dose, divided by the cube of the mean dose within 2.5–5 µm."""
    reach_um = rng.uniform(2.5, 5)
    return lambda dose, strength, canvas, job: (
        dose * (1 + strength * blur(dose, canvas.pitch_um, reach_um) ** 3)
    )


@_form("alternate-slices", "dose", "1", 2.0)
def _alternate_slices(rng: Rng) -> Law:
    """Number of slices that are surplus or missing in every second level; the sign is random."""
    odd, sign = rng.integers(2), rng.choice([-1, 1])

    def law(dose: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        wrong = (canvas.level % 2 == odd) & (canvas.level > 0)
        return dose + sign * strength / 12 * blur(wrong.astype(float), canvas.pitch_um, _SPOT_UM)

    return law


@_form("focus-step", "dose", "µm", 2.0, names=("defocus",))
def _focus_step(rng: Rng) -> Law:
    """Blur (standard deviation) added to the spot in prints after a random point near the middle of the
    printing order.
    """
    first = rng.uniform(-0.25, 0.25)
    return lambda dose, strength, canvas, job: (
        blur(dose, canvas.pitch_um, strength) if job.order > first else dose
    )


# Resist and development: other laws


@_form("cubic-slope-loss", "surface", "µm", 8.0, names=("slope-thinning",))
def _cubic_slope_loss(rng: Rng) -> Law:
    """Height lost per cubed slope in any direction."""
    return lambda surface, strength, canvas, job: (
        surface - strength * np.hypot(*np.gradient(surface, canvas.pitch_um)) ** 3
    )


@_form("diagonal-slope-loss", "surface", "µm", 4.0, names=("slope-thinning",))
def _diagonal_slope_loss(rng: Rng) -> Law:
    """Height lost per squared slope along one direction, 30–60° from the axes."""
    direction = rng.uniform(np.pi / 6, np.pi / 3) + rng.integers(2) * np.pi / 2
    return lambda surface, strength, canvas, job: (
        surface - strength * _slope_along(surface, canvas, direction) ** 2
    )


@_form("lee-side-loss", "surface", "µm", 2.0, names=("slope-thinning", "line-shortening"))
def _lee_side_loss(rng: Rng) -> Law:
    """Height lost per slope, only on flanks that fall along one direction."""
    # This loss is the sum of a loss of half the strength on all flanks, rising and falling, and a
    # displacement of the print. Registration removes the displacement.
    direction = rng.uniform(0, 2 * np.pi)
    return lambda surface, strength, canvas, job: (
        surface + strength * np.minimum(_slope_along(surface, canvas, direction), 0.0)
    )


@_form("plateau", "surface", "1", 1.0)
def _plateau(rng: Rng) -> Law:
    """Share of the height that is lost between two limits, 0.15–0.25 µm apart; 1 makes a plateau."""
    lower_um, width_um = rng.uniform(0.3, 0.5), rng.uniform(0.15, 0.25)
    return lambda surface, strength, canvas, job: (
        surface - strength * np.clip(surface - lower_um, 0.0, width_um)
    )


@_form("fringes", "surface", "nm", 150.0)
def _fringes(rng: Rng) -> Law:
    """Amplitude of an error that is periodic in the height, with a period of 0.12–0.3 µm."""
    period_um, phase = rng.uniform(0.12, 0.3), rng.uniform(0, 2 * np.pi)
    return lambda surface, strength, canvas, job: (
        surface + 1e-3 * strength * np.sin(2 * np.pi * surface / period_um + phase)
    )


@_form("overshoot", "surface", "1", 2.0)
def _overshoot(rng: Rng) -> Law:
    """Relative increase of detail finer than 0.6–1.2 µm, so that edges overshoot."""
    reach_um = rng.uniform(0.6, 1.2)
    return lambda surface, strength, canvas, job: (
        surface + strength * (surface - blur(surface, canvas.pitch_um, reach_um))
    )


@_form("blur-with-height", "surface", "1/µm", 2.0)
def _blur_with_height(rng: Rng) -> Law:
    """Share of the surface, per µm of height, that is replaced by a copy blurred over 0.5–1 µm."""
    reach_um = rng.uniform(0.5, 1)

    def law(surface: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        blurred = blur(surface, canvas.pitch_um, reach_um)
        return surface + np.clip(strength * blurred, 0.0, 1.0) * (blurred - surface)

    return law


# Position: jumps and gradients over the field


@_form("blur-across-field", "surface", "1", 1.0)
def _blur_across_field(rng: Rng) -> Law:
    """Share of the surface that is replaced by a copy blurred over 0.7–1.2 µm, at one side of the field. The
    share falls to 0 at the opposite side.
    """
    reach_um, side = rng.uniform(0.7, 1.2), int(rng.integers(4))

    def law(surface: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        across = _across(canvas, axis=side // 2)
        weight = np.clip(across if side % 2 else 1 - across, 0.0, 1.0)
        return surface + strength * weight * (blur(surface, canvas.pitch_um, reach_um) - surface)

    return law


@_form("seam-in-gain", "surface", "1", 0.6)
def _seam_in_gain(rng: Rng) -> Law:
    """Share of the height lost on one side of a seam through the field."""
    seam = _seam(rng)
    return lambda surface, strength, canvas, job: surface * (1 - strength * _beyond(canvas, *seam))


@_form("seam-in-height", "surface", "nm", 300.0)
def _seam_in_height(rng: Rng) -> Law:
    """Step of the height at a seam through the field."""
    seam = _seam(rng)
    return lambda surface, strength, canvas, job: surface + 1e-3 * strength * _beyond(canvas, *seam)


@_form("seam-in-place", "surface", "µm", 1.5)
def _seam_in_place(rng: Rng) -> Law:
    """Displacement of one side of a seam along the seam."""
    side, place = _seam(rng)

    def law(surface: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        shift = np.zeros(2)
        shift[1 - side // 2] = strength / canvas.pitch_um
        moved = scipy.ndimage.shift(surface, shift, order=3, mode="nearest")
        return np.where(_beyond(canvas, side, place), moved, surface)

    return law


@_form("rim", "surface", "1", 1.0)
def _rim(rng: Rng) -> Law:
    """Relative increase of the height at the edge of the layout; it fades over 1.5–3 µm."""
    reach_um = rng.uniform(1.5, 3)

    def law(surface: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        (size_y, size_x), y, x = canvas.size_um, canvas.y_um, canvas.x_um
        inwards = np.minimum(np.minimum(y, size_y - y), np.minimum(x, size_x - x))
        return surface * (1 + strength * np.exp(-np.maximum(inwards, 0.0) / reach_um))

    return law


# Microscope


@_form("periodic-lines", "scan", "nm", 150.0)
def _periodic_lines(rng: Rng) -> Law:
    """Amplitude of line offsets that repeat every 6–20 lines; each scan has its own phase."""
    period, phases = rng.uniform(6, 20), rng.uniform(0, 2 * np.pi, _MOST_SCANS)

    def law(height: Array, strength: float, frame: ScanFrame, job: Job) -> Array:
        line = np.arange(frame.shape[0])[:, None]
        return height + 1e-3 * strength * np.sin(2 * np.pi * line / period + phases[job.index % _MOST_SCANS])

    return law


# Effects found in the measured prints; every mixtures board contains them


@_form("linear-slope-loss", "surface", "µm", 1.0, "mixtures", ("slope-thinning", "line-shortening"))
def _linear_slope_loss(rng: Rng) -> Law:
    """Height lost per absolute slope along the hatch lines."""
    return lambda surface, strength, canvas, job: (
        surface - strength * np.abs(_slope_along(surface, canvas, direction=0.0))
    )


@_form("s-shaped-axis", "scan", "µm", 1.5, "mixtures", ("piezo-nonlinearity",))
def _s_shaped_axis(rng: Rng) -> Law:
    """Amplitude of a displacement along x that is quadratic and cubic in x, in random proportion."""
    share = rng.uniform(np.pi / 6, np.pi / 3)

    def law(height: Array, strength: float, frame: ScanFrame, job: Job) -> Array:
        x = frame.unit_axes[1]
        moved_um = np.cos(share) * (1.5 * x**2 - 0.5) + np.sin(share) * (2.5 * x**3 - 1.5 * x)
        rows, columns = np.indices(height.shape, dtype=float)
        at = [rows, columns + strength / frame.pitch_um * moved_um]
        return scipy.ndimage.map_coordinates(height, at, order=3, mode="nearest")

    return law


# Printers that the Physics model cannot imitate


@_form("two-part-spot", "dose", "1", 0.5, "base", ("long-range-proximity",))
def _two_part_spot(rng: Rng) -> Law:
    """Share of the dose in a second part of the spot, blurred with standard deviation 0.5–0.9 µm."""
    width_um = rng.uniform(0.5, 0.9)
    return lambda dose, strength, canvas, job: (
        (1 - strength) * dose + strength * blur(dose, canvas.pitch_um, width_um)
    )


@_form(
    "hill-response", "dose", "1", 1.0, "base", ("dose-exponent", "threshold-softness", "height-saturation")
)
def _hill_response(rng: Rng) -> Law:
    """Weight of a Hill curve (exponent 1.5–2.5, half of its maximum at a dose of 0.4–0.7) in the response;
    the rest is the logistic curve.
    """
    exponent, half = rng.uniform(1.5, 2.5), rng.uniform(0.4, 0.7)

    def law(dose: Array, strength: float, canvas: Canvas, job: Job) -> Array:
        # Compute the dose at which the logistic curve of the default printer gives the same conversion as the
        # Hill curve gives at ``dose``.
        threshold, steepness = Printer().threshold_dose, Printer().threshold_steepness
        low, high = (scipy.special.expit(steepness * (at - threshold)) for at in (0.0, 1.0))
        hill = dose**exponent * (1 + half**exponent) / (dose**exponent + half**exponent)
        # The Hill curve may exceed full conversion when several doses are added. The logistic curve never
        # reaches full conversion, so its inverse needs a limit.
        response = np.minimum(low + (high - low) * hill, 0.99)
        return (1 - strength) * dose + strength * (threshold + scipy.special.logit(response) / steepness)

    return law


@_form("elliptical-blur", "dose", "µm", 0.6, "base", ("elliptical-psf",))
def _elliptical_blur(rng: Rng) -> Law:
    """Blur (standard deviation) added to the spot along one direction."""
    direction = rng.uniform(0, np.pi)
    return lambda dose, strength, canvas, job: apply_transfer(
        dose, np.exp(-2 * (np.pi * strength * _frequency_along(canvas, direction)) ** 2)
    )


def _spread(dose: Array, strength: float, transfer: Array) -> Array:
    """Return a weighted mean of two doses. The dose itself has weight 1. The dose after filtering with a
    transfer function, which is 1 at zero frequency, has weight ``strength``.
    """
    return apply_transfer(dose, (1 + strength * transfer) / (1 + strength))


def _frequency_along(canvas: Canvas, direction: float) -> Array:
    frequency_y, frequency_x = frequencies_per_um(canvas.level.shape, canvas.pitch_um)
    return frequency_x * np.cos(direction) + frequency_y * np.sin(direction)


def _slope_along(surface: Array, canvas: Canvas, direction: float) -> Array:
    slope_y, slope_x = np.gradient(surface, canvas.pitch_um)
    return slope_x * np.cos(direction) + slope_y * np.sin(direction)


def _across(canvas: Canvas, axis: int) -> Array:
    """Return the position of each pixel along one axis (0: y, 1: x), from 0 at the first edge of the layout
    to 1 at the last.
    """
    at_um = (canvas.y_um, canvas.x_um)[axis]
    return np.broadcast_to(at_um / canvas.size_um[axis], canvas.level.shape)


def _seam(rng: Rng) -> tuple[int, float]:
    """Draw the arguments ``side`` and ``place`` of ``_beyond``, which define a seam through the field."""
    return int(rng.integers(4)), rng.uniform(0.35, 0.65)


def _beyond(canvas: Canvas, side: int, place: float) -> Array:
    """Return a mask that is True on one side of a seam.

    The number ``side`` encodes the axis across the seam (0 and 1: y; 2 and 3: x) and the masked side (even:
    before the seam; odd: after it).
    """
    across = _across(canvas, axis=side // 2)
    return across > place if side % 2 else across < place
