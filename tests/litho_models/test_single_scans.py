"""Check that errors of individual scans are recognised, and that they are distinguished from errors that all
scans share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from litho_data.register.bend import Bend
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.loop.record import ScanFinding
from litho_models.loop.single_scans import SingleScans
from litho_models.scan_terms import SCAN_TERMS
from litho_models.scan_terms.measurement_fit import learn_measurement
from tests.litho_models.loop_scans import base_model, planted, study_of, with_heights

# Line offsets need two blocks of 32 px, with gaps of the same width on both sides of the scored pixels.
SIZE_PX, SMALL_PX = 160, 64
# A scan line crosses four rows of the layout.
ANGLE = np.deg2rad(1.5)
TURNED = np.array([[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1]])
# These signs depend neither on the print nor on the field. Their standard deviation is 1.05.
SIGNS = (1, -1, -1, 1, 1, 1, -1, 1, -1, -1)
Change = Callable[[PreparedScan, np.random.Generator], np.ndarray]


def truths(scans: Sequence[PreparedScan]) -> list[np.ndarray]:
    twin = Twin.bare(base_model())
    return [twin.height(scan) for scan in scans]


def found_with(
    change: Change, size_px: int = SIZE_PX, *, turned: bool = False, shared_known: bool = False, seed: int = 0
) -> dict[str, ScanFinding]:
    """Return the findings in ten scans. Each scan has its own datum, and ``change`` (in µm) is added to its
    heights.

    If ``shared_known``, the predicted maps already contain what all scans share.
    """
    random = np.random.default_rng(seed)
    scans = planted(size_px=size_px, seed=seed)
    if turned:
        scans = [replace(scan, scan_to_layout=TURNED) for scan in scans]
    heights = [scan.height_um + change(scan, random) for scan in prepare_scans(scans)]
    scans = with_heights(scans, heights)
    study = study_of(scans)
    maps = truths(study.scans)
    if shared_known:
        learned = learn_measurement(scans, maps)
        maps = [learned.expected_um(scan, own) for scan, own in zip(scans, maps, strict=True)]
    return {one.name: one for one in SingleScans(study, maps).findings()}


def seen(found: dict[str, ScanFinding]) -> set[str]:
    return {name for name, one in found.items() if one.seen}


def nothing(scan: PreparedScan, random: np.random.Generator) -> np.ndarray:
    return np.zeros(scan.usable.shape)


def stripes(size_um: float, *, written: bool = False) -> Change:
    """Return a function that draws an offset for each scan line, or for each row of the layout."""

    def change(scan: PreparedScan, random: np.random.Generator) -> np.ndarray:
        line = np.indices(scan.usable.shape)[0] if written else scan.line
        return (size_um * random.normal(size=int(line.max()) + 1))[line]

    return change


def test_the_datum_is_recognised_with_its_spread_and_nothing_else() -> None:
    found = found_with(nothing, SMALL_PX)
    assert seen(found) == {"datum-offset"}
    assert set(found) == {term.effect for term in SCAN_TERMS.values() if term.effect} | {"scars-and-spikes"}
    spread = found["datum-offset"].spread["offset"]
    # Compute the drawn datums. The offset of the base is the same for all scans.
    scans = planted(size_px=SMALL_PX)
    drawn = [
        np.mean(scan.height_um - own) for scan, own in zip(scans, truths(prepare_scans(scans)), strict=True)
    ]
    # White noise of 4 nm gives the mean of 4,096 pixels an error of 0.06 nm.
    assert spread.value == pytest.approx(np.std(drawn, ddof=1), rel=0.02)


def test_stripes_are_told_from_columns_and_not_from_the_rows_that_they_lie_on() -> None:
    found = found_with(stripes(0.004))
    one = found["scan-line-stripes"]
    assert one.seen
    # No scan is rotated, so the printer could also have written these lines.
    assert one.confusable_with == ["line-roughness"]
    assert "line-roughness" not in seen(found)
    assert "cannot be distinguished from scan-line-stripes" in found["line-roughness"].evidence
    # The sd is known from 1,600 lines with noise of 4 / sqrt(64) nm each, measured on the other side.
    assert one.spread["offset of a scan line"].value == pytest.approx(0.004, rel=0.08)
    lines = stripes(0.004)
    both = found_with(lambda scan, random: lines(scan, random) + lines(scan, random).T)
    assert "scan-line-stripes" not in seen(both)


@pytest.mark.parametrize("written", [True, False])
def test_lines_of_the_print_are_told_from_lines_of_the_scan(written: bool) -> None:
    found = found_with(stripes(0.006, written=written), turned=True)
    right, wrong = ("line-roughness", "scan-line-stripes")[:: 1 if written else -1]
    assert right in seen(found)
    assert wrong not in seen(found)
    assert found[wrong].confusable_with == found[right].confusable_with == []
    assert f"more closely, which indicates {right}" in found[wrong].evidence


def test_a_profile_that_all_scans_share_is_not_put_down_to_their_lines() -> None:
    profile = gaussian_filter(np.random.default_rng(8).normal(size=(SIZE_PX, 1)), (2.0, 0.0))
    profile *= 0.008 / profile.std()
    found = found_with(lambda scan, random: profile * np.ones(SIZE_PX))
    assert not seen(found) & {"scan-line-stripes", "line-roughness"}


@pytest.mark.parametrize("shared", [False, True])
def test_a_distortion_belongs_to_the_registration_where_it_differs_between_scans(shared: bool) -> None:
    def bent(scan: PreparedScan, random: np.random.Generator) -> np.ndarray:
        # The rim is displaced by 0.1 µm relative to the middle, with zero mean and equal or varying signs.
        size_um = 0.1 if shared else 0.1 * SIGNS[scan.order]
        height = np.asarray(scan.height_um, np.float64)
        rows, columns = np.indices(height.shape, dtype=float)
        across = np.linspace(-1, 1, height.shape[1])
        moved = columns + size_um * (across**2 - 1 / 3) / scan.pitch_um
        return map_coordinates(height, [rows, moved], order=3, mode="nearest") - height

    found = found_with(bent, SMALL_PX, shared_known=shared)["registration-residual"]
    assert found.seen is not shared
    spread = found.spread["shift x by x² - 1/3"]
    assert spread.unit == "µm"
    # A central difference gives sin(k) / k of a slope, which is 0.84 at a wavelength of 6 px. So the fitted
    # displacement is too large.
    assert (spread.value < 0.01) if shared else (0.105 < spread.value < 0.105 / 0.8)


@pytest.mark.parametrize("of_prints", [True, False])
def test_a_gain_that_goes_with_the_print_is_not_called_the_microscopes(of_prints: bool) -> None:
    """Check five prints of two scans each. The gains of the scans either depend on the print or are mixed."""
    gains = 0.02 * np.repeat([-2, -1, 0, 1, 2], 2)
    gains = gains if of_prints else np.roll(gains, 1)

    def stretched(scan: PreparedScan, random: np.random.Generator) -> np.ndarray:
        height = scan.height_um
        return gains[scan.order] * (height - height.mean())

    one = found_with(stretched, SMALL_PX)["z-gain"]
    assert one.seen
    assert one.role == ("undetermined" if of_prints else "measurement")
    assert one.spread["gain"].value == pytest.approx(np.std(gains, ddof=1), rel=0.05)


def test_scans_of_different_sizes_have_no_profile_in_common_and_are_judged_all_the_same() -> None:
    scans = [scan for size in (64, 80) for scan in planted(count=5, size_px=size, seed=size)]
    scans = [replace(scan, id=f"S{at}", order=at) for at, scan in enumerate(scans)]
    study = study_of(scans)
    found = SingleScans(study, truths(study.scans)).findings()
    assert {one.name for one in found if one.seen} == {"datum-offset"}


@pytest.mark.parametrize("axis", [0, 1])
def test_the_lines_to_which_a_scan_is_compared_are_of_other_folds(axis: int) -> None:
    """Check that the shared lines with which a scan is compared do not depend on the heights of its fold."""
    scans = planted(count=6)
    study = study_of(scans)
    maps = truths(study.scans)
    other = [
        one.height_um + (0.1 * np.indices(one.shape)[axis] if fold == 0 else 0)
        for one, fold in zip(scans, study.fold_of, strict=True)
    ]
    both = [
        SingleScans(replace(study, scans=prepare_scans(own)), maps)._with_profile(axis)
        for own in (scans, with_heights(scans, other))
    ]
    for fold, before, after in zip(study.fold_of, *both, strict=True):
        assert np.array_equal(before, after) == (fold == 0)


def test_marks_are_listed_beside_the_terms() -> None:
    study = study_of(planted(size_px=SMALL_PX))
    maps = truths(study.scans)
    bend = Bend.of_scan(np.array([[0.3, 0, 0], [0, 0, 0]]), (SMALL_PX, SMALL_PX), (0.1, 0.1))
    for bent in (0, 1):
        scans = [replace(one, bend_um=bend) for one in study.scans[:bent]] + [*study.scans[bent:]]
        found = {one.name: one for one in SingleScans(replace(study, scans=scans), maps).findings()}
        assert "scars-and-spikes" in found
        registration = found["registration-residual"]
        assert registration.seen is (bent > 0)
        assert registration.evidence.endswith(f"straightened {bent} of {len(scans)} scans")
