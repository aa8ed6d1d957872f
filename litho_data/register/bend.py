"""Describe the bend of a scan. A nonlinear scanner displaces the points of a scan smoothly. The bend is the
displacement of the points from their nominal to their true positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from litho_data.foundation import YX, Array, Shape

_QUADRATIC_TERMS = 3
CREEP_DEGREE = 6
# ``Bend.undo`` ends when its steps are below this share of half the scan's shorter side, i.e. far below a
# thousandth of a pixel.
_SETTLED = 1e-9
# Largest number of steps in ``Bend.undo``. A bend with a slope of 0.1 takes 10 steps, one with a slope of 0.9
# takes 200.
_STEPS = 400
# Number of points along each side of the frame at which the size of a bend is evaluated.
_GRID = 65


@dataclass(frozen=True)
class Bend:
    """The bend of a scan, i.e. the displacement of the scan's points from their nominal to their true
    positions.

    The displacement is a polynomial of u and v. The coordinates u (along x) and v (along y) run from -1 to 1
    over the frame of the scan.

    ``amount`` has shape (2, 3), with one row for the displacement along x and one row for the displacement
    along y. Its columns are the coefficients of u² - 1/3, uv and v² - 1/3. For a scanner that creeps,
    ``amount`` has shape (2, 11). Columns 3 to 10 are then the coefficients of the Legendre polynomials P₃(u),
    P₃(v), P₄(u), … P₆(v). Over the frame, every term has a mean of zero and is orthogonal to u and v. The
    affine part of the displacement, fitted over the frame, is therefore zero. ``middle`` and ``half`` contain
    the centre (x, y) and half the size (x, y) of the frame, in the unit of ``amount``, so that u = (x -
    middle) / half.
    """

    amount: Array
    middle: Array
    half: Array

    @classmethod
    def of_scan(cls, amount_um: Array, scan_shape: Shape, scan_pitch_um: YX) -> Bend:
        """Make a bend from its coefficients ``amount_um`` in µm, in the frame of a scan with the given shape
        (ny, nx) and pitch (y, x).
        """
        half_um = np.array([scan_shape[1] * scan_pitch_um[1], scan_shape[0] * scan_pitch_um[0]]) / 2
        return cls(np.asarray(amount_um, dtype=float), half_um, half_um)

    @property
    def figures(self) -> dict[str, float]:
        """Return the values that describe the bend in the quality record. They are its largest displacement
        and its six quadratic coefficients, in µm.

        For example, ``bend_x_by_xx_um`` is the coefficient of u² - 1/3 in the displacement along x.
        """
        names = [f"bend_{axis}_by_{term}_um" for axis in "xy" for term in ("xx", "xy", "yy")]
        values = (float(value) for value in self.amount[:, :3].ravel())
        return {"bend_um": self.largest, **dict(zip(names, values, strict=True))}

    @classmethod
    def none_yet(cls, shape: Shape) -> Bend:
        """Return a bend of zero displacement for a scan of shape (ny, nx). Its frame is in pixel indices."""
        ny, nx = shape
        return cls(np.zeros((2, 3)), np.array([nx - 1, ny - 1]) / 2, np.array([nx, ny]) / 2)

    def in_pixels(self, pitch_um: YX) -> Bend:
        """Convert this bend from µm to pixel indices of a scan with the given pitch (y, x), and return the
        result.
        """
        pitch_x_y = np.array(pitch_um[::-1])
        return Bend(self.amount / pitch_x_y[:, None], self.middle / pitch_x_y - 0.5, self.half / pitch_x_y)

    def scaled(self, factor: float) -> Bend:
        """Return the same bend in another unit of length. All of its lengths are multiplied by ``factor``."""
        return Bend(self.amount * factor, self.middle * factor, self.half * factor)

    def shift(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the displacements, along x and along y, of the scan's points at the nominal positions (x,
        y).

        A point outside the frame has the displacement of the nearest point of the frame.
        """
        u, v = (np.clip(one, -1, 1) for one in self.unit(x, y))
        terms = _terms(u, v, self.degree)
        along_x, along_y = (sum(a * term for a, term in zip(row, terms, strict=True)) for row in self.amount)
        return along_x, along_y

    def straighten(self, points: Array) -> Array:
        """Return the true positions of points whose nominal positions are given. The given array and the
        result have shape (n, 2), with columns x and y.
        """
        return points + np.stack(self.shift(*points.T), axis=1)

    def undo(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the nominal positions (x, y) of the points whose true positions are given. This method
        inverts ``straighten`` by iteration, which converges if ``slope`` is below 1.
        """
        at_x, at_y = x, y
        for _ in range(_STEPS):
            shift_x, shift_y = self.shift(at_x, at_y)
            step = np.hypot(x - shift_x - at_x, y - shift_y - at_y).max()
            at_x, at_y = x - shift_x, y - shift_y
            if not step > _SETTLED * self.half.min():
                break
        return at_x, at_y

    @property
    def largest(self) -> float:
        """Return the longest displacement in the frame."""
        return float(np.hypot(*self._field()).max())

    @property
    def slope(self) -> float:
        """Return the largest change of the displacement per unit of length in the frame.

        The change at a point is the spectral norm of the displacement's gradient. It bounds the local stretch
        and rotation. A bend with a slope of 1 or more may fold the scan.
        """
        # The gradient is computed by differences on a grid. The differences are exact for a quadratic bend,
        # and accurate to a thousandth for creep.
        spacing = 2 * self.half[::-1] / (_GRID - 1)
        gradient = np.array([np.gradient(one, *spacing, edge_order=2) for one in self._field()])
        return float(np.linalg.norm(np.moveaxis(gradient, (0, 1), (-2, -1)), ord=2, axis=(-2, -1)).max())

    def _field(self) -> tuple[Array, Array]:
        """Return the displacements along x and along y on a regular grid over the frame."""
        unit = np.linspace(-1, 1, _GRID)
        return self.shift(*np.meshgrid(*(self.middle[:, None] + self.half[:, None] * unit)))

    @property
    def kind(self) -> str:
        """Return the kind of the bend, ``quadratic`` or ``creep``."""
        return "quadratic" if self.degree == 2 else "creep"

    @property
    def degree(self) -> int:
        """Return the degree of the polynomial: 2, or 6 for creep."""
        return 2 if self.amount.shape[1] == _QUADRATIC_TERMS else CREEP_DEGREE

    def unit(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the coordinates u and v of points at the positions (x, y)."""
        return (x - self.middle[0]) / self.half[0], (y - self.middle[1]) / self.half[1]


def _terms(u: Array, v: Array, degree: int) -> list[Array]:
    terms = [u * u - 1 / 3, u * v, v * v - 1 / 3]
    for k in range(3, degree + 1):
        terms += [np.polynomial.legendre.legval(one, [0.0] * k + [1.0]) for one in (u, v)]
    return terms


def fit_bent_affine(
    points: Array, images: Array, middle: Array, half: Array, degree: int = 2
) -> tuple[Array, Bend]:
    """Fit, by least squares, an affine map and a bend that together map points to given positions.

    The model is ``images`` ≈ affine(``points`` + bend(``points``)).

    Args:
        points: positions (x, y), shape (n, 2).
        images: the positions to which the points are mapped, shape (n, 2).
        middle, half: centre (x, y) and half the size (x, y) of the bend's frame.
        degree: degree of the bend's polynomial: 2 for a quadratic bend, 6 for creep.

    Returns:
        The 3×3 matrix of the affine map, and the fitted bend.

    Raises:
        numpy.linalg.LinAlgError: the points do not determine all coefficients, because they are too few or
            lie on a conic section, such as a line; or the positions in ``images`` lie on a line.
    """
    u, v = ((points - middle) / half).T
    basis = np.stack([np.ones_like(u), u, v, *_terms(u, v, degree)], axis=1)
    coefficients, _, rank, _ = np.linalg.lstsq(basis, images, rcond=None)
    if rank < basis.shape[1]:
        raise np.linalg.LinAlgError(f"the {len(points)} points do not determine an affine map and a bend")
    matrix = np.eye(3)
    matrix[:2, :2] = coefficients[1:3].T / half
    matrix[:2, 2] = coefficients[0] - matrix[:2, :2] @ middle
    return matrix, Bend(np.linalg.solve(matrix[:2, :2], coefficients[3:].T), middle, half)
