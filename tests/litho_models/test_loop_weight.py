"""Names that carry their weight, against generic terms in their place and against what can be learned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from litho_models.effects import get_effect
from litho_models.loop import close_loop
from litho_models.twin.learner import Learner
from litho_models.loop.linear import ALL_FREE
from litho_models.twin.prepared import PreparedScan, prepare_scans
from litho_models.loop.screening.directions import PROJECTIONS
from litho_models.loop.selection.weight import Weight, left_beside_names_nm2, weigh
from litho_models.loop.study import Study, fit_state
from litho_models.models import build_model
from litho_models.scan_terms import Terms
from tests.litho_models.loop_scans import printed_scans, true_model

FOLD_OF = np.arange(10) % 5
SMALL = {"slope-thinning": get_effect("slope-thinning").off_values() | {"along_x_um": 0.012}}
Change = Callable[[PreparedScan], np.ndarray]


def weight_of_the_small_one(also: Change | None = None, terms: Terms = ALL_FREE) -> Weight:
    """Scans with a loss of height on slopes along x, and something else: what the name weighs."""
    scans = prepare_scans(printed_scans(SMALL, count=10, size_px=96, seed=4))
    if also is not None:
        scans = prepare_scans(
            [replace(f.stored, height_um=(f.stored.height_um + also(f)).astype(np.float32)) for f in scans]
        )
    study = Study(scans, FOLD_OF)
    without, final = (fit_state(true_model(effects), study) for effects in ({}, SMALL))
    return weigh(without, final, study, Learner(study, without.predictions), terms)


def far_copy(scan: PreparedScan) -> np.ndarray:
    """4 % of the layout, printed again 3.5 µm away: half the field of 9.6 µm is 4.8 µm."""
    return 0.04 * np.roll(scan.stored.layout_um, (30, -18), (0, 1))


def bead(scan: PreparedScan) -> np.ndarray:
    """40 nm per unit slope along y, times the height: in no catalogue."""
    height = scan.stored.height_um.astype(float)
    return 0.04 * height * np.abs(np.gradient(scan.stored.layout_um, scan.stored.pitch_um, axis=0)).clip(0, 2)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_a_cause_that_is_all_there_is_carries_its_weight(projection: str) -> None:
    weight = weight_of_the_small_one(terms=PROJECTIONS[projection])
    assert weight.lacking == ""
    # The learner finds the same, less what 200 coefficients cost it.
    assert 0.5 * weight.gain_nm2 < weight.learner_gain_nm2 < 1.05 * weight.gain_nm2
    assert 0.5 * weight.gain_nm2 < weight.probe_gain_nm2 < 1.05 * weight.gain_nm2
    assert weight.share > 0.95


@pytest.mark.parametrize(("also", "rival"), [(far_copy, "displaced-copy"), (bead, "")])
def test_a_small_effect_beside_a_large_cause_of_another_form_is_only_a_part(also: Change, rival: str) -> None:
    weight = weight_of_the_small_one(also)
    assert weight.lacking
    assert weight.share < 0.5
    if rival:
        assert weight.probe == rival
        assert rival in weight.lacking


@pytest.mark.parametrize(("power", "holds"), [(2, True), (3, True), (5, False)])
def test_a_name_holds_where_its_law_leaves_nothing_to_be_learned(power: int, holds: bool) -> None:
    """The catalogue has a loss with a power of the slope up to 3; the fifth it describes nearly as well."""
    scans = [
        replace(f.stored, height_um=thinned_um(f, power))
        for f in prepare_scans(printed_scans(count=10, size_px=64, noise_um=0.003, seed=4))
    ]
    study = Study(prepare_scans(scans), FOLD_OF)
    without, named = (fit_state(true_model(effects), study) for effects in ({}, SMALL))
    learner = Learner(study, without.predictions)
    left_nm2 = left_beside_names_nm2(named, named, learner)
    weight = weigh(without, named, study, learner, ALL_FREE, left_nm2)
    # By the squares alone the name would hold: 97 % of what can be learned.
    assert weight.share > 0.9
    assert (weight.lacking == "") == holds


def thinned_um(scan: PreparedScan, power: int) -> np.ndarray:
    """Heights that lose 12 nm per slope along x to that power."""
    height = scan.stored.height_um
    slope = np.gradient(height, scan.stored.pitch_um, axis=1)
    return (height - 0.012 * np.abs(slope) ** power).astype(np.float32)


@pytest.mark.long
def test_the_loop_gives_no_name_to_a_copy_beyond_its_kernel() -> None:
    scans = [
        replace(f.stored, height_um=(f.stored.height_um + far_copy(f)).astype(np.float32))
        for f in prepare_scans(printed_scans(count=12, size_px=96, seed=4))
    ]
    findings = close_loop(scans, build_model("physics", sigma_diffusion_init_um=0.4))
    assert not [name for name, weight in findings.weights.items() if not weight.lacking]
    assert "displaced-copy" in [entry.probe.name for entry in findings.probed.added]


@pytest.mark.parametrize(
    ("probe", "ahead", "learner", "left", "reasons"),
    [
        (12.0, True, 0.0, 0.0, 0),  # recovers 83 %
        (14.0, True, 0.0, 0.0, 1),  # recovers 71 %
        (14.0, False, 0.0, 0.0, 0),  # ahead by chance
        (5.0, False, 19.0, 0.0, 0),  # accounts for 53 %
        (5.0, False, 21.0, 0.0, 1),  # accounts for 48 %
        (5.0, False, 10.0, 0.09, 0),  # a formula that is 9 % off leaves 0.8 %
        (5.0, False, 10.0, 0.11, 1),
        (20.0, True, 30.0, 20.0, 3),
    ],
)
def test_the_limits_are_those_that_are_written(probe, ahead, learner, left, reasons) -> None:
    weight = Weight(10.0, "slope-table", probe, ahead, learner, left)
    words = ("in its place", "without it", "beside it")
    assert sum(weight.lacking.count(one) for one in words) == reasons
    assert weight.share == pytest.approx(min(1.0, 10.0 / max(learner, probe if ahead else 0.0, 1e-9)))
