"""Check, on the grids of ``tests/grids.py``, that swapping the axes of the input swaps those of the result.

A function that treats both axes alike returns the transposed result for a transposed field. A function that
uses a pitch, a size or a position of the wrong axis does not, because the fields and pixels are not square.
Positions are checked by other tests; here, they are checked only for functions that resample.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from litho_data.foundation.grid import PixelGrid
from litho_data.making.contour import coverage
from litho_data.register.resample import resample_to_layout
from litho_data.register.topography import predicted_topography, remove_bow
from litho_data.roughness import find_step, psd_along
from litho_data.tip.morphology import paraboloid_erosion
from litho_design.images.similarity import ssim_map
from litho_design.optics import ASMPropagator, RSPropagator
from litho_design.optics.far_field import FarFieldPropagator
from litho_design.optics.imaging import Blur, bin_pixels
from litho_models.effects import CATALOGUE, FieldContext, get_effect
from litho_models.fitting.crops import Window, cut
from litho_models.layers.gaussian import gaussian_blur
from litho_models.models import build_model
from litho_models.prediction.tiles import predict_field
from litho_models.scan_terms.term import TermPixels, smooth_shapes
from litho_models.scoring.shapes import edge_placement
from tests.grids import UNEQUAL
from tests.tensors import assert_close

Array = np.ndarray[Any, np.dtype[Any]]
Made = Callable[[Array, PixelGrid], Array]
# Half of it is shorter than the finest pitch. Rays of a longer wave would reach grazing incidence, and their
# kernel takes seconds.
WAVELENGTH_UM = 0.13


def exchanged(grid: PixelGrid) -> PixelGrid:
    """Return the grid with y and x swapped."""
    (ny, nx), (py, px), (y, x) = grid.shape, grid.pitch_um, grid.origin_um
    return PixelGrid((nx, ny), (px, py), (x, y))


def relief(grid: PixelGrid) -> Array:
    """Return heights (ny, nx) in µm that differ between the axes and have a steep part off the centre."""
    y, x = (grid.y_um - grid.y_um.mean())[:, None], (grid.x_um - grid.x_um.mean())[None, :]
    wave = 0.3 + 0.1 * np.sin(2.1 * y + 0.4) * np.cos(1.3 * x - 0.2) + 0.03 * y - 0.05 * x
    # The flank is smooth on all grids, because a wave of two pixels has no defined sign along an axis.
    return np.asarray(wave + 0.12 * np.tanh((0.7 - np.hypot(y - 0.6, 1.5 * (x + 0.4))) / 0.25))


def with_gap(height: Array) -> Array:
    return np.where((height > 0.45) & (height < 0.5), np.nan, height)


def by_torch(run: Callable[[torch.Tensor], torch.Tensor]) -> Made:
    return lambda height, grid: run(torch.from_numpy(height)[None, None])[0, 0].numpy()


def light(propagator: Any, distance_um: float) -> Made:
    """Return a function that propagates light from a relief to another, displaced grid and back."""

    def made(height: Array, grid: PixelGrid) -> Array:
        (ny, nx), (py, px), (y, x) = grid.shape, grid.pitch_um, grid.origin_um
        times = 1.0 if propagator is ASMPropagator else 0.5
        target = PixelGrid((ny // 2 + 3, nx // 2 + 3), (times * py, times * px), (y + 0.5, x + 0.5))
        run = propagator(grid, target, distance_um, WAVELENGTH_UM, dtype=torch.complex128)
        field = torch.from_numpy(np.exp(2j * np.pi * height))
        return np.asarray((run.adjoint(run(field)) + 0j).numpy())

    return made


def printed(height: Array, grid: PixelGrid) -> Array:
    """Predict a print in tiles. The last tiles are narrower than the others."""
    facts = {"pitch_um": 0.1, "level_height_um": 0.1, "levels": 13}
    model = build_model("affine-mtf", sigmas_um=(0.25,), **facts)
    layout = torch.from_numpy(height).float()[None, None]
    return np.asarray(predict_field(model, layout, tile_px=17)[0, 0].detach().numpy())


def imaged(height: Array, grid: PixelGrid) -> Array:
    """Blur heights with a spot that is sampled at the pitch of each axis."""
    rows, columns = (np.arange(-k, k + 1) * pitch for k, pitch in zip((4, 4), grid.pitch_um, strict=True))
    spot = np.exp(-(rows[:, None] ** 2 + columns[None, :] ** 2) / 0.1)
    blur = Blur(torch.from_numpy(spot), grid.shape)
    return np.asarray(blur.transpose(blur.forward(torch.from_numpy(height))).numpy())


MAPS: dict[str, Made] = {
    "a surface under a tip": lambda height, grid: (
        paraboloid_erosion(with_gap(height), grid.pitch_um, 3.0).surface
    ),
    "a bow removed": lambda height, grid: remove_bow(height),
    "an expected topography": lambda height, grid: predicted_topography(height, 1.7),
    "coverage by a contour": lambda height, grid: coverage(height - 0.4, 0.1),
    "a Gaussian blur": by_torch(lambda height: gaussian_blur(height, 0.21, 0.1)),
    "a print in tiles": printed,
    "a crop over the corner": lambda height, grid: cut(
        height, Window(0, grid.shape[0] - 9, grid.shape[1] - 9, 16), 5
    ),
    "light, by rays": light(ASMPropagator, 3.0),
    "light, summed": light(RSPropagator, 22.0),
    "a far field": light(FarFieldPropagator, 60.0),
    "an image": imaged,
    "coarse pixels": by_torch(lambda height: bin_pixels(height[..., :32, :32], 4)),
    "likeness of images": lambda height, grid: ssim_map(height, with_steps(height)),
}


def with_steps(height: Array) -> Array:
    return np.asarray(np.round(height, 1))


@pytest.mark.parametrize("name", UNEQUAL)
@pytest.mark.parametrize("made", MAPS)
def test_swapping_the_axes_of_a_field_swaps_those_of_the_map(made: str, name: str) -> None:
    grid = UNEQUAL[name]
    height = relief(grid)
    here = MAPS[made](height, grid)
    there = MAPS[made](np.ascontiguousarray(height.T), exchanged(grid))
    # The terms of sums are added in a different order, at worst in float32.
    np.testing.assert_allclose(there, here.T, rtol=1e-4, atol=1e-5 * np.nanmax(np.abs(here)))


Along = Callable[[Array, PixelGrid, int], Any]


def step_height(height: Array, grid: PixelGrid, axis: int) -> Any:
    along = np.arange(grid.shape[axis]) * grid.pitch_um[axis]
    ridge = 0.3 * (np.abs(along - 0.4 * along[-1]) < 0.2 * along[-1])
    made = 0.01 * height + (ridge[:, None] if axis == 0 else ridge)
    found = find_step(made, grid.pitch_um[axis], axis="yx"[axis])
    return found.height_nm, found.line_sd_nm, found.lines


def slopes(height: Array, grid: PixelGrid, axis: int) -> Any:
    found = TermPixels(height).slopes[axis].reshape(height.shape)
    return found if axis else found.T


def smooth_terms(height: Array, grid: PixelGrid, axis: int) -> Any:
    x, y, xx, xy, yy = smooth_shapes(height.shape)
    return (x, xx, xy) if axis else (y.T, yy.T, xy.T)


ALONG: dict[str, Along] = {
    "power": lambda height, grid, axis: psd_along(height, grid.pitch_um[axis], "yx"[axis]).density,
    "a step": step_height,
    "slope of a print": slopes,
    "smooth terms of a scan": smooth_terms,
}


@pytest.mark.parametrize("name", UNEQUAL)
@pytest.mark.parametrize("figure", ALONG)
def test_a_result_along_y_equals_that_along_x_of_the_transposed_field(figure: str, name: str) -> None:
    grid, height = UNEQUAL[name], relief(UNEQUAL[name])
    along_y = ALONG[figure](height, grid, 0)
    along_x = ALONG[figure](np.ascontiguousarray(height.T), exchanged(grid), 1)
    np.testing.assert_allclose(along_x, along_y, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", UNEQUAL)
def test_swapping_the_axes_of_prints_keeps_the_distances_of_edges(name: str) -> None:
    height = relief(UNEQUAL[name])
    moved = np.roll(height, 1, axis=0)
    one, other = (
        edge_placement(a, b, np.array([0.5]), 0.1) for a, b in ((height, moved), (height.T, moved.T))
    )
    assert other.matched == one.matched > 0
    assert (other.mean_nm, other.p95_nm) == (pytest.approx(one.mean_nm), pytest.approx(one.p95_nm))


# Effects of the microscope. Its lines lie along x, whatever the direction of the printer.
SCANNED = {"feedback-lag", "piezo-nonlinearity", "tip-dilation"}
EFFECTS = [name for name, one in CATALOGUE.items() if not one.per_scan and name not in SCANNED]


def of_other_axis(parameter: str) -> str:
    for one, other in (("_x_", "_y_"), ("_y_", "_x_")):
        if one in parameter:
            return parameter.replace(one, other)
    return parameter


@pytest.mark.parametrize("name", UNEQUAL)
@pytest.mark.parametrize("effect", EFFECTS)
def test_swapping_the_axes_of_a_print_swaps_those_of_the_effect(effect: str, name: str) -> None:
    """The tested field is part of a scan away from the centre of the write field, with lines along y."""
    grid, one = UNEQUAL[name], get_effect(effect)
    numbers = {
        parameter: facts.typical * (1 + 0.2 * number)
        for number, (parameter, facts) in enumerate(one.parameters.items())
        # A shear needs a direction, which a Fourier transform does not have for a wave of two pixels.
        if facts.kind == "amplitude" and parameter != "shear_um2"
    }
    field = torch.from_numpy(relief(grid))[None, None]
    if one.of_films:
        # A film is either present or absent. Its rim says where in a pixel its edge lies; without a rim, two
        # edges would often be equally near, and which of them counts would depend on the order of the axes.
        field = 1.2 * torch.sigmoid(40 * (field - field.mean()))
    (ny, nx), place, corner = grid.shape, (11.0, -23.0), (5, 9)
    here = FieldContext(field, 0.1, 1.2, 0.1, place, 60.0, "y", 0.3, (ny + 30, nx + 17), corner)
    there = FieldContext(
        field.mT, 0.1, 1.2, 0.1, place[::-1], 60.0, "x", 0.3, (nx + 17, ny + 30), corner[::-1]
    )
    turned = {of_other_axis(parameter): value for parameter, value in numbers.items()}
    if "stretch_um2" in turned:
        # The effect adds as much along x as it subtracts along y.
        turned["stretch_um2"] *= -1
    changed = one(field, numbers, here)
    assert not torch.allclose(changed, field, rtol=0, atol=1e-6)
    assert_close(one(field.mT, turned, there).mT, changed, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", UNEQUAL)
def test_a_resampled_height_is_that_at_the_pixel_s_place(name: str) -> None:
    grid, shape, pitch_um, shift_um = UNEQUAL[name], (41, 30), 0.09, (0.31, -0.12)

    def height(y: Array, x: Array) -> Array:
        return np.asarray(0.2 * np.sin(1.1 * y)[:, None] + 0.3 * np.cos(0.8 * x)[None, :])

    # The origin of the frame of a scan is its corner.
    own = PixelGrid(grid.shape, grid.pitch_um)
    matrix = np.array([[1, 0, shift_um[1]], [0, 1, shift_um[0]], [0, 0, 1.0]])
    found, valid = resample_to_layout(
        height(own.y_um, own.x_um), matrix, shape, scan_pitch_um=own.pitch_um, layout_pitch_um=pitch_um
    )
    layout = PixelGrid.square(shape, pitch_um)
    wanted = height(layout.y_um - shift_um[0], layout.x_um - shift_um[1])
    # A scan finer than the layout is averaged over the layout's pixels, and mirrored beyond its edge.
    inside = binary_erosion(valid, iterations=6)
    assert inside.sum() > 100
    # Cubic splines at 60 pixels per wave are accurate, but averaging lowers the wave by (k σ)² / 2.
    np.testing.assert_allclose(found[inside], wanted[inside], atol=5e-4)
