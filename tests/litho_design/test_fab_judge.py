"""Check that the virtual fab as a judge prints a layout exactly as a run of the fab does."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_data.virtual_fab import simulate
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.knobs import KnobBoard, KnobSetting
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Microscope, Noise
from litho_data.virtual_fab.settings import Printer as FabPrinter
from litho_design.images.targets import load_target
from litho_design.large.bands import require_reach
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.source import load_printer
from litho_design.tasks.design import Design
from litho_design.workflows.design import design_hologram
from litho_design.workflows.score import score as score_design

KNOBS = ("write-order-memory=0.2", "slope-thinning-x=0.4", "edge-bead=0.1")
LAYOUT = LayoutSettings(size_px=64)


def truth_folder(folder, knobs=KNOBS, noise="off"):
    simulate(folder, count=1, size_px=64, seed=3, knobs=knobs, noise=noise)
    return folder / "truth"


def bordered_layout() -> np.ndarray:
    level = np.zeros((64, 64), np.uint8)
    level[8:-8, 8:-8] = np.random.default_rng(0).integers(0, 13, (48, 48))
    return level


def printed_um(truth, level: np.ndarray) -> np.ndarray:
    printer = load_printer(str(truth), LAYOUT, name="fab")
    return printer(torch.from_numpy(level)[None, None].float())[0, 0].numpy()


def test_a_fab_judge_prints_what_the_fab_prints(tmp_path):
    # The layout has level 0 along its edge, so it continues into substrate like the fab's own frame.
    level = bordered_layout()
    board = KnobBoard([KnobSetting.parse(knob) for knob in KNOBS], 3)
    fab = Fab(FabPrinter(), Microscope.aligned(), Noise.off(), board, 3)
    expected = scan_job(fab, Job(id="A", level=level)).clean_um
    # Heights below 2 µm are rounded once to float32, by half of 2^-23 · 2.
    assert np.abs(printed_um(truth_folder(tmp_path / "fab"), level) - expected).max() < 1.3e-7


def test_an_element_stands_alone_on_the_substrate(tmp_path):
    full = np.full((64, 64), 12, np.uint8)
    height = printed_um(truth_folder(tmp_path / "fab", knobs=()), full)
    # If the edge level were continued outwards, the print would be flat.
    assert height[32, 32] - height[0, 32] > 0.2


def test_roughness_is_the_default_noise_and_the_same_for_every_layout(tmp_path):
    rough, smooth = truth_folder(tmp_path / "rough", noise="default"), truth_folder(tmp_path / "smooth")
    flat, other = np.full((64, 64), 6, np.uint8), bordered_layout()
    difference = printed_um(rough, flat) - printed_um(smooth, flat)
    assert np.allclose(difference, printed_um(rough, other) - printed_um(smooth, other), atol=1e-6)
    # The rms over an infinite field is 15.9 nm. A field of 6.4 µm has few patches of its slow part.
    assert difference.std() == pytest.approx(0.0159, rel=0.35)


def test_a_fab_judge_scores_designs_and_is_refused_for_designing(tmp_path, small_settings, make_printer):
    truth = truth_folder(tmp_path / "fab", noise="default")
    layout, target = small_settings.layout, load_target("ring", 128)
    fab = load_printer(str(truth), layout, name="fab")
    with pytest.raises(InputError, match="can only judge"):
        design_hologram(target, fab, tmp_path / "through", settings=small_settings, announce=False)
    search = small_settings.search.model_copy(update={"iterations": 2, "polish_rounds": 0})
    settings = small_settings.model_copy(update={"search": search})
    design_hologram(target, make_printer(layout), tmp_path / "design", settings=settings, announce=False)
    (score,) = score_design(tmp_path / "design", tmp_path / "score", judges=[fab]).scores
    assert score.independent
    assert score.judge.name == "fab"
    assert score.figures != Design.read(tmp_path / "design").predicted


def test_a_fab_is_refused_as_a_judge_in_parts(tmp_path):
    """Check that a fab, whose print depends on the whole layout, prints no bands and no strip of rings."""
    fab = load_printer(str(truth_folder(tmp_path / "fab")), LAYOUT)
    with pytest.raises(InputError, match=r"printer fab .*the whole image.*scored in one piece"):
        require_reach(fab)
    require_reach(load_printer("none", LAYOUT))


def test_fabs_with_other_knobs_have_other_hashes(tmp_path):
    hashes = {
        load_printer(str(truth_folder(tmp_path / str(len(knobs)), knobs=knobs)), LAYOUT).weights_sha256()
        for knobs in ((), KNOBS[:1], KNOBS)
    }
    assert len(hashes) == 3


def test_a_fab_judge_refuses_layouts_that_it_cannot_print(tmp_path):
    truth = truth_folder(tmp_path / "fab")
    with pytest.raises(InputError, match="pitch_um"):
        load_printer(str(truth), LayoutSettings(size_px=64, pitch_um=0.2))
    with pytest.raises(InputError, match="levels of the layout"):
        load_printer(str(truth / "truth.json"), LayoutSettings(size_px=64, levels=20))
    with pytest.raises(InputError, match=r"truth\.json"):
        load_printer(str(tmp_path / "truth.json"), LAYOUT)
