"""Check that a scan of a known grating measures the distortion of the scanner, not that of the printer."""

from __future__ import annotations

import numpy as np
import pytest

from litho_data import build_dataset, open_store
from litho_data.cards.card import KnownGrating
from litho_data.foundation.errors import InputError
from litho_data.layouts.card_text import TABLE_NAME, write_card, write_layout, write_table
from litho_data.layouts.random_layout import random_layout
from litho_data.making.gratings import grating_scan, grating_scans
from litho_data.virtual_fab import Fab, Job, KnobSetting, Microscope, Noise, Printer, scan_job, simulate
from litho_data.virtual_fab.jobs import jobs_of_card
from litho_data.virtual_fab.knobs import KnobBoard

KNOWN = KnownGrating(period_um=2.0, uncertainty_um=0.002)


def scanned(*knobs: KnobSetting, scale: float = 0.0, seed: int = 3):
    microscope = Microscope(rotation_deg=0.3, scale=scale, shear=0.0)
    job = Job("G", np.zeros((192, 192), np.uint8), use="grating", grating_um=2.0)
    scan = scan_job(Fab(Printer(), microscope, Noise(), KnobBoard(knobs, seed), seed), job)
    pitch_um = (scan.frame.pitch_um, scan.frame.pitch_um)
    return scan, grating_scan("G", scan.height_um, pitch_um, KNOWN)


def test_the_bow_of_a_line_is_the_scanners_and_not_the_printers():
    for name, strength in (("piezo-nonlinearity", 0.04), ("galvo-nonlinearity", 0.04), ("vignetting", 0.0)):
        for seed in (3, 4, 5):
            scan, found = scanned(KnobSetting(name, strength), seed=seed)
            line_um = scan.frame.size_um[1]
            # The displacement is strength·x(1 − x/L), so it is strength·L/4 in the middle.
            expected = strength * line_um / 4 if name == "piezo-nonlinearity" else 0.0
            assert found.line_um == pytest.approx(line_um)
            assert found.bow_um is not None
            assert found.bow_sd_um is not None
            # All nine fits agree within four times their uncertainty, which is a tenth of the bow.
            assert abs(found.bow_um - expected) < 4 * found.bow_sd_um
            assert found.bow_sd_um < 0.02


def test_the_zero_of_the_heights_of_a_grating_does_not_matter():
    scan, _ = scanned(KnobSetting("piezo-nonlinearity", 0.04), scale=0.03)
    # Pixels that were not measured count as the mean of the others.
    height_um = np.where(np.random.default_rng(0).random(scan.height_um.shape) < 0.1, np.nan, scan.height_um)
    found, lifted = (
        grating_scan("G", height_um + zero_um, (scan.frame.pitch_um,) * 2, KNOWN) for zero_um in (0.0, 50.0)
    )
    for name in ("bow_um", "bow_sd_um", "scale_x", "scale_y"):
        # A float32 of 50 µm is exact to 4 nm, and the mean over thousands of pixels is better.
        assert getattr(lifted, name) == pytest.approx(getattr(found, name), rel=1e-3)


def test_the_scales_are_those_of_the_scan_within_their_uncertainty():
    for seed in (3, 4, 5):
        scan, found = scanned(scale=0.02, seed=seed)
        across, along = (float(np.hypot(*scan.frame.scan_to_layout[:2, axis])) for axis in (1, 0))
        for scale, sd, true in (
            (found.scale_x, found.scale_x_sd, along),
            (found.scale_y, found.scale_y_sd, across),
        ):
            assert abs(scale - true) < 4 * sd
            assert sd < 0.005


def test_a_grating_bounds_the_tip():
    sharp, blunt, bridging = (
        scanned(*(KnobSetting("tip-dilation", radius) for radius in radii))[1].tip_at_most_um
        for radii in ((), (0.8,), (1.8,))
    )
    # Without a tip, the flanks of the bars set the bound. A tip of 0.8 µm has a reach of 0.9 µm.
    assert sharp < 0.4
    assert 0.8 < blunt < 1.25 * 0.8
    # A tip of 1.8 µm bridges the gaps, so the result is only an upper bound.
    assert bridging > 1.8


def test_a_scan_without_a_grating_is_reported_and_not_measured():
    flat = 0.001 * np.random.default_rng(0).standard_normal((192, 192))
    found = grating_scan("G", flat, (0.1, 0.1), KNOWN)
    assert found.bow_um is None
    assert "nothing that repeats every 2 µm" in found.problem


def test_a_grating_is_a_row_of_a_plan_and_a_table_of_the_report(tmp_path):
    plan = tmp_path / "plan"
    plan.mkdir()
    write_layout(plan, "N0F1", np.zeros((128, 128), np.uint8))
    write_layout(plan, "N1F1", random_layout((128, 128), levels=13, pitch_um=0.1, seed=1))
    write_table(plan, ("id", "order", "use"), [("N0F1", 0, "grating"), ("N1F1", 1, "dataset")])
    about = {"pitch_um": 0.1, "level_height_um": 0.1, "levels": 13, "scan_size_um": (12.8, 12.8)}
    tables = {"ids": {"table": TABLE_NAME}, "write": {"slow_axis": "y"}, "grating": {"period_um": 1.0}}
    card = write_card(plan, name="p", title="p", **about, **tables)
    jobs = jobs_of_card(card)
    assert (jobs[0].use, jobs[0].grating_um) == ("grating", 1.0)
    printed = simulate(tmp_path / "fab", jobs=jobs, seed=2, knobs=["piezo-nonlinearity=0.05"])
    build_dataset(printed, tmp_path / "p.zarr")
    store = open_store(tmp_path / "p.zarr")
    assert store.ids == ["N1F1"]
    (found,) = grating_scans(store)
    assert found.bow_um == pytest.approx(0.05 * found.line_um / 4, abs=4 * found.bow_sd_um)
    report = next(tmp_path.glob("p*/report.html"))
    assert "Properties of the microscope from the grating" in report.read_text("utf-8")

    printed.write_text(printed.read_text("utf-8").replace("[grating]\nperiod_um = 1.0", ""), encoding="utf-8")
    with pytest.raises(InputError, match=r"scan N0F1, got no \[grating\]"):
        build_dataset(printed, tmp_path / "q.zarr")
