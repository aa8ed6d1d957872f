"""A bent scan: the smooth, quadratic difference between the true and the stated position of the scanner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from litho_data.foundation.kinds import YX, Array, Shape

_ITERATIONS = 30
_QUADRATIC_TERMS = 3
CREEP_DEGREE = 6
# As a share of the half width of the scan: far below a thousandth of a pixel.
_SETTLED = 1e-9


@dataclass(frozen=True)
class Bend:
    """Displacement of the points of a scan, a polynomial of u and v, which run from -1 to 1 over the frame.

    ``amount`` is (2, 3): along x and y, for u² - 1/3, uv and v² - 1/3; or (2, 11) for a scanner that creeps,
    followed by the Legendre polynomials P₃(u), P₃(v), P₄(u), … P₆(v). These terms are centred: the best
    affine part of a bend over the frame is zero. ``middle`` and ``half`` are the frame's centre and half its
    size (x, y), in the unit of ``amount``; u = (x - middle) / half.
    """

    amount: Array
    middle: Array
    half: Array

    @classmethod
    def of_scan(cls, amount_um: Array, scan_shape: Shape, scan_pitch_um: YX) -> Bend:
        """The bend of a scan with (ny, nx) pixels and this (y, x) pitch, in µm of its own frame."""
        half_um = np.array([scan_shape[1] * scan_pitch_um[1], scan_shape[0] * scan_pitch_um[0]]) / 2
        return cls(np.asarray(amount_um, dtype=float), half_um, half_um)

    @property
    def figures(self) -> dict[str, float]:
        """The bend for the quality record: its largest displacement and its six coefficients, µm.

        ``bend_x_by_xx_um`` is the displacement along x per u² - 1/3, and so on.
        """
        names = [f"bend_{axis}_by_{term}_um" for axis in "xy" for term in ("xx", "xy", "yy")]
        values = (float(value) for value in self.amount[:, :3].ravel())
        return {"bend_um": self.largest, **dict(zip(names, values, strict=True))}

    @classmethod
    def none_yet(cls, shape: Shape) -> Bend:
        """A straight scan of this (ny, nx) shape, in its index frame."""
        ny, nx = shape
        return cls(np.zeros((2, 3)), np.array([nx - 1, ny - 1]) / 2, np.array([nx, ny]) / 2)

    def in_pixels(self, pitch_um: YX) -> Bend:
        """A bend in µm as one in the index frame of a scan of this (y, x) pitch."""
        pitch_x_y = np.array(pitch_um[::-1])
        return Bend(self.amount / pitch_x_y[:, None], self.middle / pitch_x_y - 0.5, self.half / pitch_x_y)

    def scaled(self, factor: float) -> Bend:
        """The same bend in a unit ``1 / factor`` times as long."""
        return Bend(self.amount * factor, self.middle * factor, self.half * factor)

    def shift(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distance (along x, along y) of points of the scan from their nominal position."""
        terms = _terms(*self.unit(x, y), self.degree)
        along_x, along_y = (sum(a * term for a, term in zip(row, terms, strict=True)) for row in self.amount)
        return along_x, along_y

    def straighten(self, points: Array) -> Array:
        """True positions of points (n, 2) of the scan."""
        return points + np.stack(self.shift(*points.T), axis=1)

    def undo(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The points of the scan with true position (x, y), by Newton's method for all points at once.

        For a position that no point has, the result lies far outside the frame.
        """
        at_x, at_y = (np.array(one, dtype=float) for one in np.broadcast_arrays(x, y))
        for _ in range(_ITERATIONS):
            shift_x, shift_y = self.shift(at_x, at_y)
            miss_x, miss_y = x - at_x - shift_x, y - at_y - shift_y
            (xx, xy), (yx, yy) = self._gradient(at_x, at_y)
            determinant = (1 + xx) * (1 + yy) - xy * yx
            with np.errstate(all="ignore"):
                step_x = ((1 + yy) * miss_x - xy * miss_y) / determinant
                step_y = ((1 + xx) * miss_y - yx * miss_x) / determinant
            open_ = ~((np.abs(step_x) < _SETTLED * self.half[0]) & (np.abs(step_y) < _SETTLED * self.half[1]))
            # At most half a frame per step: more than any accepted bend, and too short to diverge.
            at_x += np.clip(np.nan_to_num(step_x), -self.half[0], self.half[0])
            at_y += np.clip(np.nan_to_num(step_y), -self.half[1], self.half[1])
            if not open_.any():
                break
        outside = self.middle - 1e3 * self.half
        return np.where(open_, outside[0], at_x), np.where(open_, outside[1], at_y)

    @property
    def largest(self) -> float:
        """The longest displacement in the frame."""
        x, y = self._grid(33)
        return float(np.hypot(*self.shift(x, y)).max())

    @property
    def slope(self) -> float:
        """The largest local stretch or rotation of the bend, as a fraction; from 1 on it may fold."""
        # The gradient of a quadratic bend is linear, so it is largest in a corner; that of creep, at an end.
        gradient = np.array(self._gradient(*self._grid(2 if self.degree == 2 else 33)))
        return float(np.linalg.norm(np.moveaxis(gradient, (0, 1), (-2, -1)), ord=2, axis=(-2, -1)).max())

    def _grid(self, count: int) -> Array:
        unit = np.linspace(-1, 1, count)
        u, v = (one.ravel() for one in np.meshgrid(unit, unit))
        return self.middle[:, None] + self.half[:, None] * np.stack([u, v])

    @property
    def kind(self) -> str:
        """``quadratic`` or ``creep``."""
        return "quadratic" if self.degree == 2 else "creep"

    @property
    def degree(self) -> int:
        """Degree of the polynomial: 2, or 6 for creep."""
        return 2 if self.amount.shape[1] == _QUADRATIC_TERMS else CREEP_DEGREE

    def unit(self, x: Array, y: Array) -> tuple[Array, Array]:
        """(u, v) of points."""
        return (x - self.middle[0]) / self.half[0], (y - self.middle[1]) / self.half[1]

    def _gradient(self, x: Array, y: Array) -> tuple[tuple[Array, Array], ...]:
        """d(shift x)/dx, d(shift x)/dy; d(shift y)/dx, d(shift y)/dy."""
        u, v = self.unit(x, y)
        by_u = [2 * u, v, np.zeros_like(v)]
        by_v = [np.zeros_like(u), u, 2 * v]
        for k in range(3, self.degree + 1):
            slope = np.polynomial.legendre.Legendre.basis(k).deriv()
            by_u += [slope(u), np.zeros_like(v)]
            by_v += [np.zeros_like(u), slope(v)]
        return tuple(
            (
                sum(a * term for a, term in zip(row, by_u, strict=True)) / self.half[0],
                sum(a * term for a, term in zip(row, by_v, strict=True)) / self.half[1],
            )
            for row in self.amount
        )


def _terms(u: Array, v: Array, degree: int) -> list[Array]:
    terms = [u * u - 1 / 3, u * v, v * v - 1 / 3]
    for k in range(3, degree + 1):
        polynomial = np.polynomial.legendre.Legendre.basis(k)
        terms += [polynomial(u), polynomial(v)]
    return terms


def fit_bent_affine(
    points: Array, images: Array, middle: Array, half: Array, degree: int = 2
) -> tuple[Array, Bend]:
    """The affine (3×3) and the bend that take points (n, 2) to their images, by least squares.

    ``images`` ≈ affine(``points`` + bend(``points``)); ``middle`` and ``half`` are those of the bend's frame,
    ``degree`` is 2, or 6 for creep.

    Raises:
        numpy.linalg.LinAlgError: points that do not determine six coefficients per axis (too few, or all on
            one conic, as on a line), or images on a line.
    """
    u, v = ((points - middle) / half).T
    basis = np.stack([np.ones_like(u), u, v, *_terms(u, v, degree)], axis=1)
    coefficients, _, rank, _ = np.linalg.lstsq(basis, images, rcond=None)
    if rank < basis.shape[1]:
        raise np.linalg.LinAlgError(f"{len(points)} points do not determine an affine and a bend")
    matrix = np.eye(3)
    matrix[:2, :2] = coefficients[1:3].T / half
    matrix[:2, 2] = coefficients[0] - matrix[:2, :2] @ middle
    return matrix, Bend(np.linalg.solve(matrix[:2, :2], coefficients[3:].T), middle, half)
