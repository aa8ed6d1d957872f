"""Test the comparison of designs: its statistics, its matrix, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_design.judging.gap import GapResult, interval95, paired_differences, summarise
from litho_design.printers.printer import Printer
from litho_design.tasks.task import registered_task
from litho_design.workflows.compare import compare


def test_interval_is_students():
    values = np.array([1.0, 2.0, 4.0])
    # With mean 7/3, sd 1.5275 and t(0.975, 2) = 4.3027, half the width is 4.3027 * 1.5275 / sqrt(3) = 3.7946.
    low, high = interval95(values)
    assert (low, high) == pytest.approx((7 / 3 - 3.7946, 7 / 3 + 3.7946), abs=1e-3)
    assert interval95(values[:1]) is None


@pytest.mark.long
def test_matrix_gap_and_resume(tmp_path, small_settings, make_printer):
    search = small_settings.search.model_copy(update={"iterations": 15, "polish_rounds": 0})
    settings = small_settings.model_copy(update={"search": search})
    arms = {"none": Printer(None, settings.layout, source="none"), "blur": make_printer(settings.layout)}
    judges = {"fab": make_printer(settings.layout, sigma_um=0.22, gain=0.6)}
    result = compare(settings, arms, tmp_path, judges=judges, target="ring", seeds=(0, 1), announce=False)
    assert {(e.arm, e.seed, e.judge) for e in result.entries} == {
        (arm, seed, judge) for arm in arms for seed in (0, 1) for judge in ("none", "blur", "fab")
    }
    for entry in result.entries:
        if entry.self_judged:
            assert entry.judged == pytest.approx(entry.designed, rel=1e-5)
            assert entry.rms_height_gap_um == pytest.approx(0, abs=1e-7)
    figures = {(s.arm, s.judge): s.judged_mean for s in result.summary if s.figure == "si_psnr_db"}
    # The blur must do less harm to a design that was made with it than to one that was not.
    assert figures["blur", "fab"] > figures["none", "fab"] + 1
    paired = {(p.judge, p.figure): p for p in result.paired}
    assert paired["fab", "si_psnr_db"].mean == pytest.approx(figures["blur", "fab"] - figures["none", "fab"])
    assert summarise(result.entries) == result.summary
    assert paired_differences(result.entries, registered_task("hoe").headline) == result.paired
    assert GapResult.read(tmp_path) == result
    written = (tmp_path / "designs" / "blur" / "seed1" / "design.json").stat().st_mtime_ns
    compare(settings, arms, tmp_path, judges=judges, target="ring", seeds=(0, 1), announce=False)
    assert (tmp_path / "designs" / "blur" / "seed1" / "design.json").stat().st_mtime_ns == written


def test_a_judge_may_not_carry_the_name_of_an_arm(tmp_path, small_settings, make_printer):
    printer = make_printer(small_settings.layout)
    with pytest.raises(InputError, match="twice"):
        compare(small_settings, {"a": printer}, tmp_path, judges={"a": printer}, seeds=(0,))
    with pytest.raises(InputError, match="at least one"):
        compare(small_settings, {"a": printer}, tmp_path, seeds=())
