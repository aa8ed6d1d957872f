"""Convert the units of length that files use to µm, and refuse unknown units."""

import re

from litho_data.foundation.errors import InputError

NM_PER_UM = 1000.0

_METRE = re.compile(r"met(er|re)s?$")
_PREFIXES = {"": "", "kilo": "k", "centi": "c", "milli": "m", "micro": "u", "nano": "n", "pico": "p"}
_IN_UM = {
    "km": 1e9,
    "m": 1e6,
    "dm": 1e5,
    "cm": 1e4,
    "mm": 1e3,
    "um": 1.0,
    "micron": 1.0,
    "microns": 1.0,
    "nm": 1e-3,
    "å": 1e-4,
    "angstrom": 1e-4,
    "ångström": 1e-4,
    "pm": 1e-6,
}
# Maps all signs for micro and for ångström to one letter each. MICRO SIGN and GREEK SMALL LETTER MU look the
# same, Bruker files write a tilde instead, and the ångström has a sign of its own besides the letter Å.
_SPELLINGS = str.maketrans({"\u00b5": "u", "\u03bc": "u", "~": "u", "\u212b": "å", "\u00c5": "å"})


def um_per(unit: str) -> float:
    """Return the length of one ``unit`` in µm.

    Args:
        unit: for example ``"m"``, ``"nm"``, ``"µm"``, ``"um"``, ``"pm"``, ``"Å"``. Case matters: ``"Mm"`` is
            not ``"mm"``.

    Raises:
        InputError: the unit is unknown or not a length. ``"A"`` is the ampere, never the ångström.
    """
    try:
        return _IN_UM[_short(unit)]
    except KeyError:
        raise InputError("unit of length", got=repr(unit), wanted="m, mm, µm (um), nm, pm or Å") from None


def is_length(unit: str) -> bool:
    """Return whether ``um_per`` knows the unit."""
    return _short(unit) in _IN_UM


def _short(unit: str) -> str:
    """Return the short form of a unit in any spelling, such as ``nm`` for nanometres."""
    plain = unit.strip().translate(_SPELLINGS)
    prefix = _METRE.sub("", plain.lower())
    return f"{_PREFIXES[prefix]}m" if _METRE.search(plain.lower()) and prefix in _PREFIXES else plain
