"""Test laws of levelling: closed forms, repetition, transposition, units, masks and missing pixels."""

from __future__ import annotations

import warnings
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from litho_data.foundation.errors import InputError
from litho_data.level import (
    LevellingWarning,
    Recipe,
    align_rows,
    fix_zero,
    level_facet,
    level_plane,
    level_polynomial,
    level_robust,
    mask_and_relevel,
    zero_max,
    zero_mean,
)
from litho_data.level.rows import RowMethod

pytestmark = pytest.mark.filterwarnings("ignore::litho_data.level.LevellingWarning")
PITCH_UM = (0.1, 0.07)
SHAPES = st.tuples(st.integers(8, 24), st.integers(8, 24))
SLOPES = st.floats(-0.1, 0.1, allow_subnormal=False)
SEEDS = st.integers(0, 2**32 - 1)
ROW_METHODS = get_args(RowMethod)
# Cumulative sums and least squares over a few hundred pixels are exact to this fraction of the range.
ROUNDING = 1e-11

WHOLE_SURFACE = {
    "plane": lambda z, **kw: level_plane(z, **kw),
    "facet": lambda z, **kw: level_facet(z, pitch_um=PITCH_UM, **kw),
    "polynomial": lambda z, **kw: level_polynomial(z, x_degree=2, y_degree=3, **kw),
    "total": lambda z, **kw: level_polynomial(z, total_degree=3, **kw),
    "robust": lambda z, **kw: level_robust(z, **kw),
    "mask-and-relevel": lambda z, **kw: mask_and_relevel(z, **kw).levelled,
    "fix-zero": fix_zero,
    "zero-mean": zero_mean,
    "zero-max": zero_max,
}
ROWS = {
    f"rows-{name}": (lambda z, name=name, **kw: align_rows(z, method=name, pitch_um=PITCH_UM, **kw))
    for name in ROW_METHODS
}
ALL = WHOLE_SURFACE | ROWS


def ramp(shape: tuple[int, int], constant: float, slope_x: float, slope_y: float) -> np.ndarray:
    return constant + slope_x * np.arange(shape[1])[None, :] + slope_y * np.arange(shape[0])[:, None]


def rough(shape: tuple[int, int], seed: int) -> np.ndarray:
    """Return a noisy smooth surface that is about 1 µm high."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    a = rng.normal(size=6)
    smooth = a[0] + a[1] * x + a[2] * y + a[3] * x * y + a[4] * x**2 + a[5] * np.sin(3 * y)
    return 0.2 * smooth + 0.01 * rng.normal(size=shape)


@settings(deadline=None, max_examples=30)
@given(shape=SHAPES, constant=SLOPES, slope_x=SLOPES, slope_y=SLOPES)
def test_a_plane_is_removed_in_closed_form(
    shape: tuple[int, int], constant: float, slope_x: float, slope_y: float
) -> None:
    z = ramp(shape, constant, slope_x, slope_y)
    atol = ROUNDING * max(np.abs(z).max(), 1e-30)
    # The pivot (nx/2, ny/2) lies half a pixel from the centre, so the mean changes by (bx + by) / 2.
    pivot = constant + slope_x * shape[1] / 2 + slope_y * shape[0] / 2
    levelled = level_plane(z)
    np.testing.assert_allclose(levelled.height, pivot, rtol=0, atol=atol)
    assert levelled.height.mean() == pytest.approx(z.mean() + 0.5 * (slope_x + slope_y), abs=atol)
    for levelled in (level_polynomial(z, total_degree=1), level_polynomial(z), level_robust(z)):
        np.testing.assert_allclose(levelled.height, 0.0, rtol=0, atol=atol)


@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.02, -0.03), (0.0, 0.1), (0.0, 0.0)])
def test_the_facet_of_a_plane_is_the_plane(slope_x: float, slope_y: float) -> None:
    z = ramp((20, 30), 0.3, slope_x * PITCH_UM[1], slope_y * PITCH_UM[0])
    # The iteration stops when the slope changes by less than sqrt(1e-9). The field is 3 µm wide.
    assert np.ptp(level_facet(z, pitch_um=PITCH_UM).height) < 1e-4 * 3


def test_four_cells_are_enough_for_a_facet_and_three_are_not() -> None:
    z = ramp((3, 3), 0.3, 0.002, -0.003)
    assert np.ptp(level_facet(z, pitch_um=PITCH_UM).height) < 1e-4
    with pytest.raises(InputError, match="3 cells"):
        level_facet(z[:2, [0, 1, 2, 2]], pitch_um=PITCH_UM)


def test_facet_levelling_follows_terraces_and_ignores_their_steps() -> None:
    terraces = 0.1 * np.repeat(np.arange(6), 10)[None, :] + np.zeros((40, 1))
    tilted = terraces + ramp(terraces.shape, 0.0, 0.02 * PITCH_UM[1], -0.05 * PITCH_UM[0])
    once = level_facet(tilted, pitch_um=PITCH_UM)
    # Slopes are exact to sqrt(1e-9). A least-squares plane would mistake the staircase for a slope.
    atol = np.sqrt(1e-9) * (60 * PITCH_UM[1] + 40 * PITCH_UM[0])
    np.testing.assert_allclose(once.height - once.height[0, 0], terraces, rtol=0, atol=atol)
    np.testing.assert_allclose(
        level_facet(once.height, pitch_um=PITCH_UM).height, once.height, rtol=0, atol=atol
    )
    assert np.ptp(level_plane(tilted).height - terraces) > 0.1


@settings(deadline=None, max_examples=25)
@given(seed=SEEDS, degrees=st.tuples(st.integers(0, 5), st.integers(0, 5)))
def test_a_polynomial_is_removed_whatever_its_coefficients(seed: int, degrees: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    y, x = np.linspace(-1, 1, 21)[:, None], np.linspace(-1, 1, 34)[None, :]
    z = np.polynomial.polynomial.polyval2d(
        *np.broadcast_arrays(x, y), rng.normal(size=(degrees[0] + 1, degrees[1] + 1))
    )
    mask = rng.random(z.shape) < 0.3
    for masking in ("ignore", "exclude", "include"):
        levelled = level_polynomial(z, x_degree=degrees[0], y_degree=degrees[1], mask=mask, masking=masking)
        # The fit to 30 % of the pixels has a condition number of up to 1e4, which multiplies rounding errors.
        np.testing.assert_allclose(levelled.height, 0.0, rtol=0, atol=1e-10 * max(1, np.abs(z).max()))


TWICE = [
    (name, masking)
    for name in ALL
    for masking in ("ignore", "exclude", "include")
    # Facet levelling converges only on surfaces with facets. With a mask, the weights of matching do not add
    # up to one.
    if "facet" not in name and (name != "rows-matching" or masking == "ignore")
]


@pytest.mark.parametrize(("name", "masking"), TWICE)
def test_levelling_a_second_time_changes_nothing(name: str, masking: str) -> None:
    # The field is so wide that any two rows share more than the minimum number of pixels.
    z = rough((24, 96), 1)
    mask = np.random.default_rng(2).random(z.shape) < 0.5
    once = ALL[name](z, mask=mask, masking=masking).height
    difference = ALL[name](once, mask=mask, masking=masking).height - once
    if name == "rows-polynomial":
        # This method adds back a mean that ignores the mask, so the mean height changes each time.
        difference -= difference.mean()
    # The robust fits stop at 1e-7 of the noise sigma of 0.1 µm. Rounding may change the marks of pixels near
    # the threshold.
    atol = {"robust": 1e-7, "mask-and-relevel": 1e-2}.get(name, ROUNDING)
    np.testing.assert_allclose(difference, 0.0, rtol=0, atol=atol)


@pytest.mark.parametrize("name", list(ALL))
def test_levelled_and_removed_surface_add_up_to_the_input(name: str) -> None:
    z = rough((20, 28), 3)
    mask = z > np.quantile(z, 0.8)
    levelled = ALL[name](z, mask=mask)
    np.testing.assert_array_equal(levelled.height, z - levelled.removed)
    assert np.isfinite(levelled.removed).all()


@pytest.mark.parametrize("name", [name for name in WHOLE_SURFACE if name != "facet"])
def test_rows_and_columns_are_treated_alike(name: str) -> None:
    z = rough((18, 26), 4)
    mask = z > np.quantile(z, 0.7)
    swap = {"polynomial": lambda z, **kw: level_polynomial(z, x_degree=3, y_degree=2, **kw)}
    turned = swap.get(name, WHOLE_SURFACE[name])(z.T, mask=mask.T)
    np.testing.assert_allclose(turned.height.T, WHOLE_SURFACE[name](z, mask=mask).height, rtol=0, atol=1e-8)


def test_facets_of_the_transpose() -> None:
    z = rough((18, 26), 4)
    straight = level_facet(z, pitch_um=PITCH_UM).height
    turned = level_facet(z.T, pitch_um=PITCH_UM[::-1]).height
    np.testing.assert_allclose(turned.T, straight, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("method", ROW_METHODS)
def test_vertical_alignment_is_horizontal_alignment_of_the_transpose(method: str) -> None:
    z = rough((18, 26), 5)
    mask = z > np.quantile(z, 0.6)
    kwargs = {"method": method, "mask": mask}
    vertical = align_rows(z, direction="vertical", pitch_um=PITCH_UM, **kwargs)
    kwargs["mask"] = mask.T
    horizontal = align_rows(z.T, pitch_um=PITCH_UM[::-1], **kwargs)
    np.testing.assert_array_equal(vertical.height, horizontal.height.T)


@settings(deadline=None, max_examples=10)
@given(seed=SEEDS, scale=st.floats(1e-3, 1e3), offset=st.floats(-10, 10))
@pytest.mark.parametrize(
    "name", [name for name in ALL if name not in ("rows-matching", "facet", "rows-facet-tilt")]
)
def test_levelling_commutes_with_a_change_of_unit_and_datum(
    name: str, seed: int, scale: float, offset: float
) -> None:
    """Check that level(a z + b) = a level(z) + c, where c is b or 0 depending on the operation."""
    z = rough((16, 20), seed)
    # Every row keeps some pixels. A row without any would follow Gwyddion's rule, which depends on the datum.
    mask = np.random.default_rng(seed).random(z.shape) < 0.25
    operate = ALL[name]
    expected = scale * operate(z, mask=mask).height
    scaled = operate(scale * z + offset, mask=mask).height
    keeps_datum = name == "plane" or name in ROWS
    atol = 1e-6 * scale if name in ("robust", "mask-and-relevel") else 1e-9 * (scale + abs(offset))
    np.testing.assert_allclose(scaled, expected + (offset if keeps_datum else 0.0), rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["plane", "polynomial", "total"])
def test_adding_a_plane_changes_at_most_a_constant(name: str) -> None:
    z = rough((20, 30), 6)
    tilted = WHOLE_SURFACE[name](z + ramp(z.shape, 0.5, 0.01, -0.02)).height
    difference = tilted - WHOLE_SURFACE[name](z).height
    assert np.ptp(difference) < ROUNDING
    if name != "plane":
        assert np.abs(difference).max() < ROUNDING


@pytest.mark.parametrize("name", list(ALL))
@pytest.mark.parametrize("masking", ["exclude", "include"])
def test_masked_pixels_do_not_matter(name: str, masking: str) -> None:
    """Check that the values of excluded pixels do not matter, except for a mean added to polynomial rows."""
    z = rough((20, 30), 7)
    rng = np.random.default_rng(8)
    left_out = rng.random(z.shape) < 0.2
    if (name, masking) == ("rows-matching", "include"):
        left_out[:, -1] = False  # Gwyddion ignores the mask in this column
    mask = left_out if masking == "exclude" else ~left_out
    spoiled = np.where(left_out, 50.0 * rng.normal(size=z.shape), z)
    before = ALL[name](z, mask=mask, masking=masking).removed
    after = ALL[name](spoiled, mask=mask, masking=masking).removed
    difference = after - before
    if name == "rows-polynomial":
        difference -= difference.mean()
    if name == "rows-matching":
        # As in Gwyddion, the curvature beside a masked pixel also affects the weights.
        assert np.abs(difference).max() < 1e-3
    else:
        np.testing.assert_allclose(difference, 0.0, rtol=0, atol=ROUNDING)


def test_matching_ignores_an_inclusion_mask_in_the_last_column_only() -> None:
    z = rough((20, 30), 7)
    chosen = np.random.default_rng(8).random(z.shape) < 0.8
    other = chosen.copy()
    other[:, -1] = ~chosen[:, -1]
    matched = [
        align_rows(z, method="matching", mask=mask, masking="include").height for mask in (chosen, other)
    ]
    np.testing.assert_array_equal(*matched)
    excluded = [align_rows(z, method="matching", mask=~mask).height for mask in (chosen, other)]
    assert np.abs(excluded[0] - excluded[1]).max() > 1e-6


def test_the_modus_of_a_row_does_not_depend_on_the_unit_of_the_file() -> None:
    """Check values of five digits, for which many windows are equally short. The unit must not decide which
    of them is used.
    """
    digits = np.random.default_rng(3).integers(10000, 99999, (40, 300))
    from_metres = np.array([[float(f"{n}e-11") for n in row] for row in digits]) * 1e6
    from_um = np.array([[float(f"{n}e-5") for n in row] for row in digits])
    assert (from_metres != from_um).any()
    moved = align_rows(from_metres, method="modus").height - align_rows(from_um, method="modus").height
    assert np.abs(moved).max() < 1e-12


@pytest.mark.parametrize("slope", [0.02, -0.3])
def test_facet_tilt_levels_rows_whose_facets_are_flat(slope: float) -> None:
    """Check that the tilt of rows with terraces is removed, and that their steps remain."""
    terraces = np.repeat(np.cumsum(np.random.default_rng(2).choice([-1.0, 1.0], (6, 12)), axis=1), 25, axis=1)
    row = (np.arange(300) - 149.5) * slope * PITCH_UM[1]
    levelled = align_rows(terraces + row, method="facet-tilt", pitch_um=PITCH_UM)
    # The iteration ends when the slope changes by less than 1e-6.
    np.testing.assert_allclose(levelled.height, terraces, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", list(ALL))
def test_missing_pixels_are_left_out_and_stay_missing(name: str) -> None:
    z = rough((20, 30), 9)
    missing = np.random.default_rng(10).random(z.shape) < 0.05
    holed = np.where(missing, np.nan, z)
    levelled = ALL[name](holed)
    np.testing.assert_array_equal(np.isnan(levelled.height), missing)
    assert np.isfinite(levelled.removed).all()
    masked = ALL[name](z, mask=missing)
    difference = levelled.removed - masked.removed
    if name == "rows-polynomial":
        difference -= difference.mean()  # this method adds back the mean of all measured pixels
    if name != "rows-matching":
        np.testing.assert_allclose(difference, 0.0, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("method", [name for name in ROW_METHODS if name not in ("facet-tilt", "modus")])
def test_row_offsets_are_recovered(method: str) -> None:
    """Check that every method removes the offsets of single rows."""
    rng = np.random.default_rng(11)
    offsets = rng.normal(size=40)
    offsets -= np.polynomial.Polynomial.fit(np.arange(40), offsets, 1)(np.arange(40))
    levelled = align_rows(np.repeat(offsets[:, None], 50, axis=1), method=method)
    np.testing.assert_allclose(levelled.height, 0.0, rtol=0, atol=1e-12)


def test_differences_keep_the_slow_slope_and_means_remove_it() -> None:
    z = ramp((40, 50), 0.0, 0.0, 0.01)
    kept = align_rows(z, method="median-of-differences").height
    np.testing.assert_allclose(kept, z, rtol=0, atol=1e-12)
    assert np.ptp(align_rows(z, method="median").height) < 1e-12


def test_rows_without_selected_pixels_take_the_overall_median() -> None:
    z = rough((20, 30), 12)
    mask = np.zeros(z.shape, dtype=bool)
    mask[3] = True
    shifts = align_rows(z, method="median", mask=mask).removed[:, 0]
    values = np.sort(z[~mask])
    expected = np.array([np.sort(row)[15] for row in z])
    expected[3] = values[values.size // 2]
    np.testing.assert_allclose(shifts, expected - expected.mean(), rtol=0, atol=1e-15)


def test_median_is_exact_where_float32_cannot_tell_values_apart() -> None:
    rng = np.random.default_rng(13)
    z = 1.0 + 1e-12 * rng.integers(0, 50, size=(30, 41))
    medians = np.sort(z, axis=1)[:, 20]
    removed = align_rows(z, method="median").removed[:, 0]
    np.testing.assert_array_equal(removed, medians - medians.mean())


@pytest.mark.parametrize(
    ("operate", "message"),
    [
        (lambda z: level_plane(z, mask=np.ones(z.shape, bool)), "no pixel is left"),
        (lambda z: level_plane(z, mask=np.ones(z.shape)), "mask, got float64"),
        (lambda z: level_plane(z, mask=np.ones((2, 2), bool)), "wanted bool"),
        (lambda z: level_plane(z, masking="use"), "masking"),
        (lambda z: level_plane(z, mask=np.arange(z.size).reshape(z.shape) >= z.shape[1]), "do not determine"),
        (lambda z: level_polynomial(z, x_degree=12), "degree"),
        (lambda z: level_polynomial(np.full(z.shape, np.nan)), "no pixel is left"),
        (
            lambda z: level_facet(z, pitch_um=PITCH_UM, mask=np.indices(z.shape).sum(0) % 2 == 0),
            "facet levelling",
        ),
        (lambda z: align_rows(z, method="mode"), "align-rows, got method"),
        (lambda z: align_rows(z, degree=6), "degree"),
        (lambda z: align_rows(z, trim=0.6), "trim"),
        (lambda z: align_rows(z, method="facet-tilt"), "pitch"),
        (lambda z: level_plane(z[0]), "shape"),
    ],
)
def test_what_cannot_be_levelled_is_refused(operate, message: str) -> None:
    with pytest.raises(InputError, match=message):
        operate(rough((12, 14), 14))


@pytest.mark.parametrize("method", ["median", "median-of-differences", "trimmed-mean", "matching"])
@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_row_alignment_warns_where_a_block_moves_lines(method: str, direction: str) -> None:
    """Check the warning about lines in which a block covers 55 % of the pixels.

    Row alignment shifts these lines, although the other 45 % of their pixels are at the right height.
    """
    rng = np.random.default_rng(0)
    offsets = 0.05 * rng.standard_normal((128, 1))
    z = 0.003 * rng.standard_normal((128, 128)) + offsets
    recipe = Recipe.from_dict({"step": [{"op": "align-rows", "method": method, "direction": direction}]})
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # large offsets of whole lines cause no warning
        recipe.apply(z if direction == "horizontal" else z.T)
    z[30:90, 20:90] += 0.8
    with pytest.warns(
        LevellingWarning, match=r"0\.[4-9]\d* µm, although \d\d% of a line's pixels had no offset"
    ):
        recipe.apply(z if direction == "horizontal" else z.T)
