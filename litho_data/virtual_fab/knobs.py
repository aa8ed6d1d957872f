"""Define all knobs (effects beyond plain printing) with their units, ranges and names in the catalogue."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from litho_data.foundation import InputError, table_beside, unknown_name

Stage = Literal["exposure", "resist", "development", "measurement"]
Role = Literal["process", "measurement", "nuisance", "undetermined"]

OFF_CATALOGUE = "off-catalogue"


@dataclass(frozen=True)
class Knob:
    """One effect that the fab can add; with strength 0, every bit of the result is unchanged.

    Args:
        name: name on the command line and in the truth file.
        effect: identifier in the effects catalogue, or `off-catalogue`.
        stage: the stage at which the effect acts.
        role: whether the effect belongs to the print, to the microscope, or to chance.
        unit: unit of the strength.
        limit: largest meaningful strength.
        meaning: what a strength of one unit does, and what is drawn with the seed.
        nuisance_span: True if offset, gain, plane and bow of each scan absorb nearly all of the effect.
        refit_absorbs: True if other parameters of the plain printing model imitate most of the effect.
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
        """Return the largest strength as text, followed by its unit unless the unit is 1."""
        return f"{self.limit:g}" if self.unit == "1" else f"{self.limit:g} {self.unit}"


@dataclass(frozen=True)
class KnobSetting:
    """A knob set to a strength; without a seed of its own, it uses the seed of the run."""

    name: str
    strength: float
    seed: int | None = None

    @classmethod
    def parse(cls, text: str) -> KnobSetting:
        """Parse ``name=strength`` or ``name=strength@seed``.

        Raises:
            InputError: the text has another form, the name is unknown, or the strength is out of range.
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
    """Return the setting unchanged; raise InputError for an unknown knob or a value out of range."""
    knob = KNOBS.get(setting.name)
    if knob is None:
        raise unknown_name("knob", setting.name, KNOBS, "`litho-data simulate --list-knobs` explains all")
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
        """Return whether any of these knobs has a strength other than zero."""
        return any(self[name] for name in names)

    def machine_rng(self, name: str) -> np.random.Generator:
        """Return the knob's random generator for properties of the machine, the same for every scan."""
        return self._rng(name, 0)

    def scan_rng(self, name: str, scan_index: int) -> np.random.Generator:
        """Return the knob's random generator for one scan, different for every scan."""
        return self._rng(name, scan_index + 1)

    def _rng(self, name: str, stream: int) -> np.random.Generator:
        return np.random.default_rng([self._seed[name], zlib.crc32(name.encode()), stream])


KNOBS: dict[str, Knob] = {one["name"]: Knob(**one) for one in table_beside(__file__, "knobs.toml")["knob"]}
"""All knobs by name, in the order in which they are listed; they are defined in ``knobs.toml``."""
