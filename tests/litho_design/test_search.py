"""Check that a search reports only printable results: its layout and its history have whole levels."""

from __future__ import annotations

import pytest
import torch

from litho_design.optimisation.parameters import make_parametrisation
from litho_design.optimisation.search import search_layout
from litho_design.optimisation.settings import SearchSettings
from litho_design.printers.layout import LayoutSettings

LAYOUT = LayoutSettings(size_px=16, cell_um=0.4, levels=5)
# The target is between levels, so a layout of fractional levels would score better than a printable one.
WANTED = torch.linspace(0.6, 3.4, 16)[:, None].expand(16, 16)


def objective(level):
    return (level[0, 0] - WANTED).square().mean(), {}


@pytest.mark.parametrize("keep", ["best", "last"])
@pytest.mark.parametrize("parametrisation", ["direct", "gumbel"])
def test_history_and_kept_layout_are_of_whole_levels(parametrisation, keep):
    """Compare the history with runs of 1, 2 … iterations. Each of these runs ends in the state that a longer
    run has after the same number of iterations.
    """
    told, shown = [], []
    for iterations in range(1, 6):
        # Soft samples are used to the end, and differ much from the printable layout.
        settings = SearchSettings(
            parametrisation=parametrisation, keep=keep, iterations=iterations, evaluate_every=1,
            learning_rate=0.3, temperature_start=1.0, temperature_end=1.0,
        )  # fmt: skip
        parameters = make_parametrisation(LAYOUT, settings)
        parameters.start_random(0)
        state = search_layout(parameters, objective, settings)
        levels = parameters.best_levels()
        assert levels.dtype == torch.int64
        told.append(float(objective(parameters.cells(levels)[None, None].float())[0]))
        shown.append([entry["argmax_loss"] for entry in state.history])
        assert shown[-1] == pytest.approx(told)
        kept = float(objective(parameters.cells(state.best_levels)[None, None].float())[0])
        assert state.best_loss == pytest.approx(kept)
        assert kept == pytest.approx(min(told) if keep == "best" else told[-1])
    samples = [entry["sample_loss"] for entry in state.history]
    # Samples and layouts differ, so the test could fail.
    assert max(abs(one - other) for one, other in zip(samples, told, strict=True)) > 0.01


def test_a_search_takes_the_same_steps_in_height_for_any_number_of_levels():
    """Check searches with different numbers of levels for the same height. They take the same steps in
    height, although the gradients per level differ.
    """
    ways = []
    for levels in (2, 13, 121):
        layout = LayoutSettings(size_px=16, cell_um=0.4, levels=levels)
        settings = SearchSettings(iterations=30, keep="last")
        parameters = make_parametrisation(layout, settings)
        parameters.start_random(0)

        def share_off(level, top=levels - 1):
            return (level[0, 0] / top - WANTED / 4).square().mean(), {}

        search_layout(parameters, share_off, settings)
        ways.append(parameters.height.detach() / (levels - 1))
    # Adam depends on the scale of a gradient only by the 1e-8 added to its size. With 121 levels, this is
    # 1e-4 of the size, and changes each of 30 steps of 1/12 of the height by 1e-4.
    assert all(torch.allclose(way, ways[1], rtol=0, atol=2.5e-4) for way in ways)
