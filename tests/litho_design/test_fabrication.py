"""Test the penalty on layouts that are unlike the training layouts, and its effect on a search."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design import design_hologram, hologram_settings
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.training import out_of_distribution, outside
from litho_design.reports.advice import distribution_warning, stroke_advice
from litho_design.tasks.design import LEVELS_FILE

LAYOUT = LayoutSettings(size_px=16, levels=13)


def test_tails_beyond_the_training_layouts_pull_inwards():
    card = {"training_level_share": np.eye(13)[5].tolist(), "training_step_share": [0.9, 0.1]}
    level = torch.full((1, 1, 16, 16), 11.0, requires_grad=True)
    found = outside(level, 13, card)
    # All pixels are six levels above the only level of training, and there are no steps.
    assert float(found.detach()) == pytest.approx(6, rel=1e-5)
    found.backward()
    assert (level.grad > 0).all()
    level = torch.full((1, 1, 16, 16), 2.0, requires_grad=True)
    found = outside(level, 13, card)
    assert float(found.detach()) == pytest.approx(3, rel=1e-5)
    found.backward()
    assert (level.grad < 0).all()
    # All columns differ by two levels, which is half of the pairs. The excess is 0.5 - 0.2 for steps of one
    # level and 0.5 for steps of two.
    stripes = torch.tensor([5.0, 7.0]).repeat(8).expand(1, 1, 16, 16)
    only_steps = {"training_step_share": [0.9, 0.1]}
    assert float(outside(stripes, 13, only_steps)) == pytest.approx(0.8, rel=1e-5)
    assert float(outside(torch.full((1, 1, 16, 16), 5.0), 13, card)) == 0
    assert float(outside(stripes, 13, {})) == 0


def test_unusual_levels_and_steps_are_reported():
    card = {"training_level_share": np.eye(13)[4:7].mean(0).tolist(), "training_step_share": [0.9, 0.1]}
    levels = np.tile(np.repeat([0, 5], 8), (16, 1)).astype(np.uint8)
    found = out_of_distribution(levels, LAYOUT, card)
    # Half of the pixels are at level 5, which is less than twice the third in training. Along x, one of 15
    # steps is 5 levels high.
    assert found.unusual == [
        "level 0: 50 % of the pixels, 0 % in the training layouts",
        "steps of 5 levels: 3.3 % of the neighbouring pixels, 0 % in the training layouts",
    ]
    found = out_of_distribution(np.tile(np.array([5, 9], np.uint8), (16, 8)), LAYOUT, card)
    assert found.step_distance == pytest.approx(0.5)
    assert found.flagged


def test_a_flagged_design_says_so_and_a_search_that_stays_inside_is_closer(tmp_path):
    changes = {
        "layout.size_px": 64,
        "optics.distance_um": 8,
        "search.iterations": 20,
        "search.polish_rounds": 2,
        "window.yield_draws": 2,
        "window.defocus_sd_um": 0.5,
    }

    def designed(name, **more):
        settings = hologram_settings(changes=changes | more)
        alone = {"judges": (), "announce": False}
        return design_hologram("ring", "zoo:physics", tmp_path / name, settings=settings, **alone)

    free = designed("free")
    gauge = free.out_of_distribution
    assert gauge.flagged
    assert "steps of" in distribution_warning(free)
    kept = designed("kept", **{"fabrication.inside_weight": 0.5})
    assert not kept.out_of_distribution.flagged
    assert kept.out_of_distribution.level_distance < gauge.level_distance
    with pytest.raises(InputError, match="other settings"):
        designed("free", **{"fabrication.inside_weight": 0.8})


@pytest.mark.parametrize(
    ("source", "files", "told"),
    [("folder", [LEVELS_FILE], True), ("folder", [], False), ("none", [LEVELS_FILE], False)],
)
def test_an_unknown_distance_to_training_is_reported(source, files, told):
    printer = SimpleNamespace(source=source, name="own")
    design: Any = SimpleNamespace(out_of_distribution=None, printer=printer, files=files)
    assert ("model own does not describe" in distribution_warning(design)) is told


@pytest.mark.parametrize("known", [True, False])
def test_what_a_full_wave_needs_is_told_where_something_reaches_it(known):
    stroke = SimpleNamespace(stroke_waves=0.6, print_gain=0.7, blaze_order_1=0.5, blaze_order_0=0.25)
    stroke.levels_for_one_wave, stroke.level_height_for_one_wave_um = (21, 0.166) if known else (None, None)
    layout = SimpleNamespace(level_height_um=0.1, levels=13)
    design: Any = SimpleNamespace(stroke=stroke, out_of_distribution=None, layout=layout)
    said = stroke_advice(design)
    assert "0.60 waves above that of the lowest (0.70 times the nominal height)" in said
    assert "50.0 % of the light into the first order and 25.0 % straight through" in said
    assert ("A full wave needs 21 levels of 0.1 µm, or 13 levels of 0.166 µm." in said) is known
