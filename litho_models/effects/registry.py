"""The catalogue of all effects by name, in the order in which they act: exposure, resist, development and
measurement.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from litho_data.foundation.errors import InputError, require_known
from litho_models.effects import exposure_spot, exposure_writing, films, measurement, resist
from litho_models.effects.effect import Effect, Parameter, of_single_scans
from litho_models.effects.laws import LAWS, TABLES
from litho_models.scan_terms.term import SCAN_TERMS

_STEP = "scan a step standard and a bare substrate before and after the print"


def _of_single_scans(name: str, title: str, separating: str, **facts: Any) -> Effect:
    """Make a per-scan effect. Its parameters are the coefficients of its scan terms. They are fitted to each
    scan without bounds, so only their names and units are used.
    """
    parameters = {
        label: Parameter("1" if term.unit == "1" else "µm", -0.5, 0.5, 0.03)
        for term in SCAN_TERMS.values()
        if term.effect == name
        for label in term.labels
    }
    usual = {"stage": "measurement", "role": "measurement", "acts_on": "height", "apply": of_single_scans}
    return Effect(name, title, parameters=parameters, separating=separating, **{**usual, **facts})


_PER_SCAN = (
    # Noise along the hatching (arXiv:2309.17343), which is too random for any model to predict.
    _of_single_scans(
        "line-roughness",
        "height of each written line",
        "scan the same field at 0 and 90 degrees",
        stage="exposure",
        role="nuisance",
    ),
    # The registration maps a scan onto its layout with affine and quadratic errors.
    _of_single_scans(
        "registration-residual",
        "shift and distortion left by the registration",
        "alignment marks in every field",
    ),
    # The z-scanner is calibrated only roughly.
    _of_single_scans(
        "z-gain",
        "height calibration of each scan",
        _STEP,
    ),
    # A scan without a reference surface has no known zero.
    _of_single_scans(
        "datum-offset",
        "zero height of each scan",
        "leave bare substrate in every field",
    ),
    # The sample is tilted, the scanner bends its scans, and polynomial levelling leaves errors.
    _of_single_scans(
        "tilt-bow",
        "tilt and bow of each scan",
        _STEP,
    ),
    # The height drifts from one line of a raster scan to the next, and the feedback adds noise.
    _of_single_scans(
        "scan-line-stripes",
        "height offset of every scan line",
        "scan the same field at 0 and 90 degrees",
    ),
    # The scanner creeps exponentially. The slow part of the creep looks like a bow.
    _of_single_scans(
        "slow-drift",
        "creep after the scan starts",
        "scan the same field twice in a row, downwards and upwards",
    ),
)


# Known effects that cannot be seen in a residual map on the grid of the layout, each with the reason.
UNTESTABLE = {
    "min-to-zero-datum": "it shifts each scan by the lowest height of the scan; datum-offset covers it",
    "quantisation": "the raw files are not in the store",
    "scars-and-spikes": "they are masked, not modelled; the loop looks for them among the outliers",
}

# The order in which effects act. The per-scan effects are listed first, but their place has no meaning,
# because they are never part of a model.
_FORWARD_ORDER = (
    *_PER_SCAN,
    exposure_spot.layer_stacking,
    exposure_writing.line_shortening,
    exposure_spot.dose_exponent,
    exposure_spot.elliptical_psf,
    exposure_spot.defocus,
    exposure_writing.galvo_lag,
    exposure_writing.galvo_nonlinearity,
    exposure_writing.vignetting,
    exposure_writing.laser_drift,
    exposure_spot.long_range_proximity,
    films.electron_backscatter,
    exposure_writing.write_order_memory,
    resist.threshold_softness,
    resist.diffusion_blur,
    resist.height_saturation,
    films.resist_diffusion,
    exposure_writing.interface_offset,
    exposure_writing.field_curvature,
    exposure_writing.hatch_ripple,
    resist.vertical_shrinkage,
    resist.dose_dependent_shrinkage,
    resist.lateral_shrinkage,
    resist.feature_collapse,
    resist.trench_residue,
    resist.slope_thinning,
    films.etch_bias,
    measurement.tip_dilation,
    measurement.feedback_lag,
    measurement.piezo_nonlinearity,
    measurement.resampling_blur,
)

TIP = measurement.tip_dilation.name

CATALOGUE = {effect.name: effect for effect in _FORWARD_ORDER}
# Laws and tables. Laws and tables are not in the catalogue, because their causes are not known.
_NAMELESS = {**LAWS, **films.FILM_LAWS, **TABLES}


def register_effect(effect: Effect, *, after: str | None = None) -> Effect:
    """Add an effect to the catalogue and return it. From then on, the closed loop also tests this effect.

    Args:
        effect: the new effect. A per-scan effect (one whose ``apply`` is ``of_single_scans``) also needs a
            scan term; see ``litho_models.scan_terms.register_scan_term``.
        after: name of the effect directly after which the new effect acts. By default, the new effect acts
            last in its stage.

    Raises:
        InputError: the name is already taken, or there is no effect named ``after``.
    """
    if effect.name in {**CATALOGUE, **_NAMELESS}:
        raise InputError("effect", got=f"{effect.name}, which exists", wanted="a new name")
    alike = [name for name, other in CATALOGUE.items() if other.stage == effect.stage]
    behind = get_effect(after).name if after else alike[-1]
    entries = list(CATALOGUE.items())
    entries.insert(list(CATALOGUE).index(behind) + 1, (effect.name, effect))
    CATALOGUE.clear()
    CATALOGUE.update(entries)
    return effect


def get_effect(name: str) -> Effect:
    """Return the effect, law or table with this name.

    Raises:
        InputError: there is no effect, law or table with this name.
    """
    if name in _NAMELESS:
        return _NAMELESS[name]
    require_known("effect", name, CATALOGUE)
    return CATALOGUE[name]


def in_forward_order(names: Iterable[str]) -> list[str]:
    """Sort names of effects in the order in which the effects act, from the exposure to the measurement.

    Raises:
        InputError: there is no effect with one of these names.
    """
    known, nameless = [*CATALOGUE], [*_NAMELESS]
    # Laws and tables act after all other effects of their stage.
    last = {effect.stage: at for at, effect in enumerate(CATALOGUE.values())}

    def place(name: str) -> tuple[int, int]:
        stage = get_effect(name).stage
        return (known.index(name), -1) if name in CATALOGUE else (last[stage], nameless.index(name))

    return sorted(set(names), key=place)


def screened_effects(tip_radius_um: float | None = None) -> list[Effect]:
    """Return the effects that screening (the fast test of all effects) tests: all effects of the catalogue
    except the per-scan effects.

    Args:
        tip_radius_um: radius of the tip of the microscope, or an upper bound for this radius; None if the
            store states neither. If it is given, screening also tries this radius.
    """
    effects = {name: effect for name, effect in CATALOGUE.items() if not effect.per_scan}
    if tip_radius_um is not None:
        tip = effects[TIP]
        radius_um = min(tip_radius_um, tip.parameters["radius_um"].upper)
        known = [trial["radius_um"] for trial in tip.trials]
        # A second trial with nearly the same radius would give no further information.
        if all(abs(radius_um - one) >= 0.2 * one for one in known):
            effects[TIP] = replace(tip, trials=(*tip.trials, {"radius_um": radius_um}))
    return [*effects.values()]
