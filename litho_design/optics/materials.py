"""Refractive index of resins against wavelength."""

from __future__ import annotations

from typing import Literal

Resin = Literal["constant", "ip-dip", "su-8"]

# Cauchy: n = a + b / wavelength^2 + c / wavelength^4, wavelength in µm.
# IP-Dip, exposed: Gissibl et al. 2017, doi:10.1364/OME.7.002293. SU-8 3000: data sheet of MicroChem, 2011.
_CAUCHY = {"ip-dip": (1.5273, 6.5456e-3, 2.5345e-4), "su-8": (1.5525, 6.29e-3, 4.0e-4)}


def refractive_index(resin: Resin, wavelength_um: float) -> float:
    """Refractive index of a resin; 1 at all wavelengths for ``constant``, which only has differences."""
    if resin == "constant":
        return 1.0
    a, b, c = _CAUCHY[resin]
    return a + b / wavelength_um**2 + c / wavelength_um**4
