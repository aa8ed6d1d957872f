"""All effects by name, in the order in which light, resist, developer and microscope act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

from litho_data.foundation.errors import InputError, require_known
from litho_models.effects import (
    development,
    exposure_field,
    exposure_scanning,
    exposure_spot,
    measurement_height,
    measurement_lateral,
    measurement_tip,
    resist,
)
from litho_models.effects.effect import Effect, Stage
from litho_models.effects.laws import LAWS, TABLES

_FORWARD_ORDER = (
    "layer-stacking",
    "line-shortening",
    "dose-exponent",
    "elliptical-psf",
    "galvo-lag",
    "galvo-nonlinearity",
    "vignetting",
    "laser-drift",
    "long-range-proximity",
    "write-order-memory",
    "threshold-softness",
    "diffusion-blur",
    "height-saturation",
    "interface-offset",
    "field-curvature",
    "hatch-ripple",
    "vertical-shrinkage",
    "dose-dependent-shrinkage",
    "lateral-shrinkage",
    "feature-collapse",
    "trench-residue",
    "slope-thinning",
    "line-roughness",
    "tip-dilation",
    "feedback-lag",
    "registration-residual",
    "piezo-nonlinearity",
    "resampling-blur",
    "z-gain",
    "datum-offset",
    "tilt-bow",
    "scan-line-stripes",
    "slow-drift",
)

_FAMILIES = (
    exposure_spot,
    exposure_scanning,
    exposure_field,
    resist,
    development,
    measurement_height,
    measurement_lateral,
    measurement_tip,
)

# Named in the catalogue, but a residual map on the layout's grid cannot carry their signature.
UNTESTABLE = {
    "min-to-zero-datum": "an order statistic per scan; what it leaves is carried by datum-offset",
    "quantisation": "the raw files are not in the store",
    "scars-and-spikes": "a mask, not a term: looked for among the outliers",
}

TIP = "tip-dilation"

CATALOGUE: dict[str, Effect] = {}


def register_effect(effect: Effect, *, after: str | None = None) -> Effect:
    """Add an effect to the catalogue; returns it. From then on it is a candidate of the loop.

    Args:
        effect: the effect; one of single scans (``per_scan``) needs a scan term as well, see
            ``litho_models.scan_terms.register_scan_term``.
        after: the effect behind which it acts; by default it is the last one of its stage.

    Raises:
        InputError: a name that is taken, or no effect called ``after``.
    """
    if effect.name in {**CATALOGUE, **LAWS, **TABLES}:
        raise InputError("effect", got=f"{effect.name}, which exists", wanted="a new name")
    alike = [name for name, other in CATALOGUE.items() if other.stage == effect.stage]
    behind = get_effect(after).name if after else alike[-1]
    entries = list(CATALOGUE.items())
    entries.insert(list(CATALOGUE).index(behind) + 1, (effect.name, effect))
    CATALOGUE.clear()
    CATALOGUE.update(entries)
    return effect


def get_effect(name: str) -> Effect:
    """The effect of that name.

    Raises:
        InputError: no such effect.
    """
    if (nameless := LAWS.get(name) or TABLES.get(name)) is not None:
        return nameless
    require_known("effect", name, CATALOGUE)
    return CATALOGUE[name]


def in_forward_order(names: Sequence[str]) -> list[str]:
    """The names sorted as the effects act, from exposure to microscope.

    Raises:
        InputError: a name that is no effect's.
    """
    given = {get_effect(name).name for name in names}
    stages = list(get_args(Stage))
    # What has no name acts on the finished print, before the microscope sees it.
    print_ends = max(i for i, one in enumerate(CATALOGUE.values()) if one.stage != stages[-1])
    known = list(CATALOGUE)
    nameless = [name for name in (*LAWS, *TABLES) if name in given]
    ordered = [*known[: print_ends + 1], *nameless, *known[print_ends + 1 :]]
    return [name for name in ordered if name in given]


def screened_effects(tip_radius_um: float | None = None) -> list[Effect]:
    """Effects with parameters common to all scans, tested by the score test.

    Args:
        tip_radius_um: of the microscope's tip, or the most that it can be, if the store knows it: the tip is
            tried at that size too.
    """
    effects = [effect for effect in CATALOGUE.values() if not effect.per_scan]
    if tip_radius_um is None:
        return effects
    return [_tried_at(effect, tip_radius_um) if effect.name == TIP else effect for effect in effects]


def _tried_at(tip: Effect, radius_um: float) -> Effect:
    limits = tip.parameters["radius_um"]
    radius_um = min(radius_um, limits.upper)
    known = [trial["radius_um"] for trial in tip.trials]
    # A trial of nearly the same size would say the same twice.
    if any(abs(radius_um - one) < 0.2 * one for one in known):
        return tip
    return replace(tip, trials=(*tip.trials, {"radius_um": radius_um}))


def _fill() -> None:
    """The built-in effects in the order in which they act; one without a place in it is last of its stage."""
    found = {effect.name: effect for family in _FAMILIES for effect in family.EFFECTS}
    CATALOGUE.update((name, found.pop(name)) for name in _FORWARD_ORDER)
    for effect in found.values():
        register_effect(effect)


_fill()
