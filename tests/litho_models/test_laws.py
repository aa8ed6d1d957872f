"""Compare laws and descriptions with their formulas, written independently in NumPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from litho_data.foundation.errors import InputError
from litho_models.effects import CATALOGUE, FieldContext, get_effect, in_forward_order, screened_effects
from litho_models.effects.laws import LAWS, TABLES
from litho_models.effects.registry import register_effect

PITCH_UM, SHAPE, FULL_UM = 0.1, (170, 168), 1.2
NAMELESS = {**LAWS, **TABLES}
BY_NAME = pytest.mark.parametrize("name", NAMELESS)
# The absolute value of a slope is smoothed below this slope, which changes it by at most this amount.
ROUNDED = 1e-3


def height_of(shape: tuple[int, int] = SHAPE, seed: int = 0) -> np.ndarray:
    """Return a smooth random height (y, x) in µm with a flat corner."""
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 4.0)
    height = 0.5 + 0.25 * smooth / smooth.std()
    height[:20, :20] = 0.5
    return height


HEIGHT = height_of()


def context_of(height: np.ndarray, pitch_um: float = PITCH_UM) -> FieldContext:
    layout = torch.from_numpy(np.round(np.clip(height, 0, FULL_UM), 1))[None, None]
    return FieldContext(layout, pitch_um, FULL_UM, order=0.3)


def changed(
    name: str, values: dict[str, float], height: np.ndarray, pitch_um: float = PITCH_UM
) -> np.ndarray:
    """Return the change (y, x) in µm that the effect makes to the height."""
    field = torch.from_numpy(height)[None, None]
    effect = NAMELESS.get(name) or get_effect(name)
    return (effect(field, values, context_of(height, pitch_um)) - field)[0, 0].numpy()


# The formulas use central differences for slopes, a Gaussian for means, and a running mean for sides.


def turned(axis: str, turn_deg: float, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the component along an axis, x or y, after both axes are rotated from x towards y."""
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return cosine * x + sine * y if axis == "x" else cosine * y - sine * x


def slope(h: np.ndarray, axis: str, turn_deg: float = 0.0) -> np.ndarray:
    padded = np.pad(h, 1, mode="edge")
    x = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * PITCH_UM)
    y = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * PITCH_UM)
    return turned(axis, turn_deg, y, x)


def mean_within(h: np.ndarray, reach_um: float) -> np.ndarray:
    return gaussian_filter(h, reach_um / PITCH_UM, mode="nearest", truncate=4)


def beside(h: np.ndarray, side: str, length_um: float) -> np.ndarray:
    """Return the running mean that starts at one side: y_i = y_(i-1) + (h_i - y_(i-1)) / (1 + l / dx)."""
    along = slice(None, None, -SIGNS[side])
    turned = h[:, along]
    found = turned.copy()
    for i in range(1, turned.shape[1]):
        found[:, i] = found[:, i - 1] + (turned[:, i] - found[:, i - 1]) / (1 + length_um / PITCH_UM)
    return found[:, along]


SIGNS = {"left": -1, "right": 1}


def tail(h: np.ndarray, sides: tuple[str, ...], length_um: float, turn_deg: float) -> np.ndarray:
    """Return the mean of the running means that start at these sides. Along a rotated axis, it is computed by
    Fourier transform.
    """
    if not turn_deg:
        return np.mean([beside(h, side, length_um) for side in sides], axis=0)
    edge = 6 * round(length_um / PITCH_UM)
    padded = np.pad(h, edge, mode="edge")
    fy, fx = np.meshgrid(*(np.fft.fftfreq(n, PITCH_UM) for n in padded.shape), indexing="ij")
    transfer = np.zeros(padded.shape, complex)
    for side in sides:
        delay = np.exp(2j * np.pi * SIGNS[side] * turned("x", turn_deg, fy, fx) * PITCH_UM)
        transfer += 1 / (1 + length_um / PITCH_UM * (1 - delay)) / len(sides)
    return np.fft.ifft2(np.fft.fft2(padded) * transfer).real[edge:-edge, edge:-edge]


Y, X = (np.linspace(-1, 1, n) for n in SHAPE)
PLACES = {"x": X[None, :] + 0 * Y[:, None], "y": Y[:, None] + 0 * X[None, :]}
PLACES["r2"] = PLACES["x"] ** 2 + PLACES["y"] ** 2
EDGE_PX = np.minimum(
    *np.meshgrid(*(np.minimum(np.arange(n), np.arange(n)[::-1]) for n in SHAPE), indexing="ij")
)
ORDER = 0.3


def rim(length_um: float) -> np.ndarray:
    return np.exp(-EDGE_PX * PITCH_UM / length_um)


def jump(axis: str, at: float) -> np.ndarray:
    """Return a step at a position between -1 and 1. It is 0 before the position, 1 after it, and a fraction
    in the pixel at the position.
    """
    size = SHAPE["yx".index(axis)]
    return np.clip((PLACES[axis] - at) * (size - 1) / 2 + 0.5, 0, 1)


# Each formula gives the change of a height for a strength of one and for the shapes of a law.
Formula = Callable[..., np.ndarray]


def formulas() -> dict[str, Formula]:
    found: dict[str, Formula] = {}
    for axis in ("x", "y"):
        found[f"slope-{axis}-power"] = lambda h, power, turn_deg, a=axis: (
            np.abs(slope(h, a, turn_deg)) ** power
        )
        found[f"rising-slope-{axis}"] = lambda h, turn_deg, a=axis: np.maximum(slope(h, a, turn_deg), 0)
        found[f"falling-slope-{axis}"] = lambda h, turn_deg, a=axis: np.maximum(-slope(h, a, turn_deg), 0)
        found[f"height-times-slope-{axis}"] = lambda h, a=axis: h * slope(h, a)
        found[f"height-times-slope-size-{axis}"] = lambda h, a=axis: h * np.abs(slope(h, a))
        found[f"curvature-{axis}"] = lambda h, a=axis: slope(slope(h, a), a)
        found[f"slope-size-{axis}-times-order"] = lambda h, a=axis: np.abs(slope(h, a)) * ORDER
        found[f"jump-along-{axis}-in-height"] = lambda h, position, a=axis: jump(a, position)
        found[f"jump-along-{axis}-in-gain"] = lambda h, position, a=axis: h * jump(a, position)
        for way in ("x", "y"):
            found[f"jump-along-{axis}-in-{way}"] = lambda h, position, a=axis, w=way: (
                slope(h, w) * jump(a, position)
            )
    for power in (2, 3):
        found[f"height-power-{power}"] = lambda h, p=power: h**p
    for place, own in PLACES.items():
        found[f"height-times-{place}"] = lambda h, p=own: h * p
        found[f"blur-times-{place}"] = lambda h, length_um=1.5, p=own: (mean_within(h, length_um) - h) * p
    found["height-times-rim"] = lambda h, length_um=1.5: h * rim(length_um)
    found["height-squared-times-order"] = lambda h: h**2 * ORDER
    found["steepness-power"] = lambda h, power: np.hypot(slope(h, "x"), slope(h, "y")) ** power
    found["surroundings"] = lambda h, length_um: mean_within(h, length_um) - h
    found["blur-height"] = lambda h, length_um: h * (mean_within(h, length_um) - h)
    found["dose-times-density"] = lambda h, length_um, power: (
        h * (mean_within(h, length_um) / FULL_UM) ** power
    )
    for name, sides in {"along": ("left", "right"), "from": ("left",)}.items():
        found[f"dose-{name}"] = lambda h, length_um, turn_deg, s=sides: tail(h, s, length_um, turn_deg) - h
    return found


FORMULAS = formulas()
WAVES = ("height-wave", "dose-wave")


def shapes_of(name: str) -> list[dict[str, float]]:
    """Return the shapes that screening tries. Add a shape in which any length that screening keeps fixed is
    doubled.
    """
    shapes = [{k: v for k, v in trial.items() if k != "strength"} for trial in LAWS[name].trials]
    untried = {k: 2 * one.typical for k, one in LAWS[name].parameters.items() if one.off and not one.tried}
    return list(map(dict, dict.fromkeys(tuple(one.items()) for one in (*shapes, {**shapes[0], **untried}))))


def test_every_law_has_a_formula_here() -> None:
    assert {*FORMULAS, *WAVES} == set(LAWS)
    assert len({law.title for law in LAWS.values()}) == len(LAWS)


@pytest.mark.parametrize("name", FORMULAS)
def test_a_law_adds_its_strength_times_its_formula(name: str) -> None:
    for shape in shapes_of(name):
        wanted = FORMULAS[name](HEIGHT, **shape)
        assert wanted.std() > 1e-3
        # The tolerance allows for rounding and for truncated kernels: a Gaussian after 4 sigma, a tail after
        # 6 lengths or at the end of the field, where it wraps around to the other side.
        allowed = 2 * ROUNDED
        if "length_um" in shape:
            steps = shape["length_um"] / PITCH_UM
            allowed += np.ptp(HEIGHT) * (steps / (1 + steps)) ** min(6 * steps, min(SHAPE) - 1)
        found = changed(name, {"strength": 0.05, **shape}, HEIGHT)
        np.testing.assert_allclose(found, 0.05 * wanted, atol=0.05 * allowed, rtol=1e-9)


@pytest.mark.parametrize("name", WAVES)
def test_a_wave_has_its_size_phase_and_period_and_is_zero_at_zero(name: str) -> None:
    wave = {"sine_um": 0.03, "cosine_um": 0.04, "frequency_per_um": 3.0}
    wanted = 0.05 * np.sin(2 * np.pi * 3 * HEIGHT + np.arctan2(0.04, 0.03)) - 0.04
    np.testing.assert_allclose(changed(name, wave, HEIGHT), wanted, atol=1e-9)
    np.testing.assert_allclose(changed(name, wave, 0 * HEIGHT), 0, atol=1e-12)


@BY_NAME
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_law_that_is_off_changes_no_bit_of_the_height(name: str, dtype: torch.dtype) -> None:
    height = torch.from_numpy(HEIGHT[:40, :44].copy()).to(dtype)[None, None]
    context = FieldContext(height.round(decimals=1), PITCH_UM, 1.2)
    assert torch.equal(NAMELESS[name](height, {}, context), height)


@BY_NAME
def test_a_flat_print_has_a_finite_derivative(name: str) -> None:
    height = torch.full((1, 1, 24, 20), 0.4, requires_grad=True)
    context = FieldContext(torch.full((1, 1, 24, 20), 0.4), PITCH_UM, 1.2, order=0.2)
    values = dict.fromkeys(NAMELESS[name].amplitudes, 0.1)
    NAMELESS[name](height, values, context).sum().backward()
    assert height.grad is not None
    assert torch.isfinite(height.grad).all()


POWERS_OF_UM = {"1": 0, "µm": 1, "µm²": 2, "1/µm": -1, "1/µm²": -2}


# Exclude laws with a fixed length or with a length in micrometres.
SCALED = [
    name
    for name in FORMULAS
    if "length_um" not in LAWS[name].parameters and name[:4] != "blur" and "rim" not in name
]


@pytest.mark.parametrize("name", SCALED)
def test_the_unit_of_a_strength_makes_its_change_a_height(name: str) -> None:
    """Check a unit that is half as large, so that all lengths double. The change of the height must double as
    well.
    """
    unit = LAWS[name].parameters["strength"].unit
    height = HEIGHT[:60, :64].copy()
    one = changed(name, {"strength": 0.05}, height)
    other = changed(name, {"strength": 0.05 * 2 ** POWERS_OF_UM[unit]}, 2 * height, 2 * PITCH_UM)
    np.testing.assert_allclose(other, 2 * one, atol=4 * 0.05 * ROUNDED)
    assert np.abs(one).max() > 2e-3


def test_a_table_of_one_height_is_a_datum_and_each_level_has_its_own() -> None:
    names = TABLES["level-table"].amplitudes
    np.testing.assert_allclose(changed("level-table", dict.fromkeys(names, 0.02), HEIGHT), 0.02, atol=1e-12)
    flat = np.full((30, 30), 0.6)
    for knot, name in enumerate(names):
        # 0.6 µm is the eighth of the sixteen steps of 1.2 µm.
        np.testing.assert_allclose(changed("level-table", {name: 0.02}, flat), 0.02 * (knot == 8), atol=1e-9)


def test_a_linear_response_takes_the_displaced_height_with_a_continued_edge() -> None:
    for name in TABLES["linear-response"].amplitudes:
        dy, dx = (round(float(part) / 1000 / PITCH_UM) for part in name.split("_")[1:3])
        padded = np.pad(HEIGHT, 6, mode="edge")
        there = padded[6 + dy : 6 + dy + SHAPE[0], 6 + dx : 6 + dx + SHAPE[1]]
        np.testing.assert_allclose(
            changed("linear-response", {name: 0.3}, HEIGHT), 0.3 * (there - HEIGHT), atol=1e-12
        )


def test_a_place_map_is_a_gain_that_varies_over_the_field() -> None:
    for name in TABLES["place-map"].amplitudes:
        i, j = (int(part[1:]) for part in name.split("_"))
        wanted = 0.1 * HEIGHT * PLACES["y"] ** i * PLACES["x"] ** j
        np.testing.assert_allclose(changed("place-map", {name: 0.1}, HEIGHT), wanted, atol=1e-12)


@BY_NAME
def test_a_law_acts_after_all_other_effects_of_its_stage(name: str) -> None:
    given = ["tip-dilation", name, "vertical-shrinkage", "dose-exponent"]
    at = 2 if get_effect(name).stage == "development" else 1
    wanted = ["dose-exponent", "vertical-shrinkage", "tip-dilation"]
    assert in_forward_order(given) == [*wanted[:at], name, *wanted[at:]]


def test_a_wave_of_light_is_in_the_print_before_it_is_developed() -> None:
    assert in_forward_order(["slope-thinning", "height-wave"]) == ["height-wave", "slope-thinning"]


def test_laws_and_descriptions_are_found_by_name_and_are_no_causes() -> None:
    assert all(get_effect(name) is one for name, one in NAMELESS.items())
    assert {one.knowledge for one in LAWS.values()} == {"law"}
    assert {one.knowledge for one in TABLES.values()} == {"description"}
    assert {one.knowledge for one in CATALOGUE.values()} == {"cause"}
    assert not NAMELESS.keys() & {one.name for one in screened_effects()}
    with pytest.raises(InputError, match="which exists"):
        register_effect(LAWS["curvature-x"])


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_slope_thinning_is_a_power_of_the_slope(power: float, axis: str) -> None:
    found = changed("slope-thinning", {f"along_{axis}_um": 0.2, "exponent": power}, HEIGHT)
    np.testing.assert_allclose(found, -0.2 * np.abs(slope(HEIGHT, axis)) ** power, atol=0.2 * 1.1 * ROUNDED)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_shortened_line_loses_its_delta_at_both_ends(axis: str) -> None:
    """Check a line 0.8 µm high. Shortening it along its length decreases the area of its profile by twice
    delta times the height. Shortening it across its length changes nothing.
    """
    line = np.zeros((30, 60))
    line[:, 15:45] = 0.8
    line = line if axis == "x" else line.T
    lost = changed("line-shortening", {f"along_{axis}_um": 0.15}, line).sum(axis=1 if axis == "x" else 0)
    np.testing.assert_allclose(lost * PITCH_UM, -2 * 0.15 * 0.8, rtol=1e-12)
    other = "y" if axis == "x" else "x"
    assert np.array_equal(changed("line-shortening", {f"along_{other}_um": 0.15}, line), 0 * line)
