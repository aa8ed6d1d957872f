"""Define the canvas, i.e. the area that is simulated. It consists of a layout and a guard frame, which is a
margin of ``GUARD_PX`` pixels on each side. The module also blurs arrays on the canvas, by multiplying their
spectra.
"""

from dataclasses import dataclass

import numpy as np
import scipy.fft

from litho_data.foundation import YX, Array, Shape

GUARD_PX = 96


@dataclass(frozen=True)
class Canvas:
    """A layout with a guard frame around it. The canvas also states where the layout lies in the write field.

    Args:
        level: levels of the layout and its guard frame, a uint8 array of shape (ny + 2·GUARD_PX, nx +
            2·GUARD_PX). The layout itself has shape (ny, nx) and lies in the middle.
        pitch_um: pitch of the pixels in µm.
        field_um: centre (y, x) of the layout, in µm from the centre of the write field.
        write_field_um: side of the write field in µm.
    """

    level: Array
    pitch_um: float
    field_um: YX
    write_field_um: float

    @property
    def y_um(self) -> Array:
        """Return the y coordinates of the centres of all rows, in µm in the layout's frame. The shape is
        (rows, 1).
        """
        return ((np.arange(self.level.shape[0]) - GUARD_PX + 0.5) * self.pitch_um)[:, None]

    @property
    def x_um(self) -> Array:
        """Return the x coordinates of the centres of all columns, in µm in the layout's frame. The shape is
        (1, columns).
        """
        return ((np.arange(self.level.shape[1]) - GUARD_PX + 0.5) * self.pitch_um)[None, :]

    @property
    def size_um(self) -> YX:
        """Return the side lengths (y, x) of the layout, without its guard frame, in µm."""
        ny, nx = self.level.shape
        return (ny - 2 * GUARD_PX) * self.pitch_um, (nx - 2 * GUARD_PX) * self.pitch_um

    def field_offset_um(self) -> tuple[Array, Array]:
        """Return the positions y and x of all pixels relative to the centre of the write field, in µm. The
        two arrays have shapes (rows, 1) and (1, columns).
        """
        height_um, width_um = self.size_um
        return self.y_um - height_um / 2 + self.field_um[0], self.x_um - width_um / 2 + self.field_um[1]


def frame_layout(level: Array) -> Array:
    """Return the layout with a guard frame around it. The frame repeats the layout's outermost levels."""
    return np.pad(level, GUARD_PX, mode="edge")


def cut_layout(array: Array) -> Array:
    """Cut an array on the canvas to the area of the layout, and return this part."""
    return array[GUARD_PX:-GUARD_PX, GUARD_PX:-GUARD_PX]


def set_layout(array: Array, inner: Array) -> Array:
    """Return a copy of an array on the canvas, with the values inside the layout replaced by ``inner``."""
    changed = array.copy()
    changed[GUARD_PX:-GUARD_PX, GUARD_PX:-GUARD_PX] = inner
    return changed


def frequencies_per_um(shape: Shape, pitch_um: float) -> tuple[Array, Array]:
    """Return the frequencies fy and fx of the real-input Fourier transform (rfft2) of an array of this shape,
    in cycles/µm. The two arrays broadcast to the shape of the transform.
    """
    return np.fft.fftfreq(shape[0], pitch_um)[:, None], np.fft.rfftfreq(shape[1], pitch_um)[None, :]


def apply_transfer(field: Array, transfer: Array) -> Array:
    """Multiply the spectrum (rfft2) of ``field`` by ``transfer``, and return the filtered field."""
    return scipy.fft.irfft2(scipy.fft.rfft2(field) * transfer, s=field.shape)


def gaussian_transfer(shape: Shape, pitch_um: float, sigma_um: float) -> Array:
    """Return the transfer function of a blur with a round Gaussian of the standard deviation ``sigma_um``."""
    frequency_y, frequency_x = frequencies_per_um(shape, pitch_um)
    return np.exp(-2 * (np.pi * sigma_um) ** 2 * (frequency_y**2 + frequency_x**2))


def blur(field: Array, pitch_um: float, sigma_um: float) -> Array:
    """Return the field blurred with a round Gaussian of the standard deviation ``sigma_um``."""
    return apply_transfer(field, gaussian_transfer(field.shape, pitch_um, sigma_um))
