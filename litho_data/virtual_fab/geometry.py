"""Place a scan on the print, and sample the print's surface at the pixels of the scan."""

from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from litho_data.foundation import YX, Array, Shape
from litho_data.virtual_fab.canvas import GUARD_PX
from litho_data.virtual_fab.knobs import KnobBoard
from litho_data.virtual_fab.settings import Microscope

_REFERENCE_PX = 512


@dataclass(frozen=True)
class ScanFrame:
    """The size of a scan, and its position on the layout.

    Args:
        shape: shape (ny, nx) of the scan, in pixels.
        pitch_um: nominal pitch of the scan's pixels in µm.
        scan_to_layout: 3×3 matrix that maps positions (x_um, y_um, 1) of the scan to positions in the layout.
        layout_pitch_um: pitch of the layout, and of the canvas around it, in µm.
    """

    shape: Shape
    pitch_um: float
    scan_to_layout: Array
    layout_pitch_um: float

    @property
    def size_um(self) -> YX:
        """Return the nominal side lengths (y, x) of the scan in µm."""
        return self.shape[0] * self.pitch_um, self.shape[1] * self.pitch_um

    @property
    def unit_axes(self) -> tuple[Array, Array]:
        """Return coordinates y and x that run from −1 to 1 over the scan, with shapes (ny, 1) and (1, nx)."""
        return np.linspace(-1, 1, self.shape[0])[:, None], np.linspace(-1, 1, self.shape[1])[None, :]


def place_scan(
    layout_shape: Shape,
    pitch_um: float,
    microscope: Microscope,
    rng: np.random.Generator,
    turned_deg: float = 0.0,
    pixel_size: float = 1.0,
) -> ScanFrame:
    """Return the size and the position of a scan. The scan is centred on the layout except for a small random
    shift. It also has a small random rotation and shear, and a random scale error along each axis.

    Args:
        layout_shape: shape (ny, nx) of the layout.
        pitch_um: pitch of the layout in µm.
        microscope: the microscope, whose settings state the largest random errors and the margin of the scan.
        rng: random generator for the errors.
        turned_deg: rotation of the print under the microscope, in addition to the random rotation.
        pixel_size: size of the scan's pixels, in pixels of the layout.
    """
    margins_px = [round(microscope.margin_px * size / _REFERENCE_PX) for size in layout_shape]
    shape = (layout_shape[0] + 2 * margins_px[0], layout_shape[1] + 2 * margins_px[1])
    draws = rng.uniform(-1, 1, 6)
    if turned_deg % 180:
        shape = shape[::-1]
    angle = np.deg2rad(microscope.rotation_deg) * draws[0] + np.deg2rad(turned_deg)
    scale_x, scale_y = 1 + microscope.scale * draws[1], 1 + microscope.scale * draws[2]
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = rotation @ np.array([[scale_x, microscope.shear * draws[3]], [0.0, scale_y]])
    scan_centre_um = np.array([shape[1], shape[0]]) * pitch_um / 2
    layout_centre_um = np.array([layout_shape[1], layout_shape[0]]) * pitch_um / 2
    transform = np.eye(3)
    transform[:2, :2] = linear
    transform[:2, 2] = layout_centre_um + microscope.shift_um * draws[4:6] - linear @ scan_centre_um
    pixels = round(shape[0] / pixel_size), round(shape[1] / pixel_size)
    return ScanFrame(pixels, pixel_size * pitch_um, transform, pitch_um)


def sample_surface(
    surface: Array, frame: ScanFrame, knobs: KnobBoard, scan_index: int, direction: float = 1.0
) -> Array:
    """Interpolate a surface on the canvas at the pixels of the scan. The result has the shape
    ``frame.shape``.
    """
    y_um = (np.arange(frame.shape[0]) + 0.5)[:, None] * frame.pitch_um
    x_um = (np.arange(frame.shape[1]) + 0.5)[None, :] * frame.pitch_um
    # In retrace, the nonlinearity of the piezo has the opposite sign.
    if strength := direction * knobs["piezo-nonlinearity"]:
        x_um = x_um + strength * x_um * (1 - x_um / frame.size_um[1])
    (xx, xy, x0), (yx, yy, y0) = frame.scan_to_layout[:2]
    layout_x_um = xx * x_um + xy * y_um + x0
    layout_y_um = yx * x_um + yy * y_um + y0
    if strength := knobs["registration-residual"]:
        rng = knobs.scan_rng("registration-residual", scan_index)
        layout_x_um = layout_x_um + strength * _quadratic_distortion(frame, rng)
        layout_y_um = layout_y_um + strength * _quadratic_distortion(frame, rng)
    rows = layout_y_um / frame.layout_pitch_um - 0.5 + GUARD_PX
    columns = layout_x_um / frame.layout_pitch_um - 0.5 + GUARD_PX
    return scipy.ndimage.map_coordinates(surface, [rows, columns], order=3, mode="nearest")


def _quadratic_distortion(frame: ScanFrame, rng: np.random.Generator) -> Array:
    """Draw a random polynomial of degree 2 that has no affine part, and return its values at the pixels of
    the scan. On average, its mean square over the scan is 1.
    """
    y, x = frame.unit_axes
    c = rng.standard_normal(3)
    # Over the square from −1 to 1, each of the two Legendre terms has a variance of 1/5, and the product xy
    # has a variance of 1/9.
    terms = (c[0] * (1.5 * x**2 - 0.5) * 5**0.5, c[1] * (1.5 * y**2 - 0.5) * 5**0.5, c[2] * 3 * x * y)
    return (terms[0] + terms[1] + terms[2]) / 3**0.5
