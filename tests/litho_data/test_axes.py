"""Test axes, signs and half-pixel offsets on grids where an error in any of them is noticed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from litho_data.foundation.grid import PixelGrid
from litho_data.foundation.units import um_per
from litho_data.register.bend import Bend
from litho_data.register.geometry import (
    ORIENTATIONS,
    apply_transform,
    index_to_um,
    orient,
    orientation_matrix,
)
from litho_data.register.scan import _Case, centred_placement
from litho_data.virtual_fab.canvas import GUARD_PX, Canvas, cut_layout, frame_layout
from tests.grids import SHAPES, UNEQUAL


@pytest.mark.parametrize("shape", SHAPES)
def test_a_canvas_surrounds_its_layout_and_the_layout_is_centred_on_its_place(shape: tuple[int, int]) -> None:
    pitch_um, place_um = 0.13, (7.0, -3.0)
    layout = np.arange(np.prod(shape)).reshape(shape) % 13
    canvas = Canvas(frame_layout(layout), pitch_um, place_um, 100.0)
    assert np.array_equal(cut_layout(canvas.level), layout)
    assert canvas.size_um == pytest.approx((shape[0] * pitch_um, shape[1] * pitch_um))
    inside = slice(GUARD_PX, -GUARD_PX)
    grid = PixelGrid.square(shape, pitch_um)
    np.testing.assert_allclose(canvas.y_um[inside, 0], grid.y_um, atol=1e-12)
    np.testing.assert_allclose(canvas.x_um[0, inside], grid.x_um, atol=1e-12)
    for axis, offset in enumerate(canvas.field_offset_um()):
        along = np.ravel(offset)[inside]
        # The pixel centres are symmetric about the centre of the layout, which lies at its place.
        assert along.mean() == pytest.approx(place_um[axis], abs=1e-12)
        assert along[-1] - along[0] == pytest.approx((shape[axis] - 1) * pitch_um)


@pytest.mark.parametrize("name", UNEQUAL)
def test_a_grid_ends_at_the_outer_edges_of_its_pixels(name: str) -> None:
    grid = UNEQUAL[name]
    for centres, axis in ((grid.y_um, 0), (grid.x_um, 1)):
        edges = centres[[0, -1]] + np.array([-0.5, 0.5]) * grid.pitch_um[axis]
        wanted = grid.origin_um[axis] + np.array([0, grid.size_um[axis]])
        np.testing.assert_allclose(edges, wanted, atol=1e-12)
        assert len(centres) == grid.shape[axis]


@pytest.mark.parametrize("name", UNEQUAL)
def test_the_middle_of_a_scan_is_put_on_the_middle_of_its_layout(name: str) -> None:
    scan, layout_shape, layout_pitch_um = UNEQUAL[name], (31, 70), 0.1
    matrix = centred_placement(scan.shape, scan.pitch_um, layout_shape, layout_pitch_um)
    middle = np.array([[scan.size_um[1] / 2, scan.size_um[0] / 2]])
    np.testing.assert_allclose(
        apply_transform(matrix, middle)[0],
        [layout_shape[1] * layout_pitch_um / 2, layout_shape[0] * layout_pitch_um / 2],
    )


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("shape", SHAPES)
def test_the_matrix_of_an_orientation_says_where_each_pixel_goes(
    orientation: str, shape: tuple[int, int]
) -> None:
    image = np.arange(np.prod(shape)).reshape(shape)
    rows, columns = np.indices(shape)
    places = np.stack([columns.ravel(), rows.ravel()], axis=1)
    x, y = np.rint(apply_transform(orientation_matrix(orientation, shape), places)).astype(int).T
    assert np.array_equal(orient(image, orientation)[y, x], image.ravel())


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize(
    ("shape", "pitch_um"), [((40, 75), (0.13, 0.08)), ((75, 40), (0.08, 0.13)), ((90, 41), (0.11, 0.2))]
)
def test_a_bend_read_from_the_store_equals_the_one_that_registration_found(
    orientation: str, shape: tuple[int, int], pitch_um: tuple[float, float]
) -> None:
    """Check that the store contains the bend that registration finds.

    Registration finds the bend in the re-oriented scan, but the store states it for the raw scan.
    """
    layout_pitch_um = 0.1
    case = _Case(np.zeros(shape), np.zeros((50, 62), int), pitch_um, layout_pitch_um, 0, None, {})
    ny, nx = (round(n * p / layout_pitch_um) for n, p in zip(shape, pitch_um, strict=True))
    turned = orient(np.zeros((ny, nx)), orientation).shape
    bend = Bend.none_yet((turned[0], turned[1]))
    # The bend is a few pixels at the border, and differs between x and y.
    bend = Bend(np.array([[2.0, 0.7, -1.1], [-0.4, 1.3, 0.9]]), bend.middle, bend.half)
    layout_to_oriented = np.array([[1.02, 0.01, 3.0], [-0.02, 0.97, -5.0], [0, 0, 1]])
    found = SimpleNamespace(layout_to_scan=layout_to_oriented, bend=bend)
    layout_to_scan, bend_um = case._in_um(
        cast(Any, SimpleNamespace(orientation=orientation)), cast(Any, found)
    )
    assert bend_um is not None
    stored = Bend.of_scan(bend_um.amount, shape, pitch_um)
    size_um = np.array([shape[1] * pitch_um[1], shape[0] * pitch_um[0]])
    points_um = np.random.default_rng(0).random((40, 2)) * size_um
    frame = index_to_um((layout_pitch_um, layout_pitch_um))
    oriented = apply_transform(
        orientation_matrix(orientation, (ny, nx)) @ np.linalg.inv(frame),
        points_um,
    )
    wanted = apply_transform(frame @ np.linalg.inv(layout_to_oriented), bend.straighten(oriented))
    got = apply_transform(np.linalg.inv(layout_to_scan), stored.straighten(points_um))
    # Each of six coefficients is rounded to a millionth of a micrometre and has a weight of at most 1.
    np.testing.assert_allclose(got, wanted, atol=6e-6)


def test_units_are_powers_of_ten_of_the_metre() -> None:
    powers = {"k": 3, "": 0, "d": -1, "c": -2, "m": -3, "u": -6, "µ": -6, "n": -9, "p": -12}
    for prefix, power in powers.items():
        assert um_per(f"{prefix}m") == pytest.approx(10.0 ** (power + 6), rel=1e-15)
    assert um_per("Å") == um_per("angstrom") == pytest.approx(1e-4, rel=1e-15)
    assert um_per("micron") == 1
    assert um_per("metre") == 1e6
