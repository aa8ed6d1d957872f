"""Compute the wave behind a printed height map."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from litho_data.commands.settings import setting
from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_design.optics.materials import Resin, refractive_index

ElementKind = Literal["thin", "thick"]

# Range of valid wavelengths. A value outside this range was probably given in metres or nanometres.
SHORTEST_UM, LONGEST_UM = 0.05, 100.0
# Width, µm, of the dark border that is added around a thick element. Light that passes through a relief
# spreads sideways by no more than this width.
_BORDER_UM = 2.0

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from litho_data.foundation.grid import PixelGrid


class Optics(Record):
    """Settings of the light: its wavelength and source, the refractive index step of the element, and the
    distance to the image plane.
    """

    wavelength_um: float = setting(
        0.6328, "Wavelength", unit="µm", option="--wavelength-um", gt=SHORTEST_UM, lt=LONGEST_UM
    )
    index_step: float = setting(
        0.548,
        "Refractive index of the resist minus that of its surroundings",
        option="--index-step",
        gt=0,
        le=10,
    )
    distance_um: float = setting(
        300.0,
        "Distance to the image plane, or focal length",
        unit="µm",
        option=("--distance-um", "--focal-length-um"),
        gt=0,
    )

    incidence_x: float = setting(0.0, "Sine of the angle of incidence along x", gt=-1, lt=1)
    incidence_y: float = setting(0.0, "Sine of the angle of incidence along y", gt=-1, lt=1)
    source_sine: float = setting(
        0.0,
        "Sine of half the angle that an incoherent source subtends at the element; 0 for a point",
        ge=0,
        lt=1,
    )
    bandwidth_um: float = setting(
        0.0,
        "Standard deviation of the wavelengths of the source; 0 for monochromatic light",
        unit="µm",
        ge=0,
    )
    beam_um: float = setting(
        0.0,
        "Radius of a Gaussian beam on the element, at 1/e² of its intensity; 0 for uniform light",
        unit="µm",
        ge=0,
    )
    source_distance_um: float = setting(
        0.0,
        "Distance from the element to a point source; 0 for a distant source",
        unit="µm",
        ge=0,
    )
    propagation: Literal["auto", "rayleigh-sommerfeld", "angular-spectrum", "far-field"] = setting(
        "auto",
        "Propagator: the Rayleigh-Sommerfeld sum, the angular spectrum, whichever of these two is valid "
        "(auto), or the far field in the focal plane of a lens",
        option="--propagation",
    )
    element: ElementKind = setting(
        "thin",
        "Element: one phase per pixel (thin), or the wave propagation method through the relief (thick)",
        option="--element",
    )
    dispersion: Resin = setting("ip-dip", "Resin whose dispersion applies if the wavelength varies")

    def at_wavelength(self, wavelength_um: float) -> Optics:
        """Return the same optics at another wavelength, with the index step of the resin at this
        wavelength.
        """
        there, here = (refractive_index(self.dispersion, one) for one in (wavelength_um, self.wavelength_um))
        step = self.index_step + there - here
        return self.model_copy(update={"wavelength_um": wavelength_um, "index_step": step})

    def oblique_path_um(self, y_um: Tensor, x_um: Tensor) -> Tensor:
        """Return by how much the path of oblique light to the given positions exceeds its path to the axis,
        µm. The result is 0 for light along the axis.
        """
        return self.incidence_x * x_um + self.incidence_y * y_um

    def edge_sine(self, radius_um: float) -> float:
        """Return the sine of the angle, seen from the image, between the axis and a point of the element at a
        distance ``radius_um`` from the axis. For the far field, which an ideal lens forms, return radius /
        focal length instead.
        """
        far_field = self.propagation == "far-field"
        return radius_um / (self.distance_um if far_field else math.hypot(radius_um, self.distance_um))

    @property
    def wave_height_um(self) -> float:
        """Return the height that delays the wave by one period, µm."""
        return self.wavelength_um / self.index_step


def check_incidence(grid: PixelGrid, optics: Optics) -> None:
    """Check that the sine of the angle of incidence is below 1 at every pixel, and that the pixels are small
    enough to sample the phase of the incident light.

    The sine of the angle at a pixel is the sine of the oblique incidence plus, for a near point source, the
    sine of the ray from this source.

    Raises:
        InputError: the sine along x or y reaches wavelength / (2 pitch), above which the sampled wave would
            have another direction; or the sine of the whole angle of incidence reaches 1.
    """
    farthest_um = [float(abs(axis).max()) for axis in (grid.y_um, grid.x_um)]
    distance_um = optics.source_distance_um
    oblique = abs(optics.incidence_y), abs(optics.incidence_x)
    near = [far / math.hypot(far, distance_um) if distance_um else 0.0 for far in farthest_um]
    corner_um = math.hypot(*farthest_um)
    whole = math.hypot(*oblique) + (corner_um / math.hypot(corner_um, distance_um) if distance_um else 0.0)
    along = [tilt + ray for tilt, ray in zip(oblique, near, strict=True)]
    limits = [optics.wavelength_um / (2 * pitch_um) for pitch_um in grid.pitch_um]
    for sine, limit in ((whole, 1.0), *zip(along, limits, strict=True)):
        if sine >= limit:
            raise InputError(
                "light on the element",
                got=f"an angle of incidence with a sine of up to {sine:.3g}",
                wanted=f"below {limit:.3g}" + (", which is λ / (2 pitch)" if limit != 1 else ""),
                hint="lower incidence_x, incidence_y or source_sine, or raise source_distance_um",
            )


def known_height(height_um: Tensor | np.ndarray, like: Tensor) -> Tensor:
    """Return the heights of a known print, µm, as a tensor on the device of ``like``. An array also gets the
    dtype of ``like``.

    Raises:
        InputError: the heights are not numbers, or some heights are missing (NaN), as may be the case in a
            scan.
    """
    import numpy as np
    import torch  # imported late, as in `element_field`

    if isinstance(height_um, torch.Tensor):
        height = height_um.to(like.device)
    else:
        try:
            height = torch.from_numpy(np.array(height_um, np.float64)).to(like)
        except (TypeError, ValueError) as error:
            raise InputError("heights of a print", got=error, wanted="an array of heights in µm") from None
    # Inside a transform of torch.func, values cannot be read, so they are not checked.
    if torch._C._functorch.is_functorch_wrapped_tensor(height):
        return height
    if missing := int((~height.isfinite()).sum()):
        raise InputError(
            "heights of a print",
            got=f"no finite number at {missing} of {height.numel()} pixels",
            wanted="a height in µm at every pixel",
            hint="fill pixels without a measurement, for example with the predicted heights",
        )
    return height


def element_field(
    height_um: Tensor,
    grid: PixelGrid,
    optics: Optics,
    aperture: Tensor | None = None,
    *,
    pixels: int | None = None,
) -> Tensor:
    """Return the wave just behind a phase element that is illuminated by a plane wave of unit power.

    The wave is u = exp(j 2 pi (index_step height + incidence . position) / wavelength) on the aperture and 0
    elsewhere. For a Gaussian beam, u is multiplied by the amplitude of the beam; for a near point source, the
    phase of its spherical wave is added. The wave is scaled so that sum |u|^2 dy dx = 1. The sum of |u|^2 dy
    dx over a window is therefore the share of the incident power in this window. For a thick element in air,
    ``wave_through_relief`` replaces the phase delay of the heights.

    Args:
        height_um: printed heights, µm, shape (..., ny, nx).
        grid: grid of the pixels of ``height_um``.
        aperture: amplitude transmission of the aperture in [0, 1], shape (ny, nx). By default, the whole grid
            is open.
        pixels: number of pixels of the whole element, if ``grid`` covers only a part of it.

    Returns:
        The complex wave, 1/µm, shape (..., ny, nx).

    Raises:
        InputError: ``check_incidence`` rejects the direction of the light.
    """
    import torch  # imported late, because the command line reads `Optics` without it

    phase = height_um * (2 * math.pi / optics.wave_height_um)
    if optics.incidence_x or optics.incidence_y or optics.source_distance_um or optics.beam_um:
        check_incidence(grid, optics)
        x, y = (torch.from_numpy(axis).double().to(phase.device) for axis in (grid.x_um, grid.y_um))
        squared = x[None, :] ** 2 + y[:, None] ** 2
        path_um = optics.oblique_path_um(y[:, None], x[None, :])
        if optics.source_distance_um:
            path_um = path_um + (squared + optics.source_distance_um**2).sqrt() - optics.source_distance_um
        phase = phase + (path_um * (2 * math.pi / optics.wavelength_um)).to(phase)
        if optics.beam_um:
            beam = torch.exp(-squared / optics.beam_um**2)
            aperture = beam if aperture is None else aperture * beam
    area = math.prod(grid.pitch_um)
    if aperture is None:
        amplitude = torch.full_like(phase, 1 / math.sqrt((pixels or math.prod(grid.shape)) * area))
    else:
        power = float(aperture.double().square().sum()) * area
        amplitude = (aperture / math.sqrt(power)).to(phase).expand_as(phase)
    if optics.element == "thin":
        return torch.polar(amplitude, phase)
    tilted = torch.polar(amplitude, phase - height_um * (2 * math.pi / optics.wave_height_um))
    return through_relief(tilted, height_um, grid.pitch_um[0], optics)


def flat_field(grid: PixelGrid, optics: Optics, *, pixels: int | None = None) -> Tensor:
    """Return the wave just behind a flat element, complex128 of shape (ny, nx). The arguments are those of
    ``element_field``.
    """
    import torch  # imported late, as in `element_field`

    return element_field(torch.zeros(grid.shape, dtype=torch.float64), grid, optics, pixels=pixels)


def through_relief(field: Tensor, height_um: Tensor, pitch_um: float, optics: Optics) -> Tensor:
    """Return the wave, shape (..., ny, nx), behind a thick element in air. ``field`` is the wave that
    illuminates the element.

    The surroundings of the element are dark.
    """
    import torch

    from litho_design.optics.thick_element import wave_through_relief

    # A dark border is added, so that light that leaves on one side does not enter on the other.
    border = (math.ceil(_BORDER_UM / pitch_um),) * 4
    dark = torch.nn.functional.pad(field, border)
    relief = torch.nn.functional.pad(height_um - height_um.amin(), border)
    wave = wave_through_relief(dark, relief, pitch_um, optics.wavelength_um, 1 + optics.index_step)
    return torch.nn.functional.pad(wave, [-one for one in border])


def intensity_share(field: Tensor, grid: PixelGrid) -> Tensor:
    """Return |U|^2 times the pixel area, which is the share of the incident power on each pixel."""
    return (field.real.square() + field.imag.square()) * math.prod(grid.pitch_um)
