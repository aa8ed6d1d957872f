"""Define the canvas, which is the area simulated around one layout, and spectral blurs on it."""

from dataclasses import dataclass

import numpy as np
import scipy.fft

from litho_data.foundation import YX, Array, Shape

GUARD_PX = 96


@dataclass(frozen=True)
class Canvas:
    """A layout with a guard frame, and its position in the write field.

    Args:
        level: uint8, (ny + 2·GUARD_PX, nx + 2·GUARD_PX); the layout lies in the middle.
        pitch_um: pixel pitch, µm.
        field_um: (y, x) centre of the layout in its write field, µm from the field's centre.
        write_field_um: side of the write field, µm.
    """

    level: Array
    pitch_um: float
    field_um: YX
    write_field_um: float

    @property
    def y_um(self) -> Array:
        """Return the row centres in the layout's frame, µm, as a column (ny, 1)."""
        return ((np.arange(self.level.shape[0]) - GUARD_PX + 0.5) * self.pitch_um)[:, None]

    @property
    def x_um(self) -> Array:
        """Return the column centres in the layout's frame, µm, as a row (1, nx)."""
        return ((np.arange(self.level.shape[1]) - GUARD_PX + 0.5) * self.pitch_um)[None, :]

    @property
    def size_um(self) -> YX:
        """Return the (y, x) extent of the layout, µm."""
        ny, nx = self.level.shape
        return (ny - 2 * GUARD_PX) * self.pitch_um, (nx - 2 * GUARD_PX) * self.pitch_um

    def field_offset_um(self) -> tuple[Array, Array]:
        """Return the (y, x) distance of every pixel from the write field's centre, µm, broadcastable."""
        height_um, width_um = self.size_um
        return self.y_um - height_um / 2 + self.field_um[0], self.x_um - width_um / 2 + self.field_um[1]


def frame_layout(level: Array) -> Array:
    """Add the guard frame around a layout by repeating the outermost levels."""
    return np.pad(level, GUARD_PX, mode="edge")


def cut_layout(array: Array) -> Array:
    """Return the part of a canvas array that lies inside the layout."""
    return array[GUARD_PX:-GUARD_PX, GUARD_PX:-GUARD_PX]


def set_layout(array: Array, inner: Array) -> Array:
    """Return a copy of a canvas array in which ``inner`` replaces the values inside the layout."""
    changed = array.copy()
    changed[GUARD_PX:-GUARD_PX, GUARD_PX:-GUARD_PX] = inner
    return changed


def frequencies_per_um(shape: Shape, pitch_um: float) -> tuple[Array, Array]:
    """Return the frequencies (fy, fx) of the half-plane transform, cycles/µm, as broadcastable arrays."""
    return np.fft.fftfreq(shape[0], pitch_um)[:, None], np.fft.rfftfreq(shape[1], pitch_um)[None, :]


def apply_transfer(field: Array, transfer: Array) -> Array:
    """Multiply the half-plane spectrum of ``field`` by ``transfer``."""
    return scipy.fft.irfft2(scipy.fft.rfft2(field) * transfer, s=field.shape)


def gaussian_transfer(shape: Shape, pitch_um: float, sigma_um: float) -> Array:
    """Return the transfer function of an isotropic Gaussian with the standard deviation ``sigma_um``."""
    frequency_y, frequency_x = frequencies_per_um(shape, pitch_um)
    return np.exp(-2 * (np.pi * sigma_um) ** 2 * (frequency_y**2 + frequency_x**2))


def blur(field: Array, pitch_um: float, sigma_um: float) -> Array:
    """Return the field, blurred by a Gaussian with the standard deviation ``sigma_um``."""
    return apply_transfer(field, gaussian_transfer(field.shape, pitch_um, sigma_um))
