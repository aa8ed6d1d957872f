"""Refractive index of resins as a function of wavelength."""

from __future__ import annotations

import math
from typing import Literal

Resin = Literal["constant", "ip-dip", "ip-dip-2019", "su-8"]

# Cauchy: n = a + b / wavelength^2 + c / wavelength^4, wavelength in µm.
# IP-Dip, exposed: Gissibl et al. 2017, doi:10.1364/OME.7.002293. SU-8 3000: data sheet of MicroChem, 2011.
_CAUCHY = {"ip-dip": (1.5273, 6.5456e-3, 2.5345e-4), "su-8": (1.5525, 6.29e-3, 4.0e-4)}
# Sellmeier: n^2 = 1 + sum of b wavelength^2 / (wavelength^2 - c), in µm.
# IP-Dip: Schmid, Ludescher and Giessen 2019, Opt. Mater. Express 9, 4564, table 2.
_SELLMEIER = {"ip-dip-2019": ((1.2899, 1.1283e-2), (6.0569e-2, 7.7762e-2), (1.1844e5, 2.5802e7))}


def refractive_index(resin: Resin | float, wavelength_um: float) -> float:
    """Return the refractive index of a resin. If ``resin`` is a number, this number is the index at all
    wavelengths. For the resin ``constant``, the index is 1 at all wavelengths. This value is arbitrary,
    because ``Optics`` uses only differences between wavelengths.
    """
    if not isinstance(resin, str):
        return float(resin)
    if resin == "constant":
        return 1.0
    square = wavelength_um**2
    if resin in _SELLMEIER:
        return math.sqrt(1 + sum(b * square / (square - c) for b, c in _SELLMEIER[resin]))
    a, b, c = _CAUCHY[resin]
    return a + b / square + c / square**2
