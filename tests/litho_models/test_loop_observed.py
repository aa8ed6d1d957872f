"""What is seen in raw files and as marks in scans, without a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from litho_data.register.bend import Bend
from litho_models.twin.prepared import prepare_scans
from litho_models.loop.probes.defects import find_defects
from litho_models.loop.single_scans.observed import (
    bends,
    line_roughness,
    observe,
    quantisation,
    rounding_step_um,
    scars,
)
from litho_models.loop.study import Study
from tests.litho_models.loop_scans import printed_scans

HEIGHTS = np.random.default_rng(0).normal(0.5, 0.1, size=(80, 90))


@pytest.mark.parametrize("step_um", [0.001, 0.0268])
def test_the_step_of_rounded_heights_is_read_off(step_um) -> None:
    rounded = (np.floor(HEIGHTS / step_um) * step_um + 0.0123).astype(np.float32)
    # Single precision at 1 µm: 6e-8 µm, so the step is known to 1e-4 of 1 nm and better.
    assert rounding_step_um(rounded) == pytest.approx(step_um, rel=1e-3)


FOLDS = np.zeros(10, int)


def test_heights_that_were_not_rounded_have_no_step() -> None:
    assert rounding_step_um(HEIGHTS.astype(np.float32)) == 0.0
    assert rounding_step_um(np.full((4, 4), np.nan)) == 0.0
    assert rounding_step_um(np.zeros((4, 4))) == 0.0


def test_rounding_counts_by_the_noise_it_adds() -> None:
    # Uniform noise of a step q has the variance q² / 12.
    coarse = quantisation([0.012 * np.sqrt(12)] * 3)
    assert coarse.seen
    assert "12 nm rms" in coarse.evidence
    assert not quantisation([0.0001 * np.sqrt(12)] * 3).seen
    assert not quantisation([0.0, 0.0]).seen


def test_scars_are_told_from_marks_across_the_lines() -> None:
    scans = prepare_scans(printed_scans(count=10))
    predictions = [f.stored.height_um.copy() for f in scans]

    def marked(axis: int):
        for scan in scans:
            scan.stored.height_um[:] = predictions[0] * 0 + 0.005 * HEIGHTS[:64, :64]
            for start in (12, 30, 44):
                along, across = slice(start, start + 14), slice(start, start + 1)
                scan.stored.height_um[(across, along) if axis else (along, across)] += 0.2
        return scars(scans, find_defects(scans, [0 * p for p in predictions]))

    assert marked(axis=1).seen
    assert not marked(axis=0).seen


def test_without_raw_files_nothing_is_said_about_rounding() -> None:
    scans = prepare_scans(printed_scans(count=2))
    defects = find_defects(scans, [f.stored.height_um for f in scans])
    terms = frozenset({"offset"})
    predictions = [f.stored.height_um for f in scans]
    without = observe(Study(scans, FOLDS), predictions, terms, defects, None)
    assert set(without) == {"scars-and-spikes", "line-roughness", "registration-residual"}
    assert "quantisation" in observe(
        Study(scans, FOLDS), predictions, terms, defects, {f.id: 0.0 for f in scans}
    )


def test_line_shaped_roughness_is_told_from_grain_and_from_offsets_of_whole_lines() -> None:
    scans = prepare_scans(printed_scans(count=9, size_px=192))
    flat = [np.zeros_like(f.stored.height_um) for f in scans]
    random = np.random.default_rng(3)
    white = [random.normal(0, 0.02, size=p.shape) for p in flat]
    kernel = np.ones(15) / np.sqrt(15)
    lines = [np.apply_along_axis(np.convolve, 1, w, kernel, mode="same") for w in white]

    def seen(added: list[np.ndarray]):
        for scan, extra in zip(scans, added, strict=True):
            scan.stored.height_um[:] = extra
        return line_roughness(Study(scans, FOLDS), flat, frozenset({"offset"}))

    long = seen(lines)
    assert long.seen
    # A mean of 15 pixels keeps 1 - lag/15 of its variance: 3 to 8 pixels apart 0.63 of 400 nm² remain, less
    # what the means of whole lines take along (15 of 192 pixels, a tenth at most); across there is nothing.
    shared = float(long.evidence.split("share ")[1].split(" nm²")[0])
    assert 0.9 * 0.63 * 400 * 0.9 < shared < 0.63 * 400 * 1.1
    assert not seen([e.T for e in lines]).seen
    assert not seen(white).seen
    # Offsets of whole lines alone, and over grain, in which they cannot be known exactly.
    offsets = [np.broadcast_to(w[:, :1], w.shape) for w in white]
    assert not seen(offsets).seen
    assert not seen([w.T + o for w, o in zip(white, offsets, strict=True)]).seen


def test_what_registration_straightened_is_told() -> None:
    scans = printed_scans(count=3)
    bend = Bend.of_scan(np.array([[0.3, 0, 0], [0, 0, 0]]), (64, 64), (0.1, 0.1))
    bent = [replace(scans[0], bend_um=bend), *scans[1:]]
    assert not bends(prepare_scans(scans)).seen
    seen = bends(prepare_scans(bent))
    assert seen.seen
    # Along x, 0.3 (u² - 1/3): largest at u = 1, two thirds of it.
    assert "1 of 3 scans, bent by up to 0.20 µm" in seen.evidence
