"""Test the marks that are found in raw files and scans without a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from litho_data.register.bend import Bend
from litho_data.store import PrintedScan
from litho_models.loop.marks import marks, rounding_step_um, with_marks
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.record import ScanFinding
from tests.litho_models.loop_scans import blank_scans, with_heights

HEIGHTS = np.random.default_rng(0).normal(0.5, 0.1, size=(80, 90))
# The transform of a scan that is rotated by 90°, so that its lines lie along y.
TURNED = np.array([[0.0, -1.0, 19.2], [1.0, 0.0, 0.0], [0, 0, 1]])


def found_in(
    scans: Sequence[PrintedScan], rounding_um: dict[str, float] | None = None
) -> dict[str, ScanFinding]:
    """Return the marks found in scans of flat layouts."""
    prepared = prepare_scans(scans)
    return {
        one.name: one for one in marks(prepared, [np.zeros(s.shape) for s in scans], rounding_um=rounding_um)
    }


@pytest.mark.parametrize("step_um", [0.001, 0.0268])
def test_the_step_of_rounded_heights_is_read_off(step_um: float) -> None:
    rounded = (np.floor(HEIGHTS / step_um) * step_um + 0.0123).astype(np.float32)
    # A float32 of 1 µm is exact to 6e-8 µm, so a step of 1 nm is known to 1e-4 or better.
    assert rounding_step_um(rounded) == pytest.approx(step_um, rel=1e-3)


def test_heights_that_were_not_rounded_have_no_step() -> None:
    assert rounding_step_um(HEIGHTS.astype(np.float32)) == 0.0
    assert rounding_step_um(np.full((4, 4), np.nan)) == 0.0
    assert rounding_step_um(np.zeros((4, 4))) == 0.0


def test_rounding_counts_by_the_noise_it_adds_and_is_unknown_without_raw_files() -> None:
    scans = blank_scans(2)

    def rounding(step_um: float) -> ScanFinding:
        return found_in(scans, {scan.id: step_um for scan in scans})["quantisation"]

    # Rounding to steps of q adds a variance of q² / 12.
    coarse = rounding(0.012 * np.sqrt(12))
    assert coarse.seen
    assert "12 nm rms" in coarse.evidence
    assert not rounding(0.0001 * np.sqrt(12)).seen
    assert not rounding(0.0).seen
    assert set(found_in(scans)) == {"scars-and-spikes", "line-roughness", "registration-residual"}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("along", [True, False])
def test_scars_are_told_from_marks_across_the_lines(along: bool, turned: bool) -> None:
    grain = 0.05 * (HEIGHTS[:64, :64] - 0.5)
    for start in (12, 30, 44):
        long, short = slice(start, start + 14), slice(start, start + 1)
        grain[(short, long) if along != turned else (long, short)] += 0.2
    scans = blank_scans(10, 64)
    if turned:
        scans = [replace(scan, scan_to_layout=TURNED) for scan in scans]
    one = found_in(with_heights(scans, [grain] * 10))["scars-and-spikes"]
    assert one.seen is along
    assert ("30 outliers are elongated along the scan lines and 0 " in one.evidence) is along


def test_line_shaped_roughness_is_told_from_grain_and_from_offsets_of_whole_lines() -> None:
    scans, random = blank_scans(9, 192), np.random.default_rng(3)
    white = [random.normal(0, 0.02, size=scan.shape) for scan in scans]
    kernel = np.ones(15) / np.sqrt(15)
    lines = [np.apply_along_axis(np.convolve, 1, one, kernel, mode="same") for one in white]

    def seen(heights: list[np.ndarray]) -> ScanFinding:
        return found_in(with_heights(scans, heights))["line-roughness"]

    long = seen(lines)
    assert long.seen
    # A mean of 15 pixels has a correlation of 1 - lag/15, so at lags of 3 to 8 pixels it is 0.63 of 400 nm².
    # Subtracting line means reduces this by at most a tenth (15 of 192 pixels). Across lines it is zero.
    shared = float(long.evidence.split("share ")[1].split(" nm²")[0])
    assert 0.9 * 0.63 * 400 * 0.9 < shared < 0.63 * 400 * 1.1
    assert not seen([one.T for one in lines]).seen
    # Test offsets of whole lines alone, and with grain that hides their exact values.
    offsets = [np.broadcast_to(one[:, :1], one.shape) for one in white]
    assert not seen(offsets).seen
    assert not seen([one.T + own for one, own in zip(white, offsets, strict=True)]).seen


def test_line_shaped_roughness_of_a_turned_scan_lies_along_y() -> None:
    random = np.random.default_rng(3)
    scans = [replace(scan, scan_to_layout=TURNED) for scan in blank_scans(9, 192)]
    kernel = np.ones(15) / np.sqrt(15)
    white = [random.normal(0, 0.02, size=scan.shape) for scan in scans]
    lines = [np.apply_along_axis(np.convolve, 0, one, kernel, mode="same") for one in white]
    assert found_in(with_heights(scans, lines))["line-roughness"].seen


def test_what_registration_straightened_is_told() -> None:
    scans = blank_scans(3, 64)
    bend = Bend.of_scan(np.array([[0.3, 0, 0], [0, 0, 0]]), (64, 64), (0.1, 0.1))
    assert not found_in(scans)["registration-residual"].seen
    one = found_in([replace(scans[0], bend_um=bend), *scans[1:]])["registration-residual"]
    assert one.seen
    # Along x, 0.3 (u² - 1/3) is largest at u = 1, where it is two thirds of 0.3.
    assert "1 of 3 scans, which were bent by up to 0.20 µm" in one.evidence


def test_a_name_that_is_both_a_term_and_a_mark_is_there_if_either_says_so() -> None:
    def finding(evidence: str, *, seen: bool, name: str = "line-roughness") -> ScanFinding:
        return ScanFinding(name=name, title=name, role="nuisance", seen=seen, evidence=evidence, p=None)

    other = finding("offset", seen=True, name="datum-offset")
    for term, mark, first in ((False, True, "mark"), (True, False, "term"), (False, False, "term")):
        both = with_marks([other, finding("term", seen=term)], [finding("mark", seen=mark)])
        assert [one.name for one in both] == ["datum-offset", "line-roughness"]
        assert both[0] == other
        assert both[1].seen is (term or mark)
        assert both[1].evidence == "; ".join(sorted(("term", "mark"), key=lambda one: one != first))
    alone = with_marks([other], [finding("mark", seen=False)])
    assert [(one.name, one.evidence) for one in alone][1] == ("line-roughness", "mark")
