"""Check the contract that every effect of the catalogue obeys, and closed forms of single effects."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_data.virtual_fab.knobs import KNOBS
from litho_models.effects import CATALOGUE, FieldContext, get_effect, in_forward_order, screened_effects
from litho_models.effects.effect import Effect, Parameter
from litho_models.layers.gaussian import gaussian_blur, pad_field
from litho_models.scan_terms import SCAN_TERMS

pytestmark = pytest.mark.numerics

PITCH_UM = 0.1
EFFECTS = [effect for effect in CATALOGUE.values() if not effect.per_scan]
PER_EFFECT = pytest.mark.parametrize("effect", EFFECTS, ids=[effect.name for effect in EFFECTS])


def field(seed: int = 0) -> tuple[torch.Tensor, FieldContext]:
    """Return a smooth random height map in µm with flat parts, and its context. The map is float64 with the
    shape (1, 1, 36, 44).
    """
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randint(0, 13, (1, 1, 9, 11), generator=generator).double() * 0.1
    layout = torch.nn.functional.interpolate(coarse, size=(36, 44), mode="nearest")
    height = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(layout, (2,) * 4, mode="replicate"), 5, 1)
    return height, FieldContext(layout, PITCH_UM, 1.2, order=0.3)


def input_of(effect: Effect) -> tuple[torch.Tensor, FieldContext]:
    height, context = field()
    return (context.layout_um if effect.acts_on == "layout" else height), context


def test_the_catalogue_is_not_empty_and_holds_all_stages_and_roles() -> None:
    assert len(EFFECTS) >= 20
    assert {effect.stage for effect in EFFECTS} == {"exposure", "resist", "development", "measurement"}
    assert {effect.role for effect in EFFECTS} == {"process", "measurement", "nuisance", "undetermined"}


# The stage and role of each effect follow from how it arises. Designs use only process effects.
BELONGS_TO = {
    ("exposure", "process"): """elliptical-psf defocus long-range-proximity dose-exponent galvo-lag
        galvo-nonlinearity vignetting
        field-curvature layer-stacking interface-offset""",
    ("exposure", "nuisance"): "laser-drift hatch-ripple line-roughness",
    ("resist", "process"): "write-order-memory diffusion-blur threshold-softness height-saturation",
    ("development", "process"): """vertical-shrinkage dose-dependent-shrinkage lateral-shrinkage
        feature-collapse trench-residue""",
    ("development", "undetermined"): "slope-thinning",
    ("measurement", "measurement"): """datum-offset z-gain tilt-bow scan-line-stripes slow-drift
        tip-dilation feedback-lag registration-residual piezo-nonlinearity resampling-blur""",
}


def test_every_effect_has_the_stage_and_role_of_the_table() -> None:
    wanted = {name: key for key, names in BELONGS_TO.items() for name in names.split()}
    assert len(wanted) > 30
    # New effects need not be in the table, but the effects of the table must keep their roles.
    assert {name: (CATALOGUE[name].stage, CATALOGUE[name].role) for name in wanted} == wanted


def test_fab_and_catalogue_agree_on_stage_and_role() -> None:
    planted = [knob for knob in KNOBS.values() if knob.effect in CATALOGUE]
    assert len(planted) > 20
    for knob in planted:
        assert (knob.stage, knob.role) == (CATALOGUE[knob.effect].stage, CATALOGUE[knob.effect].role), knob


@PER_EFFECT
def test_off_is_the_identity(effect: Effect) -> None:
    array, context = input_of(effect)
    changed = effect(array, effect.with_values({}), context)
    # Some effects scale heights and scale them back in float64, whose rounding is far below 1e-7.
    assert torch.allclose(changed, array, rtol=0, atol=1e-7)


@PER_EFFECT
def test_typical_amplitude_changes_the_field_and_keeps_its_shape(effect: Effect) -> None:
    array, context = input_of(effect)
    for name in effect.amplitudes:
        values = effect.with_values({name: effect.parameters[name].typical})
        changed = effect(array, values, context)
        assert changed.shape == array.shape
        assert torch.isfinite(changed).all()
        assert (changed - array).abs().max() > 1e-5


@PER_EFFECT
def test_gradient_equals_finite_difference(effect: Effect) -> None:
    array, context = input_of(effect)
    weights = torch.randn(array.shape, generator=torch.Generator().manual_seed(1), dtype=array.dtype)
    typical = {name: p.typical for name, p in effect.parameters.items()}
    for name, parameter in effect.parameters.items():
        if parameter.kind == "choice":
            continue
        for at in (parameter.typical, parameter.off):
            value = torch.tensor(at, dtype=array.dtype, requires_grad=True)
            (gradient,) = torch.autograd.grad(
                (weights * effect(array, {**typical, name: value}, context)).sum(), value
            )
            # At its null, an amplitude may be at a bound or a kink, so step to one side only.
            step = 1e-6 * (parameter.typical - parameter.null if at == parameter.off else parameter.typical)
            # The typical size of an angle may be zero. Its step is then relative to its range.
            step = step or 1e-6 * (parameter.typical or parameter.upper - parameter.lower)
            up, here, down = (
                float((weights * effect(array, {**typical, name: at + k * step}, context)).sum())
                for k in (1, 0, -1)
            )
            difference = (up - here) / step if at == parameter.off else (up - down) / (2 * step)
            # One-sided differences err by truncation, ~ step, and by rounding, ~ 1e-16 * 1584 px / step.
            assert float(gradient) == pytest.approx(difference, rel=1e-3, abs=1e-3)


@PER_EFFECT
def test_gradient_to_the_field_is_finite_when_off_and_on(effect: Effect) -> None:
    array, context = input_of(effect)
    for values in (effect.with_values({}), {name: p.typical for name, p in effect.parameters.items()}):
        leaf = array.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(effect(leaf, values, context).sum(), leaf)
        assert torch.isfinite(gradient).all()


@PER_EFFECT
def test_parameters_have_units_and_bounds_that_hold_their_values(effect: Effect) -> None:
    for parameter in effect.parameters.values():
        assert parameter.unit
        assert parameter.lower < parameter.upper
        assert parameter.lower <= parameter.typical <= parameter.upper
        if parameter.kind == "amplitude":
            assert parameter.lower <= parameter.null <= parameter.upper
            assert parameter.typical != parameter.null
    assert (effect.stage == "measurement") == (effect.role == "measurement")
    assert effect.trials
    for trial in effect.trials:
        assert effect.with_values(trial) != effect.with_values({})


def test_screened_effects_and_forward_order() -> None:
    assert {effect.name for effect in screened_effects()} < set(CATALOGUE)
    assert in_forward_order(["tip-dilation", "vignetting"]) == ["vignetting", "tip-dilation"]


def test_the_tip_is_tried_at_the_radius_that_the_store_knows() -> None:
    def radii(known_um: float | None) -> list[float]:
        tip = next(one for one in screened_effects(known_um) if one.name == "tip-dilation")
        return [trial["radius_um"] for trial in tip.trials if len(trial) == 1]

    assert radii(0.13) == [0.04, 0.4, 0.13]
    assert radii(None) == radii(0.39) == [0.04, 0.4]
    # The radius is limited to the upper bound of the effect.
    assert radii(9.0) == [0.04, 0.4, get_effect("tip-dilation").parameters["radius_um"].upper]


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match="vignetting"):
        get_effect("vigneting")
    with pytest.raises(InputError, match="strength"):
        get_effect("vignetting").with_values({"amount": 1.0})


def test_an_effect_without_amplitude_is_refused() -> None:
    with pytest.raises(InputError, match="amplitude"):
        Effect(
            "still", "", "resist", "process", "height", {"w": Parameter("1", 0, 1, 0.5, kind="shape")},
            lambda array, values, context: array, "test",
        )  # fmt: skip


def cosine(frequency_per_um: float, axis: str, size: int = 240) -> tuple[torch.Tensor, FieldContext]:
    position = (torch.arange(size, dtype=torch.float64) + 0.5) * PITCH_UM
    wave = torch.cos(2 * math.pi * frequency_per_um * position)
    plane = wave[None, :].expand(size, size) if axis == "x" else wave[:, None].expand(size, size)
    plane = plane[None, None].clone()
    return plane, FieldContext(plane, PITCH_UM, 1.2)


def amplitude_ratio(changed: torch.Tensor, original: torch.Tensor, edge_px: int = 60) -> float:
    inner = (..., slice(edge_px, -edge_px), slice(edge_px, -edge_px))
    return float(changed[inner].std() / original[inner].std())


@pytest.mark.parametrize("name", ["defocus", "diffusion-blur"])
@pytest.mark.parametrize("frequency", [0.25, 0.5])
def test_a_blur_has_the_gaussian_transfer(name: str, frequency: float) -> None:
    wave, context = cosine(frequency, "x")
    changed = get_effect(name)(wave, {"variance_um2": 0.09}, context)
    expected = math.exp(-2 * math.pi**2 * 0.09 * frequency**2)
    # The edge is 6 µm = 20 sigma away, so the results differ only by rounding.
    assert amplitude_ratio(changed, wave) == pytest.approx(expected, rel=1e-9)


def test_elliptical_psf_widens_one_axis_and_narrows_the_other() -> None:
    effect = get_effect("elliptical-psf")
    stretch, frequency = 0.01, 0.5
    isotropic = math.hypot(stretch, 0.02) - 0.02
    for axis, sign in (("x", 1), ("y", -1)):
        wave, context = cosine(frequency, axis)
        changed = effect(wave, effect.with_values({"stretch_um2": stretch}), context)
        expected = math.exp(-(math.pi**2) * (isotropic + sign * stretch) * frequency**2)
        # Along the sharpened axis there is slight ringing, because the layout ends at its edge.
        assert amplitude_ratio(changed, wave) == pytest.approx(expected, rel=1e-5)


def test_a_sharpened_spot_does_no_harm_beside_the_edges_of_the_field() -> None:
    layout = field()[1].layout_um

    def printed(layout: torch.Tensor) -> torch.Tensor:
        context = FieldContext(layout, PITCH_UM, 1.2)
        exposed = get_effect("elliptical-psf")(layout, {"stretch_um2": 0.02, "shear_um2": 0.17}, context)
        return gaussian_blur(exposed, 0.25, PITCH_UM)

    around = printed(pad_field(layout, 30, 30))[..., 30:-30, 30:-30]
    # Along its short axis, the spot shrinks by 0.02 µm². Without a limit, the layout would be multiplied by
    # exp(π² 0.02 f²) = 2e4 at the highest frequency, and the print would be wrong by 2 µm at a corner. The
    # factor is limited to e. The error is then 57 nm at a corner, and less than 6 nm at a distance of 4 px.
    assert (printed(layout) - around).abs().max() < 0.06
    assert (printed(layout) - around)[..., 4:-4, 4:-4].abs().max() < 0.006


def test_long_range_proximity_keeps_a_flat_dose_and_damps_a_fast_wave() -> None:
    effect = get_effect("long-range-proximity")
    wave, context = cosine(0.5, "y")
    changed = effect(wave, {"weight": 0.25, "length_um": 2.0}, context)
    blur = math.exp(-2 * math.pi**2 * 4 * 0.25)
    expected = (1 + 0.25 * blur) / 1.25
    # The edge is 3 sigma from the window and changes the background by at most 0.2 * erfc(3 / sqrt 2) / 2.
    assert amplitude_ratio(changed, wave) == pytest.approx(expected, rel=3e-4)
    flat, context = torch.ones(1, 1, 240, 240, dtype=torch.float64), context
    inner = effect(flat, {"weight": 0.25, "length_um": 2.0}, context)[..., 60:-60, 60:-60]
    assert torch.allclose(inner, torch.ones_like(inner), rtol=0, atol=0.2 * 4 * 0.00135)


def test_galvo_lag_is_a_one_sided_exponential_of_unit_area_about_its_mean() -> None:
    effect = get_effect("galvo-lag")
    point = torch.zeros(1, 1, 9, 200, dtype=torch.float64)
    point[..., 4, 100] = 1
    context = FieldContext(point, PITCH_UM, 1.2)
    response = effect(point, {"length_um": 0.3, "direction": 1.0}, context)[0, 0, 4]
    # The tail starts 3 px early, by the mean delay of 0.3 µm, so that the mean response is not shifted.
    lags = torch.arange(200) - 100 + 3
    ratio = 0.3 / (0.3 + PITCH_UM)
    expected = torch.where(lags >= 0, (1 - ratio) * ratio ** lags.clamp(min=0).double(), 0.0)
    # Padding makes the period 6 lengths longer than the field. The tail that wraps around is below ratio^100.
    assert torch.allclose(response, expected, rtol=0, atol=1e-9)
    assert float((response * (torch.arange(200) - 100)).sum()) == pytest.approx(0, abs=1e-6)
    mirrored = effect(point, {"length_um": 0.3, "direction": -1.0}, context)[0, 0, 4]
    assert torch.allclose(mirrored[1:].flip(0), response[1:], rtol=0, atol=1e-9)
    assert float(mirrored[104:].abs().max()) < 1e-9


def test_slow_axis_turns_galvo_lag_and_memory() -> None:
    _, context = field()
    turned = FieldContext(context.layout_um.transpose(-1, -2), PITCH_UM, 1.2, slow_axis="x")
    for name in ("galvo-lag", "galvo-nonlinearity", "write-order-memory"):
        effect = get_effect(name)
        values = {key: p.typical for key, p in effect.parameters.items()}
        straight = effect(context.layout_um, values, context)
        across = effect(turned.layout_um, values, turned)
        assert torch.allclose(across.transpose(-1, -2), straight, rtol=0, atol=1e-12)


def test_a_negative_dose_of_another_effect_is_kept_by_one_that_is_off() -> None:
    layout, context = field()
    layout = layout - 0.3
    effect = get_effect("write-order-memory")
    assert torch.allclose(effect(layout, effect.with_values({}), context), layout, rtol=0, atol=1e-12)


def test_write_order_memory_makes_no_negative_dose() -> None:
    layout = torch.zeros(1, 1, 60, 60, dtype=torch.float64)
    layout[..., :30, :] = 1.2
    values = {"strength": 0.5, "length_um": 1.0, "direction": 1.0}
    dose = get_effect("write-order-memory")(layout, values, FieldContext(layout, PITCH_UM, 1.2))
    # Unwritten lines have no dose to reduce, so it stays 0 except for rounding.
    assert float(dose[..., 30:, :].abs().max()) < 1e-12
    # The tail ends after 3 lengths inside the layout and 5.9 beyond its edge, at e^-8.9 = 1.4e-4.
    assert float(dose[..., 29, 0]) == pytest.approx(0.6, rel=5e-4)


def test_vignetting_reaches_its_strength_at_the_edge_of_the_write_field() -> None:
    layout = torch.ones(1, 1, 101, 101, dtype=torch.float64)
    context = FieldContext(layout, PITCH_UM, 1.2, field_radius_um=5.0)
    dose = get_effect("vignetting")(layout, {"strength": 0.1}, context)[0, 0]
    assert float(dose[50, 50]) == pytest.approx(1.0)
    assert float(dose[50, 100]) == pytest.approx(0.9)  # 5.0 µm from the centre
    assert float(dose[0, 0]) == pytest.approx(0.8)


def test_threshold_softness_is_the_normalised_tanh_projection() -> None:
    height = torch.linspace(0, 1.2, 50, dtype=torch.float64).reshape(1, 1, 1, 50)
    context = FieldContext(height, PITCH_UM, 1.2)
    alpha, eta = 4.0, 0.35
    changed = get_effect("threshold-softness")(
        height, {"steepness_squared": alpha**2, "centre": eta}, context
    )
    top = math.tanh(alpha * eta) + torch.tanh(alpha * (height / 1.2 - eta))
    expected = 1.2 * top / (math.tanh(alpha * eta) + math.tanh(alpha * (1 - eta)))
    # The effect is relative to alpha = 1e-3 instead of 0, which changes heights by 1e-6 of their value.
    assert torch.allclose(changed, expected, rtol=0, atol=3e-6)


def test_slope_thinning_and_tip_dilation_on_a_ramp() -> None:
    ramp = 0.5 * (torch.arange(40, dtype=torch.float64) * PITCH_UM).expand(1, 1, 30, 40)
    context = FieldContext(ramp, PITCH_UM, 1.2)
    thinned = get_effect("slope-thinning")(ramp, {"along_x_um": 0.2, "along_y_um": 0.7}, context)
    dilated = get_effect("tip-dilation")(ramp, {"radius_um": 0.2}, context)
    inner = (..., slice(1, -1), slice(1, -1))
    assert torch.allclose((thinned - ramp)[inner], torch.tensor(-0.2 * 0.25, dtype=torch.float64))
    # The apex of a paraboloid on a plane of slope s is R s² / 2 above it. The contact is R s = 1 px away.
    touched = (..., slice(None), slice(3, -3))
    assert torch.allclose((dilated - ramp)[touched], torch.tensor(0.2 * 0.25 / 2, dtype=torch.float64))


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0, 90.0])
def test_equal_losses_along_both_axes_are_a_loss_by_the_size_of_the_slope(degrees: float) -> None:
    """Check that a ramp of slope 0.5 loses a height of c 0.5^p in any direction, and that a tiny negative
    loss counts as 0.
    """
    y, x = torch.meshgrid(*(torch.arange(40, dtype=torch.float64) * PITCH_UM,) * 2, indexing="ij")
    ramp = 0.5 * (math.cos(math.radians(degrees)) * x + math.sin(math.radians(degrees)) * y)[None, None]
    context, inner = FieldContext(ramp, PITCH_UM, 1.2), (..., slice(1, -1), slice(1, -1))
    for power, turn in ((1.0, 0.0), (3.0, 0.0), (3.0, 30.0)):
        values = {"along_x_um": 0.2, "along_y_um": 0.2, "exponent": power, "turn_deg": turn}
        change = (get_effect("slope-thinning")(ramp, values, context) - ramp)[inner]
        # The power law is smoothed for slopes below about a thousandth.
        assert torch.allclose(change, torch.tensor(-0.2 * 0.5**power, dtype=torch.float64), rtol=5e-3)
    values = {"along_x_um": -1e-9, "along_y_um": 0.0, "exponent": 1.0, "turn_deg": 0.0}
    assert torch.equal(get_effect("slope-thinning")(ramp, values, context), ramp)


def test_an_asymmetric_tip_rests_on_a_slope_by_its_radius_along_it() -> None:
    y, x = torch.meshgrid(*(torch.arange(40, dtype=torch.float64) * PITCH_UM,) * 2, indexing="ij")
    slope = (0.3 * y + 0.5 * x)[None, None]
    context = FieldContext(slope, PITCH_UM, 1.2)
    inner = (..., slice(4, -4), slice(4, -4))
    for along, across in ((1.0, 0.25), (0.25, 1.0)):
        values = {"radius_um": 0.4, "along": along, "across": across}
        lifted = get_effect("tip-dilation")(slope, values, context) - slope
        # Each axis adds R s² / 2, where R is the radius along this axis.
        expected = torch.tensor(0.4 / 2 * (along * 0.5**2 + across * 0.3**2), dtype=torch.float64)
        assert torch.allclose(lifted[inner], expected)


def test_uneven_scanners_of_printer_and_microscope_are_one_formula_until_the_scan_is_turned() -> None:
    height, context = field()
    square = height[..., :36]
    context = FieldContext(square, PITCH_UM, 1.2)
    written, scanned = get_effect("galvo-nonlinearity"), get_effect("piezo-nonlinearity")
    values = {"strength": 0.03}
    printed = written(square, values, context)
    # For both effects, positions extend to the outermost pixels. Half a field of 36 px is 1.8 µm.
    assert torch.allclose(printed, scanned(square, values, context), rtol=0, atol=1e-12)
    across = scanned(square, values, replace(context, quarter_turns=1), scanned=True)
    assert float((across - printed).abs().max()) > 1e-3
    back = scanned(square, values, replace(context, backward=True), scanned=True)
    assert torch.allclose(back, written(square, {"strength": -0.03}, context), rtol=0, atol=1e-12)
    # In a write field four times as large, the displacement is that of the whole field, c x² / 2R.
    wide = written(square, {"strength": 0.12}, replace(context, field_radius_um=4 * context.radius_um()))
    assert torch.allclose(wide, printed, rtol=0, atol=1e-12)


def test_the_gradient_of_a_dilation_is_that_of_the_piece_on_which_the_tip_stands() -> None:
    """Check derivatives of a dilation of random heights, on which small steps do not move the point of
    contact.
    """
    draw = torch.Generator().manual_seed(4)
    surface = (0.3 * torch.rand(1, 1, 6, 12, generator=draw, dtype=torch.float64)).requires_grad_()
    radius_um = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    context = FieldContext(surface.detach(), PITCH_UM, 1.2)
    tip = get_effect("tip-dilation")
    assert torch.autograd.gradcheck(
        lambda height, radius: tip(height, {"radius_um": radius}, context), (surface, radius_um)
    )


def test_a_tip_dilates_a_mirrored_surface_to_the_mirror_image() -> None:
    """Check the whole field, including its edges. The tip is so sharp that it touches only points within half
    a pixel.
    """
    draw = torch.Generator().manual_seed(6)
    surface = 0.2 * torch.rand(1, 1, 9, 12, generator=draw, dtype=torch.float64)
    dilated, mirrored = (
        get_effect("tip-dilation")(one, {"radius_um": 0.02}, FieldContext(one, PITCH_UM, 1.2))
        for one in (surface, surface.flip(-1, -2))
    )
    assert torch.allclose(dilated, mirrored.flip(-1, -2), rtol=0, atol=1e-12)


def test_a_tip_on_a_hump_rests_as_the_closed_form_says() -> None:
    # The maximum over u of a (1 - (x - u)² / w²) - u² / 2R is again a parabola, with curvature 1/(q + R)
    # instead of 1/q, q = w² / 2a. Straight pieces of half a pixel lie at most (dx/2)² / 8q below it.
    x = (torch.arange(61, dtype=torch.float64) - 30) * PITCH_UM
    q, radius = 2.0, 0.7
    hump = (-(x**2) / (2 * q)).expand(1, 1, 9, 61)
    dilated = get_effect("tip-dilation")(hump, {"radius_um": radius}, FieldContext(hump, PITCH_UM, 1.2))
    inner = slice(12, -12)
    expected = -(x**2) / (2 * (q + radius))
    assert float((dilated[0, 0, 4] - expected)[inner].abs().max()) <= (PITCH_UM / 2) ** 2 / (8 * q) + 1e-12


@pytest.mark.parametrize(("name", "sign"), [("trench-residue", 1.0), ("feature-collapse", -1.0)])
def test_only_narrow_pits_are_filled_and_only_narrow_ridges_are_lost(name: str, sign: float) -> None:
    """Check a plateau with a narrow and a wide pit. Turned upside down, the same surface has ridges."""
    pits = torch.ones(1, 1, 60, 60, dtype=torch.float64)
    pits[..., 10:50, 10:13] = 0
    pits[..., 10:50, 30:45] = 0
    values = {"fraction": 0.25, "width_um": 0.6}
    changed = sign * get_effect(name)(sign * pits, values, FieldContext(pits, PITCH_UM, 1.2))
    assert float(changed[0, 0, 30, 11]) == pytest.approx(0.25)
    assert float(changed[0, 0, 30, 37]) == 0.0
    assert torch.equal(changed[pits == 1], pits[pits == 1])


@pytest.mark.parametrize(("width_um", "share"), [(0.6, 0.0), (0.65, 0.25), (0.7, 0.5), (0.8, 1.0)])
def test_a_width_between_two_kernel_sizes_fills_a_pit_in_part(width_um: float, share: float) -> None:
    """Check a pit that is 7 px wide. A kernel of 7 px does not fill it, and a kernel of 9 px (0.4 µm)
    does.
    """
    pit = torch.ones(1, 1, 40, 40, dtype=torch.float64)
    pit[..., 16:23] = 0
    values = {"fraction": 1.0, "width_um": width_um}
    filled = get_effect("trench-residue")(pit, values, FieldContext(pit, PITCH_UM, 1.2))
    # Widths are kept in float32.
    assert float(filled[0, 0, 20, 19]) == pytest.approx(share, abs=1e-5)


def test_a_field_continues_beyond_its_edge_when_narrow_pits_are_filled() -> None:
    """Check that pits are filled as if the field continued beyond its edges with its outermost values."""
    part = torch.rand(1, 1, 40, 50, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    whole = torch.nn.functional.pad(part, (20,) * 4, mode="replicate")
    values = {"fraction": 1.0, "width_um": 0.9}
    closed, of_whole = (
        get_effect("trench-residue")(field, values, FieldContext(field, PITCH_UM, 1.2))
        for field in (part, whole)
    )
    assert torch.equal(closed, of_whole[..., 20:-20, 20:-20])


def test_every_per_scan_effect_has_a_scan_term_and_enters_no_model() -> None:
    array, context = field()
    own = [effect for effect in CATALOGUE.values() if effect.per_scan]
    assert {effect.name for effect in own} == {term.effect for term in SCAN_TERMS.values()} - {None}
    for effect in own:
        assert not effect.trials
        with pytest.raises(InputError, match="a per-scan effect"):
            effect(array, {}, context)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_slices_set_alike_in_wide_areas_and_differ_where_narrower_than_the_spot(share: float) -> None:
    layout = torch.zeros(1, 1, 60, 60)
    layout[..., 30:] = 0.5
    layout[..., 20:40, 12] = 0.5
    context = FieldContext(layout, 0.1, 1.2)
    effect = get_effect("layer-stacking")
    changed = effect(layout, effect.with_values({"share": share}), context) - layout
    # In wide areas, the values 0 and 1 stay fixed. The dose of a one-pixel line is below the threshold.
    assert float(changed[..., 50].abs().max()) < 1e-4
    line = float(changed[..., 30, 12])
    assert line < -0.05 if share else line == 0.0


def test_the_interface_cuts_the_print_from_below() -> None:
    height = torch.linspace(0, 1.2, 13).reshape(1, 1, 1, 13)
    values = {"depth_um": 0.25, "substrate_um": 0.05, "shrinkage": 0.0}
    cut = get_effect("interface-offset")(height, values, FieldContext(height, 0.1, 1.2))
    # Heights up to the substrate stay. Higher ones lose the depth, but do not fall below the substrate.
    assert float(cut[..., 0]) == 0
    assert torch.allclose(cut[..., 1:], torch.clamp(height[..., 1:] - 0.25, min=0.05), atol=1e-6)
    # Where the layout has half of the full height, the lost part is reduced by half of `shrinkage`.
    half = FieldContext(torch.full_like(height, 0.6), 0.1, 1.2)
    shrunk = get_effect("interface-offset")(height, {**values, "shrinkage": 0.4}, half)
    assert torch.allclose(shrunk[..., 1:], torch.clamp(height[..., 1:] - 0.2, min=0.05), atol=1e-6)
