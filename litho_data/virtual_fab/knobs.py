"""Define the knobs, which are the effects that the virtual fab can add to plain printing. Each knob has a
unit, a largest strength and the name of its effect in the catalogue of effects.
"""

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
    """One effect that the virtual fab can add. With strength 0, the result is exactly the same as without the
    knob.

    Args:
        name: name of the knob on the command line and in the truth file.
        effect: name of the effect in the catalogue of effects, or `off-catalogue` if it is not listed there.
        stage: the stage of printing or scanning at which the effect acts.
        role: what causes the effect: the process or the measurement. ``nuisance`` marks an effect that no
            process model can predict. ``undetermined`` means that the cause is either the process or the
            measurement, but not known which.
        unit: unit of the strength.
        limit: largest strength that is accepted.
        meaning: text that says what the strength means, and which properties are drawn at random.
        nuisance_span: True if a fit of offset, gain, plane and bow to each scan absorbs nearly all of the
            effect.
        refit_absorbs: True if the plain model of printing, with its parameters fitted again, imitates most of
            the effect.
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
        """Return the largest strength as text, followed by its unit. If the unit is 1, it is left out."""
        return f"{self.limit:g}" if self.unit == "1" else f"{self.limit:g} {self.unit}"


@dataclass(frozen=True)
class KnobSetting:
    """A knob and its strength. If ``seed`` is None, the knob's random draws use the seed of the run."""

    name: str
    strength: float
    seed: int | None = None

    @classmethod
    def parse(cls, text: str) -> KnobSetting:
        """Make a setting from a text ``name=strength`` or ``name=strength@seed``.

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
    """Return the setting unchanged if it is valid.

    Raises:
        InputError: there is no knob of this name, or the strength or seed in the setting is out of range.
    """
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
    """The knobs of one run. Each knob has a strength and its own stream of random numbers."""

    def __init__(self, settings: Iterable[KnobSetting], run_seed: int):
        self.settings = tuple(checked(setting) for setting in settings)
        self._strength: Mapping[str, float] = {setting.name: setting.strength for setting in self.settings}
        if len(self._strength) != len(self.settings):
            raise InputError("knobs", got=[s.name for s in self.settings], wanted="each name at most once")
        self._seed = {s.name: run_seed if s.seed is None else s.seed for s in self.settings}

    def __getitem__(self, name: str) -> float:
        return self._strength.get(KNOBS[name].name, 0.0)

    def any(self, *names: str) -> bool:
        """Return whether any of the named knobs has a strength other than zero."""
        return any(self[name] for name in names)

    def machine_rng(self, name: str) -> np.random.Generator:
        """Return the knob's random generator for properties of the machine. It gives the same numbers for
        every scan.
        """
        return self._rng(name, 0)

    def scan_rng(self, name: str, scan_index: int) -> np.random.Generator:
        """Return the knob's random generator for one scan. It gives different numbers for every scan."""
        return self._rng(name, scan_index + 1)

    def _rng(self, name: str, stream: int) -> np.random.Generator:
        return np.random.default_rng([self._seed[name], zlib.crc32(name.encode()), stream])


KNOBS: dict[str, Knob] = {one["name"]: Knob(**one) for one in table_beside(__file__, "knobs.toml")["knob"]}
"""All knobs by name, in the order in which ``knobs.toml`` defines them."""
