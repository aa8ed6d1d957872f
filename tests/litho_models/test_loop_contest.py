"""Which candidate is chosen, and what may not be taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from litho_models.effects import FieldContext, get_effect
from litho_models.loop import LoopConfig, close_loop
from litho_models.loop.fold_fits import FoldFits
from litho_models.twin.prepared import prepare_scans
from litho_models.loop.screening.directions import blocks_of
from litho_models.loop.selection.rivals import generic_rival, remainder_of
from litho_models.loop.study import State, Study
from litho_models.models import build_model
from tests.litho_models.loop_scans import printed_scans, true_model


def added_to(scans) -> dict[str, list[str]]:
    start = build_model("physics", sigma_diffusion_init_um=0.4)
    findings = close_loop(scans, start, LoopConfig())
    return {entry.effect.name: entry.confusable_with for entry in findings.search.added}


@pytest.mark.long
def test_an_elliptical_spot_is_not_taken_for_diffusion() -> None:
    # Along one diagonal 0.3 µm wider in quadrature: more than half of it is plain blur.
    scans = printed_scans({"elliptical-psf": {"shear_um2": 0.09}}, count=12, size_px=96, seed=2)
    assert added_to(scans) == {"elliptical-psf": []}


@pytest.mark.long
def test_a_print_that_lost_its_foot_is_not_called_shrunk() -> None:
    scans = printed_scans({"interface-offset": {"depth_um": 0.25}}, count=12, size_px=96, seed=3)
    assert "interface-offset" in {name for own, others in added_to(scans).items() for name in (own, *others)}


@pytest.mark.long
def test_ripples_are_found_though_offsets_of_lines_could_hide_them() -> None:
    ripple = {"cosine_um": 0.006, "sine_um": 0.004, "frequency_per_um": 0.31}
    scans = printed_scans({"hatch-ripple": ripple}, count=12, size_px=96, seed=4)
    assert added_to(scans) == {"hatch-ripple": []}


@pytest.mark.long
def test_a_tilt_that_all_prints_share_is_found_though_every_scan_may_have_its_own() -> None:
    tilt = {"tilt_x_um": 0.06, "tilt_y_um": -0.04}
    scans = printed_scans({"field-curvature": tilt}, count=12, size_px=96, seed=5)
    # Bare places are not tilted with the print: that tells it from a tilt of the microscope.
    assert added_to(scans) == {"field-curvature": []}


@pytest.mark.parametrize("planted", ["bead", "tip-dilation"])
def test_a_tip_gives_way_to_a_table_over_the_slope_unless_it_is_the_cause(planted) -> None:
    """A bead grows with the slope, the lift of a blunt tip with its square: near each other, not equal."""
    tip, chain = get_effect("tip-dilation"), true_model({})
    scans, before, after = prepare_scans(printed_scans(count=12, size_px=96, seed=6)), [], []
    changed = []
    for scan in scans:
        with torch.no_grad():
            clean = chain(scan.layout, scan.context)
            dilated = tip(clean, {"radius_um": 0.3}, scan.context)
        before.append(clean[0, 0].numpy())
        after.append(dilated[0, 0].numpy())
        bead = 0.06 * np.hypot(*np.gradient(before[-1], scan.stored.pitch_um))
        lift = after[-1] - before[-1] if planted == "tip-dilation" else bead
        changed.append(replace(scan.stored, height_um=(scan.stored.height_um + lift).astype(np.float32)))
    scans = prepare_scans(changed)
    nothing = np.empty(0)
    fits = FoldFits(chain, nothing, np.empty((4, 0)), np.zeros(4), np.empty((0, 0)), [])
    rival = generic_rival(State(fits, before), State(fits, after), Study(scans, np.arange(12) % 4))
    assert rival == (None if planted == "tip-dilation" else "slope-table")


@pytest.mark.parametrize("left_over", [True, False])
def test_what_the_form_of_a_named_effect_leaves_over_is_no_further_effect(left_over: bool) -> None:
    scans = prepare_scans(printed_scans(count=8))
    fits = FoldFits(true_model({}), np.empty(0), np.empty((4, 0)), np.zeros(4), np.empty((0, 0)), [])
    random = np.random.default_rng(5)
    plain, named, further = [], [], []
    for scan in scans:
        base = gaussian_filter(scan.stored.layout_um, 3.0)
        slope_y, slope_x = np.gradient(base)
        change = -8 * slope_x**2
        plain.append(base)
        named.append(base + change)
        # The machine blurs what the catalogue does not, or heights are lost along the other axis too.
        missing = gaussian_filter(change, 3.0) - change if left_over else -2 * slope_y**2
        scan.stored.height_um[:] = base + change + missing + random.normal(0, 1e-4, size=base.shape)
        # A candidate that is near what is missing, and not quite the same.
        further.append(base + change + 0.8 * gaussian_filter(missing, 1.0))
    scans = prepare_scans([f.stored for f in scans])
    states = [State(fits, p) for p in (plain, named, further)]
    reason = remainder_of((states[0], states[1]), states[1], states[2], Study(scans, np.arange(8) % 4))
    assert ("another shape" in reason) == left_over
    assert bool(reason) == left_over


def test_sizes_of_one_direction_are_alternatives_and_directions_are_fitted_together() -> None:
    blocks = blocks_of([get_effect("elliptical-psf"), get_effect("slope-thinning")])
    sizes = [len(block.trials) for block in blocks]
    # Three sizes of (stretch, shear); for each power of the slope one block along x, along y, and along both.
    assert sizes == [2, 2, 2, 3, 3]
    columns = [column for block in blocks for column in block.columns]
    assert columns == list(range(len(columns)))


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_slices_set_alike_in_wide_areas_and_differ_where_narrower_than_the_spot(share) -> None:
    layout = torch.zeros(1, 1, 60, 60)
    layout[..., 30:] = 0.5
    layout[..., 20:40, 12] = 0.5
    context = FieldContext(layout, 0.1, 1.2)
    effect = get_effect("layer-stacking")
    changed = effect(layout, effect.with_values({"share": share}), context) - layout
    # Wide areas: 0 and 1 are fixed points of the step. A line of one pixel is below the threshold: lost.
    assert float(changed[..., 50].abs().max()) < 1e-4
    line = float(changed[..., 30, 12])
    assert line < -0.05 if share else line == 0.0


def test_the_interface_cuts_the_print_from_below() -> None:
    height = torch.tensor(np.linspace(0, 1.2, 13), dtype=torch.float32).reshape(1, 1, 1, 13)
    values = {"depth_um": 0.25, "substrate_um": 0.05, "shrinkage": 0.0}
    cut = get_effect("interface-offset")(height, values, FieldContext(height, 0.1, 1.2))
    # What is not above the substrate stays; what is loses the depth and ends at the substrate.
    assert float(cut[..., 0]) == 0
    assert torch.allclose(cut[..., 1:], torch.clamp(height[..., 1:] - 0.25, min=0.05), atol=1e-6)
    # Around a place half as dense as the densest, the lost part had shrunk by half of `shrinkage`.
    half = FieldContext(torch.full_like(height, 0.6), 0.1, 1.2)
    shrunk = get_effect("interface-offset")(height, {**values, "shrinkage": 0.4}, half)
    assert torch.allclose(shrunk[..., 1:], torch.clamp(height[..., 1:] - 0.2, min=0.05), atol=1e-6)
