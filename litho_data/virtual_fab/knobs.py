"""Every effect beyond plain printing: name, unit, range, and its name in the catalogue of effects."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from litho_data.foundation.errors import InputError, unknown_name

Stage = Literal["exposure", "resist", "development", "measurement"]
Role = Literal["process", "measurement", "nuisance", "undetermined"]

OFF_CATALOGUE = "off-catalogue"


@dataclass(frozen=True)
class Knob:
    """One effect that the fab can add; strength 0 does not change a bit.

    Args:
        name: on the command line and in the truth file.
        effect: identifier in the effects catalogue, or `off-catalogue`.
        stage: the step at which it acts.
        role: whether it is part of the print, the microscope, or chance.
        unit: unit of the strength.
        limit: largest meaningful strength.
        meaning: what a strength of one unit does, and what the seed draws.
        nuisance_span: True if offset, gain, plane and bow of each scan absorb nearly all of it.
        refit_absorbs: True if other parameters of the plain printing model imitate most of it.
    """

    name: str
    effect: str
    stage: Stage
    role: Role
    unit: str
    limit: float
    meaning: str
    nuisance_span: bool = False
    refit_absorbs: bool = False

    @property
    def limit_with_unit(self) -> str:
        """The largest strength as text, bare where the unit is 1."""
        return f"{self.limit:g}" if self.unit == "1" else f"{self.limit:g} {self.unit}"


@dataclass(frozen=True)
class KnobSetting:
    """A knob turned to a strength; without its own seed it uses that of the run."""

    name: str
    strength: float
    seed: int | None = None

    @classmethod
    def parse(cls, text: str) -> KnobSetting:
        """``name=strength`` or ``name=strength@seed``.

        Raises:
            InputError: another form, an unknown name, or a strength outside the knob's range.
        """
        name, equals, value = text.partition("=")
        strength, at, seed = value.partition("@")
        try:
            if not equals:
                raise ValueError("no '='")
            return checked(cls(name.strip(), float(strength), int(seed) if at else None))
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError("knob", got=repr(text), wanted="name=strength or name=strength@seed") from error


def checked(setting: KnobSetting) -> KnobSetting:
    """The setting itself, if its knob exists and its strength is within range."""
    knob = KNOBS.get(setting.name)
    if knob is None:
        raise unknown_name("knob", setting.name, KNOBS, "`litho-data simulate --list-knobs` explains them")
    if not 0 <= setting.strength <= knob.limit:
        raise InputError(
            f"strength of knob {knob.name}", got=setting.strength, wanted=f"0 to {knob.limit_with_unit}"
        )
    if setting.seed is not None and setting.seed < 0:
        raise InputError(f"seed of knob {knob.name}", got=setting.seed, wanted="0 or more")
    return setting


class KnobBoard:
    """The knobs of one run: strengths, and a separate random stream per knob."""

    def __init__(self, settings: Iterable[KnobSetting], run_seed: int):
        self.settings = tuple(checked(setting) for setting in settings)
        self._strength: Mapping[str, float] = {setting.name: setting.strength for setting in self.settings}
        if len(self._strength) != len(self.settings):
            raise InputError("knobs", got=[s.name for s in self.settings], wanted="each name at most once")
        self._seed = {s.name: run_seed if s.seed is None else s.seed for s in self.settings}

    def __getitem__(self, name: str) -> float:
        return self._strength.get(KNOBS[name].name, 0.0)

    def any(self, *names: str) -> bool:
        """Whether one of the knobs is not at zero."""
        return any(self[name] for name in names)

    def machine_rng(self, name: str) -> np.random.Generator:
        """Draws of a knob for the machine: the same for every scan."""
        return self._rng(name, 0)

    def scan_rng(self, name: str, scan_index: int) -> np.random.Generator:
        """Draws of a knob that are new in every scan."""
        return self._rng(name, scan_index + 1)

    def _rng(self, name: str, stream: int) -> np.random.Generator:
        return np.random.default_rng([self._seed[name], zlib.crc32(name.encode()), stream])


_TABLE = (
    Knob("elliptical-psf", "elliptical-psf", "exposure", "process", "µm", 0.6,
         "sd that the two-photon spot gains along one axis, in quadrature; the seed draws the axis"),
    Knob("long-range-proximity", "long-range-proximity", "exposure", "process", "1", 1.0,
         "dose spread far around, relative to the focused dose; the seed draws the reach, 2–5 µm"),
    Knob("dose-exponent", "dose-exponent", "exposure", "process", "1", 1.0,
         "excess of the exponent: the dose is raised to the power 1 + strength", refit_absorbs=True),
    Knob("write-order-memory", "write-order-memory", "resist", "process", "1", 0.5,
         "share of the dose lost to radicals left by earlier lines; the seed draws the decay, 1–4 µm"),
    Knob("galvo-lag", "galvo-lag", "exposure", "process", "µm", 1.5,
         "distance by which the beam lags along each hatch line"),
    Knob("galvo-nonlinearity", "galvo-nonlinearity", "exposure", "process", "1", 0.1,
         "bulge of the hatch lines, zero at both ends of the write field: displacement strength·x(1 − x/L)"),
    Knob("vignetting", "vignetting", "exposure", "process", "1", 0.9,
         "dose lost at the corner of the write field, growing with the squared distance from its centre"),
    Knob("field-curvature", "field-curvature", "exposure", "process", "µm", 0.5,
         "rise at the corner of the write field of printed columns; the seed draws tilt against bow",
         nuisance_span=True),
    Knob("laser-drift", "laser-drift", "exposure", "nuisance", "1", 0.5,
         "relative change of the dose from the first scan to the last", nuisance_span=True),
    Knob("hatch-ripple", "hatch-ripple", "exposure", "nuisance", "nm", 100.0,
         "amplitude of ripples at the hatch pitch; the seed draws it, 2–4 % off the pixel pitch"),
    Knob("layer-stacking", "layer-stacking", "exposure", "process", "1", 1.0,
         "share of the dose that has to pass the threshold slice by slice instead of as a column"),
    Knob("interface-offset", "interface-offset", "exposure", "process", "µm", 0.6,
         "depth by which the print starts below the interface; what lies below is lost"),
    Knob("diffusion-blur", "diffusion-blur", "resist", "process", "µm", 1.2,
         "sd of a blur of the converted resist"),
    Knob("threshold-softness", "threshold-softness", "resist", "process", "1", 5.0,
         "relative increase of the steepness of the conversion curve", refit_absorbs=True),
    Knob("height-saturation", "height-saturation", "resist", "process", "1/µm", 0.8,
         "height H becomes H/(1 + strength·H)", refit_absorbs=True),
    Knob("vertical-shrinkage", "vertical-shrinkage", "development", "process", "1", 0.6,
         "share of the height lost everywhere", nuisance_span=True),
    Knob("dose-dependent-shrinkage", "dose-dependent-shrinkage", "development", "process", "1", 0.9,
         "share of the height lost where nothing around is converted; the seed draws the reach, 0.5–1 µm",
         refit_absorbs=True),
    Knob("lateral-shrinkage", "lateral-shrinkage", "development", "process", "1", 0.3,
         "lateral shrink of the tallest tops towards the centre of the layout; the foot stays"),
    Knob("feature-collapse", "feature-collapse", "development", "process", "1", 1.0,
         "share of its height above the surroundings that a slender feature (under 1.5 µm) loses"),
    Knob("trench-residue", "trench-residue", "development", "process", "1", 1.0,
         "share of their depth by which pits under 1.5 µm stay filled"),
    Knob("slope-thinning", "slope-thinning", "development", "undetermined", "µm", 3.0,
         "height lost per squared slope"),
    Knob("slope-thinning-x", "slope-thinning", "development", "undetermined", "µm", 3.0,
         "height lost per squared slope along the hatch lines"),
    Knob("slope-thinning-y", "slope-thinning", "development", "undetermined", "µm", 3.0,
         "height lost per squared slope across the hatch lines"),
    Knob("datum-offset", "datum-offset", "measurement", "measurement", "nm", 300.0,
         "sd of one offset per scan, on top of the default one", nuisance_span=True),
    Knob("min-to-zero-datum", "min-to-zero-datum", "measurement", "measurement", "1", 1.0,
         "1: the lowest pixel of each scan becomes zero; values between mix", nuisance_span=True),
    Knob("z-gain", "z-gain", "measurement", "measurement", "1", 0.3,
         "sd of the relative height gain of each scan", nuisance_span=True),
    Knob("tilt-bow", "tilt-bow", "measurement", "measurement", "nm", 500.0,
         "rms of a tilt and bow drawn for each scan", nuisance_span=True),
    Knob("scan-line-stripes", "scan-line-stripes", "measurement", "measurement", "nm", 100.0,
         "sd of one offset per scan line"),
    Knob("slow-drift", "slow-drift", "measurement", "measurement", "nm", 500.0,
         "sd of a creep that decays over the first lines of each scan"),
    Knob("tip-dilation", "tip-dilation", "measurement", "measurement", "µm", 2.0,
         "radius of the tip's paraboloid"),
    Knob("asymmetric-tip", "tip-dilation", "measurement", "measurement", "µm", 2.0,
         "radius of the tip along its blunt axis; the seed draws the axis of the scan, and how much sharper "
         "it is along the other one, 3–6 times"),
    Knob("feedback-lag", "feedback-lag", "measurement", "measurement", "µm", 2.0,
         "distance by which the feedback lags on falling edges; a third of it on rising ones"),
    Knob("registration-residual", "registration-residual", "measurement", "measurement", "µm", 1.0,
         "rms of a quadratic distortion drawn for each scan"),
    Knob("piezo-nonlinearity", "piezo-nonlinearity", "measurement", "measurement", "1", 0.1,
         "bulge of the fast axis, zero at both ends: displacement strength·x(1 − x/L)"),
    Knob("resampling-blur", "resampling-blur", "measurement", "measurement", "µm", 1.0,
         "sd of a blur of the finished scan"),
    Knob("quantisation", "quantisation", "measurement", "measurement", "nm", 200.0,
         "height step to which the file truncates"),
    Knob("line-roughness", "line-roughness", "exposure", "nuisance", "nm", 100.0,
         "sd of further line-shaped roughness"),
    Knob("scars-and-spikes", "scars-and-spikes", "measurement", "measurement", "1/row", 0.5,
         "scars per scan line, 16–60 pixels long, 50–300 nm high, and a third as many one-pixel spikes"),
    Knob("perlin-gain-y", OFF_CATALOGUE, "development", "process", "1", 1.0,
         "amplitude of a height gain that wanders along y, the same in all scans; the seed draws the curve"),
    Knob("ghost-spot", OFF_CATALOGUE, "exposure", "process", "1", 0.5,
         "dose of a second, weaker focus beside the first; the seed draws where, 0.8–2 µm away"),
    Knob("level-error", OFF_CATALOGUE, "exposure", "process", "µm", 0.6,
         "extra nominal height wherever one certain level is asked for; the seed draws which"),
    Knob("position-bump", OFF_CATALOGUE, "development", "process", "nm", 300.0,
         "rms of a smooth height map fixed to the layout's frame, the same in all scans; the seed draws it"),
    Knob("edge-bead", OFF_CATALOGUE, "development", "process", "µm", 3.0,
         "height gained per slope: steep flanks stand proud whichever way they face"),
    Knob("stitching", OFF_CATALOGUE, "exposure", "process", "µm", 1.0,
         "sd along each axis by which every write field of a print lies off its place: gaps and overlaps"),
    Knob("unseen-neighbours", OFF_CATALOGUE, "exposure", "nuisance", "1", 1.0,
         "1: beyond its edge the print goes on with another random layout; values between mix the doses"),
)  # fmt: skip

KNOBS: dict[str, Knob] = {knob.name: knob for knob in _TABLE}
