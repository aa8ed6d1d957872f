"""The optics of a lens, which turn a printed height map into a point spread function (PSF) and images."""

from __future__ import annotations

import copy
import math
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_design.lenses.settings import ImagingSettings, LensView
from litho_design.optics import (
    Optics,
    RadialPropagator,
    centred_grid,
    element_field,
    intensity_share,
    make_propagator,
)
from litho_design.optics.imaging import Blur, bin_pixels
from litho_design.optics.source import require_one_wave
from litho_design.printers.layout import LayoutSettings

# Side of the central box, µm, from which the centre-to-background ratio is computed, as in the paper.
CENTRE_UM = 1.0


class LensOptics(nn.Module):
    """Base class of ``LensBench``, which computes on a plane, and ``RadialLensBench``, which computes on
    rings. Both inherit the numerical aperture, the focal window (the pixels around the focus) and the heights
    of a perfect lens.

    Raises:
        InputError: the source is not a distant, monochromatic point source, or the focal window is smaller
            than the central box, from which the centre-to-background ratio is computed.
    """

    def __init__(self, layout: LayoutSettings, optics: Optics, view: LensView):
        super().__init__()
        require_one_wave(optics, "a lens")
        if view.window_px * layout.pitch_um < CENTRE_UM:
            raise InputError(
                "PSF window of a lens",
                got=f"{view.window_px} px of {layout.pitch_um:g} µm",
                wanted=f"a side of at least {CENTRE_UM:g} µm, the central box",
                hint=f"use --window-px {math.ceil(CENTRE_UM / layout.pitch_um)} or more",
            )
        self.layout, self.optics, self.view = layout, optics, view
        self.window = centred_grid((view.window_px, view.window_px), layout.pitch_um)
        self.grid = centred_grid((layout.size_px, layout.size_px), layout.pitch_um)

    @property
    def numerical_aperture(self) -> float:
        """Return the numerical aperture, which is the sine of the angle, seen from the focus, between the
        axis and the edge of the aperture along x or y.
        """
        return self.optics.edge_sine(self.layout.size_um / 2)

    def ratio(self, psf: Tensor) -> Tensor:
        """Return the centre-to-background ratio of a PSF of shape (window, window)."""
        return centre_to_background(psf, CENTRE_UM / self.layout.pitch_um, self.layout.size_px)

    def focusing_loss(self, psf: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a PSF, which is -log(centre-to-background ratio), and a dict of named values for
        the history of the search. The PSF has shape (window, window).
        """
        ratio = self.ratio(psf)
        return -ratio.log(), {"cbr": float(ratio.detach()), "window": float(psf.detach().sum())}

    def radius_um(self) -> Tensor:
        """Return the distance from the axis of every point at which the lens has a height, float64, µm."""
        raise NotImplementedError

    def oblique_path_um(self) -> Tensor | float:
        """Return the extra path of oblique light to each point that has a height, float64, µm."""
        return 0.0

    def thin(self) -> Self:
        """Return a copy of this bench for a thin element, with the same propagator. Only a thin element can
        be a perfect lens, because the slopes of a thick element cast shadows.
        """
        bench = copy.copy(self)
        bench.optics = self.optics.model_copy(update={"element": "thin"})
        return bench

    def ideal_psf(self) -> Tensor:
        """Return the PSF of a perfect lens, shape (window, window)."""
        psf: Tensor = self.thin()(self.ideal_height_um())
        return psf

    def ideal_height_um(self) -> Tensor:
        """Return the heights of a perfect lens, µm, wrapped at the height that gives a phase delay of 2π."""
        focal_um = self.optics.distance_um
        path = focal_um - (self.radius_um() ** 2 + focal_um**2).sqrt() - self.oblique_path_um()
        # This height delays the wave by the difference in path length. The wave does not change if the height
        # is wrapped.
        height = path * self.optics.wave_height_um / self.optics.wavelength_um
        return torch.remainder(height, self.optics.wave_height_um).float()


class LensBench(LensOptics):
    """Propagate a plane wave through a printed lens onto the focal window."""

    aperture: Tensor

    def __init__(self, layout: LayoutSettings, optics: Optics, view: LensView):
        super().__init__(layout, optics, view)
        self.propagator = make_propagator(self.grid, self.window, optics)
        radius = np.hypot(self.grid.y_um[:, None], self.grid.x_um[None, :])
        inside = radius < layout.size_um / 2 if view.aperture == "circle" else np.ones_like(radius)
        self.register_buffer("aperture", torch.from_numpy(inside).float(), persistent=False)

    def forward(self, height_um: Tensor) -> Tensor:
        """Return the PSF behind a height map in µm of shape (size, size). Each value of the PSF is the share
        of the incident power on one pixel of the focal window.
        """
        field = element_field(height_um, self.grid, self.optics, self.aperture)
        return intensity_share(self.propagator(field), self.window)

    def radius_um(self) -> Tensor:
        """Return the distance of each pixel from the axis, shape (size, size), µm."""
        y, x = (torch.from_numpy(axis) for axis in (self.grid.y_um, self.grid.x_um))
        return torch.hypot(y[:, None], x[None, :]).to(self.aperture.device)

    def oblique_path_um(self) -> Tensor:
        """Return the extra path of oblique light to each pixel, float64 of shape (size, size), µm."""
        y, x = (torch.from_numpy(axis) for axis in (self.grid.y_um, self.grid.x_um))
        return self.optics.oblique_path_um(y[:, None], x[None, :]).to(self.aperture.device)


class RadialLensBench(LensOptics):
    """Compute the PSF of a lens of rings behind a circular aperture, from the heights along a radius."""

    lower: Tensor
    share: Tensor

    def __init__(self, layout: LayoutSettings, optics: Optics, view: LensView):
        super().__init__(layout, optics, view)
        rings, window = layout.size_px // 2, self.window
        radius = torch.from_numpy(np.hypot(window.y_um[:, None], window.x_um[None, :]))
        nodes = torch.arange(int(float(radius.max()) / layout.pitch_um) + 2) * layout.pitch_um
        self.propagator = RadialPropagator(
            rings, layout.pitch_um, nodes, optics.distance_um, optics.wavelength_um
        )
        position = radius / layout.pitch_um
        self.register_buffer("lower", position.floor().long(), persistent=False)
        self.register_buffer("share", (position - position.floor()).float(), persistent=False)
        self._incident = math.pi * (rings * layout.pitch_um) ** 2

    def forward(self, ring_height_um: Tensor) -> Tensor:
        """Return the PSF, shape (window, window), of a lens whose rings have the given heights in µm, shape
        (rings,).
        """
        phase = ring_height_um * (2 * math.pi / self.optics.wave_height_um)
        wave = self.propagator(torch.polar(torch.full_like(phase, self._incident**-0.5), phase))
        # The complex wave is interpolated along the radius, because the intensity is not smooth on the scale
        # of a pixel.
        here = wave[self.lower] * (1 - self.share) + wave[self.lower + 1] * self.share
        return (here.real.square() + here.imag.square()) * self.layout.pitch_um**2

    def radius_um(self) -> Tensor:
        """Return the distance of the middle of each ring from the axis, shape (rings,), µm."""
        rings = torch.arange(self.propagator.rings, dtype=torch.float64, device=self.share.device)
        return (rings + 0.5) * self.layout.pitch_um


def centre_to_background(psf: Tensor, centre_px: float, element_px: int) -> Tensor:
    """Return the mean intensity in the central box of a PSF, divided by the mean intensity on the background,
    i.e. on the rest of an image plane that is as large as the element.

    All light outside the box counts as background, even if it misses this image plane. The mean background is
    therefore (1 - share in the box) / (area of the element - area of the box). If only the PSF window were
    counted, layouts that send light outside the window would have better ratios.

    The box is centred on the window. Its width need not be a whole number of pixels; a pixel on the edge of
    the box is weighted with the share of its area inside the box.
    """
    side, half_px = psf.shape[-1], centre_px / 2
    left = torch.arange(side, dtype=torch.float64, device=psf.device) - side / 2
    inside = ((left + 1).clamp(max=half_px) - left.clamp(min=-half_px)).clamp(min=0).to(psf)
    first, last = max(math.floor(side / 2 - half_px), 0), min(math.ceil(side / 2 + half_px), side)
    # The box is cropped after the multiplication. If the box consists of whole pixels, its sum then has the
    # same order as a sum over the PSF's rows.
    box = (psf * inside[:, None] * inside)[..., first:last, first:last].sum()
    rest = (1 - box) / (element_px**2 - centre_px**2)
    return box / centre_px**2 / rest


def sensor_psf(psf: Tensor, pixel_px: int) -> Tensor:
    """Return the PSF summed over sensor pixels, and cropped to an odd number of pixels around the axis."""
    pixels = psf.shape[-1] // pixel_px
    pixels -= 1 - pixels % 2
    first = (psf.shape[-1] - pixels * pixel_px) // 2
    last = first + pixels * pixel_px
    return bin_pixels(psf[..., first:last, first:last], pixel_px)


def record(objects: Tensor, psf: Tensor, imaging: ImagingSettings, seed: int) -> Tensor:
    """Return n sensor images, shape (n, size, size). Each of them is the convolution of one object with the
    PSF, plus read noise and photon noise that are drawn with ``seed``.

    Photon noise is drawn from a Gaussian distribution with the variance of Poisson noise. No gradient flows
    through its standard deviation.
    """
    frame = (int(objects.shape[-2]), int(objects.shape[-1]))
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(objects.shape, generator=generator).to(objects.device)
    image = Blur(psf, frame).forward(objects)
    if not imaging.photon_noise:
        return image + imaging.read_noise * noise
    variance = imaging.read_noise**2 + imaging.photon_noise * image.detach().clamp(min=0)
    return image + variance.sqrt() * noise
