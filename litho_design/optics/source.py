"""Represent an extended or broadband incoherent source by monochromatic plane waves."""

from __future__ import annotations

import math

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.optics.thin_element import Optics

# Number of directions per area (wavelength / side of the element)^2. The source covers a disc in the plane of
# the direction sines. The directions lie closer together than an element can resolve.
_POINTS_PER_AREA = 3
_FEWEST = 8
_MOST = 128
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def coherent_parts(optics: Optics, size_um: float) -> list[tuple[float, Optics]]:
    """Return monochromatic plane waves whose images add up to the image of the source.

    The result contains one pair for each plane wave: the share of the light in this wave, and a copy of
    ``optics`` with the wavelength and direction of this wave. The wavelengths are the nodes of a
    Gauss-Hermite quadrature over a Gaussian spectrum. The sines of the directions along x and y are spread
    evenly over a disc, whose centre is the direction of ``optics``. The images of neighbouring waves lie
    closer together than lambda z / D, the finest detail of an element of side D. For a monochromatic point
    source, there is only one wave, with the given ``optics``.

    Args:
        size_um: side of the element.

    Raises:
        InputError: the source needs too many directions or colours for an element of this resolution.
    """
    directions = _directions(optics, size_um)
    return [
        (share / len(directions), one.model_copy(update={"incidence_x": x, "incidence_y": y}))
        for share, one in _colours(optics, size_um)
        for x, y in directions
    ]


def _colours(optics: Optics, size_um: float) -> list[tuple[float, Optics]]:
    if not optics.bandwidth_um:
        return [(1.0, optics)]
    # If the wavelength changes, a detail at the edge of the image moves by half the side of the element times
    # the relative change of the wavelength.
    widths = optics.bandwidth_um * size_um**2 / (2 * optics.wavelength_um**2 * optics.distance_um)
    nodes, weights = np.polynomial.hermite_e.hermegauss(_checked(3 + 2 * math.ceil(2 * widths), "bandwidth"))
    return [
        (weight, optics.at_wavelength(optics.wavelength_um + optics.bandwidth_um * node))
        for node, weight in zip(nodes.tolist(), (weights / weights.sum()).tolist(), strict=True)
    ]


def _directions(optics: Optics, size_um: float) -> list[tuple[float, float]]:
    middle = (optics.incidence_x, optics.incidence_y)
    if not optics.source_sine:
        return [middle]
    area = math.pi * (optics.source_sine * size_um / optics.wavelength_um) ** 2
    count = _checked(max(_FEWEST, math.ceil(_POINTS_PER_AREA * area)), "width")
    number = np.arange(count)
    # The directions lie on a sunflower spiral, so that each of them stands for the same area.
    disc = optics.source_sine * np.sqrt((number + 0.5) / count) * np.exp(1j * _GOLDEN_ANGLE * number)
    disc += complex(*middle) - disc.mean()
    return [(one.real, one.imag) for one in disc.tolist()]


def _checked(count: int, what: str) -> int:
    if count > _MOST:
        raise InputError(
            f"{what} of the source",
            got=f"{count} waves, because an element of this size resolves that many",
            wanted=f"at most {_MOST}",
        )
    return count


def require_one_wave(optics: Optics, what: str) -> None:
    """Check that the source is suitable for a computation that uses a single plane wave.

    Raises:
        InputError: the source is not a distant, monochromatic point source.
    """
    if optics.bandwidth_um or optics.source_sine or optics.source_distance_um:
        raise InputError(
            f"source of {what}",
            got=f"bandwidth {optics.bandwidth_um:g} µm, sine {optics.source_sine:g}, distance "
            f"{optics.source_distance_um:g} µm",
            wanted="a distant, monochromatic point source (0, 0, 0)",
        )
