"""Check that smaller scan pixels reduce the blur and the delay of the microscope in the fab, the models and a
plan.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from litho_data import build_dataset
from litho_data.cards.tables import read_table
from litho_data.foundation.errors import InputError
from litho_data.layouts.random_layout import random_layout
from litho_data.store import open_store
from litho_data.virtual_fab import simulate
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.knobs import KnobBoard, KnobSetting
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer
from litho_models.effects import FieldContext, get_effect
from litho_models.loop.prepared import prepare_scans
from litho_models.planning.layouts import Limits, score
from litho_models.planning.questions import Question
from litho_models.planning.rivalry import PLAIN, TURNED, Rivalry
from tests.litho_models.loop_scans import base_model, blank_scans
from tests.litho_models.test_next_print import first_print, opened, rival, white

FINE = "with half the pixel size and the same time per pixel"


@pytest.mark.parametrize("pixel_size", [1.0, 0.5])
def test_in_the_fab_the_blur_of_a_scan_is_one_of_its_pixels(pixel_size: float) -> None:
    """Check a blur of two pixels. It is 0.2 µm for pixels of 0.1 µm, and 0.1 µm for pixels of half that
    size.
    """
    boards = KnobBoard([KnobSetting("resampling-blur", 0.2, 1)], 0), KnobBoard([], 0)
    job = Job("a", random_layout((48, 48), seed=1), pixel_size=pixel_size)
    blurred, plain = (
        scan_job(Fab(Printer(), Microscope.aligned(), Noise.off(), board, 0), job).height_um
        for board in boards
    )
    expected = gaussian_filter(plain, 2.0, mode="nearest", truncate=5.0)
    assert np.abs(blurred - expected).max() < 1e-12
    assert np.abs(blurred - plain).max() > 0.01


def test_a_fine_scan_shows_the_surface_of_a_plain_one_at_more_points() -> None:
    level = random_layout((48, 48), seed=1)
    fab = Fab(Printer(), Microscope.aligned(), Noise.off(), KnobBoard([], 0), 0)
    plain, fine = (scan_job(fab, Job("a", level, pixel_size=size)).height_um for size in (1.0, 0.5))
    middle = (slice(8, -8),) * 2
    means = fine.reshape(plain.shape[0], 2, plain.shape[1], 2).mean(axis=(1, 3))
    # The mean of four points a quarter of a pixel away differs by curvature times h² / 16, here 1 nm.
    assert np.abs(means - plain)[middle].max() < 0.003
    assert np.ptp(plain) > 0.2


@pytest.mark.parametrize("name", ["resampling-blur", "feedback-lag"])
def test_effects_that_lag_shrink_with_the_pixels_of_the_scan(name: str) -> None:
    effect = get_effect(name)
    height = torch.rand(1, 1, 32, 32, generator=torch.Generator().manual_seed(1))
    context = FieldContext(height, 0.1, 1.2)
    values = effect.with_values(effect.trials[0])
    halved = dict(values)
    for parameter, power in (("variance_um2", 2), ("length_um", 1)):
        if parameter in halved:
            halved[parameter] *= 0.5**power
    fine = effect(height, values, replace(context, pixel_size=0.5))
    assert torch.allclose(fine, effect(height, halved, context), atol=1e-7)
    assert (fine - effect(height, values, context)).abs().max() > 1e-3


def test_smaller_pixels_tell_a_blur_of_the_resist_from_one_of_the_scan() -> None:
    """Check two blurs with the same formula. Scans with pixels of the usual size cannot tell them apart."""
    blurs = {
        "diffusion-blur": {"variance_um2": 0.04},
        "resampling-blur": {"variance_um2": 0.04},
    }
    question = Question(
        name="diffusion-blur",
        kind="set",
        text="which of two",
        experiment="smaller pixels",
        rivals=[rival(name, {name: values}) for name, values in blurs.items()],
    )
    rivalry, limits = Rivalry(question, base_model(), white()), Limits.of(opened([]), 0.1)
    ways = (PLAIN,), (PLAIN, TURNED), (PLAIN, FINE)
    plain, twice, fine = (score(rivalry, [first_print(limits, ways=one)]) for one in ways)
    assert max(plain, twice) < 0.1
    assert fine > 5


def test_the_pixels_of_a_scan_go_from_the_table_to_the_loop(tmp_path: Path) -> None:
    jobs = [
        Job(f"P{i}F1", random_layout((128, 128), levels=13, seed=i), index=i, pixel_size=size)
        for i, size in enumerate((1.0, 0.5))
    ]
    card = simulate(tmp_path / "fab", jobs=jobs, seed=3)
    assert read_table(card.parent / "scans.csv")["P1F1"]["pixel_size"] == 0.5
    first, second = (np.loadtxt(card.parent / "scans" / f"P{i}F1.txt").shape for i in (0, 1))
    assert second == (2 * first[0], 2 * first[1])
    build_dataset(card, tmp_path / "store.zarr")
    store = open_store(tmp_path / "store.zarr")
    assert [scan.pixel_size for scan in store.scans()] == [1.0, 0.5]
    assert [scan.context.pixel_size for scan in prepare_scans(store.scans())] == [1.0, 0.5]
    assert prepare_scans(blank_scans(1))[0].context.pixel_size == 1.0


def test_pixels_without_a_size_are_refused(tmp_path: Path) -> None:
    table = tmp_path / "scans.csv"
    table.write_text("id,pixel_size\na,0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"pixel_size, got '0', wanted a number from 0\.001 to 1000"):
        read_table(table)
