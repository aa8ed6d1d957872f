"""Check that the exposure is level times dose in the fab, in the models and in a plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from litho_data.cards.tables import read_table
from litho_data.virtual_fab import jobs_of_card
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.knobs import KnobBoard, KnobSetting
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer
from litho_models.loop.model import Twin
from litho_models.loop.prepared import prepare_scans
from litho_models.planning import layouts
from litho_models.planning.layouts import SECOND_DOSE
from litho_models.planning.rivalry import PLAIN, planned_scans, predict
from litho_models.planning.run import next_print
from litho_models.scan_terms.grouped import ALL
from tests.litho_models.loop_scans import blank_scans
from tests.litho_models.test_next_print import SHARED, closed_loop, model, slope_question


def _even_levels(size_px: int = 48) -> np.ndarray:
    return 2 * np.random.default_rng(3).integers(0, 7, (size_px // 8, size_px // 8)).repeat(8, 0).repeat(8, 1)


def test_in_the_fab_half_the_dose_prints_half_the_levels() -> None:
    fab = Fab(Printer(), Microscope.aligned(), Noise.off(), KnobBoard([], 0), 0)
    level = _even_levels().astype(np.uint8)
    half_dose = scan_job(fab, Job("a", level, dose=0.5)).height_um
    half_levels = scan_job(fab, Job("a", level // 2)).height_um
    # The results differ only by rounding in filters.
    assert np.abs(half_dose - half_levels).max() < 1e-9
    assert np.ptp(half_dose) > 0.1


def test_slices_pass_a_threshold_by_their_dose_and_not_by_their_number() -> None:
    """Check that half the dose gives another print than half the levels if slices are exposed one by one."""
    knobs = KnobBoard([KnobSetting("layer-stacking", 0.8, 1)], 0)
    fab = Fab(Printer(), Microscope.aligned(), Noise.off(), knobs, 0)
    level = _even_levels().astype(np.uint8)
    half_dose, half_levels = (
        scan_job(fab, Job("a", own, dose=dose)).height_um for own, dose in ((level, 0.5), (level // 2, 1.0))
    )
    assert np.abs(half_dose - half_levels).max() > 0.01
    own = {"share": 0.8, "threshold": 0.6, "steepness": 8.0}
    twin = Twin.bare(torch.nn.Identity()).with_effect("layer-stacking", ALL, {"": own})
    [wide] = planned_scans(SHARED, torch.full((40, 40), 12.0), [PLAIN], dose=0.5)
    middle = float(predict(twin, wide)[20, 20])
    low, high, at = (1 / (1 + np.exp(-8 * (dose - 0.6))) for dose in (0.0, 1.0, 0.5))
    step = (at - low) / (high - low)
    # In the middle of a wide block, all twelve slices have half the dose (in float32).
    assert middle == pytest.approx(0.6 + 0.8 * 1.2 * (step - 0.5), abs=1e-5)


def test_plan_and_loop_see_a_dose_as_the_fab_does() -> None:
    level = _even_levels()
    scans = planned_scans(SHARED, level, [PLAIN], dose=0.5) + planned_scans(SHARED, level // 2, [PLAIN])
    at_half, half = (predict(model({}), scan) for scan in scans)
    assert torch.allclose(at_half, half, atol=1e-6)
    scan = blank_scans(1)[0]
    usual, weak, untold = (prepare_scans([replace(scan, dose=dose)])[0] for dose in (1.0, 0.8, None))
    assert torch.equal(usual.context.layout_um, untold.context.layout_um)
    assert torch.allclose(weak.context.layout_um, 0.8 * usual.context.layout_um)
    assert (weak.context.dose, usual.context.dose) == (0.8, 1.0)


@pytest.mark.parametrize(("gain", "doses"), [(2.0, {1.0, 0.8}), (1.1, {1.0})])
def test_a_plan_takes_a_second_dose_where_it_separates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain: float, doses: set[float]
) -> None:
    loop = closed_loop(tmp_path / "loop", [slope_question()])
    plain = layouts.score
    asked: list[tuple[float, ...]] = []

    def score(rivalry, prints):
        asked.append(tuple(scans[0].dose for scans in prints))
        return plain(rivalry, prints[:1]) * (gain if SECOND_DOSE in asked[-1] else 1.0)

    monkeypatch.setattr(layouts, "score", score)
    plan = next_print(loop, tmp_path / "plan", prints=2, field_um=6.4, steps=0, layouts="random")
    assert plan is not None
    assert (1.0, SECOND_DOSE) in asked
    assert f"the second at {SECOND_DOSE:g} of the dose" in plan.questions[0].why
    table = read_table(tmp_path / "plan" / "scans.csv")
    assert {row["dose"] for row in table.values()} == doses
    for job in jobs_of_card(tmp_path / "plan" / "card.toml", first=0):
        assert job.dose == (SECOND_DOSE if gain > 1.3 and job.id.startswith("N2") else 1.0)
    sheet = (tmp_path / "plan" / "printer.md").read_text("utf-8")
    assert ("| 0.8 | print |" in sheet) == (gain > 1.3)
