"""Check that a GPU gives the same waves, designs and scores as the processor."""

from __future__ import annotations

import pytest
import torch

from litho_design.images.targets import load_target
from litho_design.large.bands import Bands
from litho_design.large.hologram import BandedHologram
from litho_design.lenses.settings import lens_settings
from litho_design.optics import ASMPropagator, RadialPropagator, RSPropagator, centred_grid
from litho_design.printers.layout import LayoutSettings
from litho_design.workflows.design import design_hologram, design_lens
from litho_design.workflows.score import score as score_design
from tests.litho_design import large_rank

GPU = "cuda"
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no GPU")

GRID = centred_grid((32, 32), 0.1)
TARGETS = {
    "same": GRID,
    "rational": centred_grid((20, 33), 0.15, (5.0, 0.0)),
}


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.complex64, 1e-5), (torch.complex128, 1e-10)])
@pytest.mark.parametrize("name", [*TARGETS, "asm", "radial"])
def test_waves_are_the_same(name, dtype, tolerance):
    if name == "asm":
        propagate = ASMPropagator(GRID, GRID, 10.0, 0.6328, dtype=dtype)
    elif name == "radial":
        propagate = RadialPropagator(32, 0.1, torch.linspace(0, 5, 20), 30.0, 0.6328, dtype=dtype)
    else:
        propagate = RSPropagator(GRID, TARGETS[name], 30.0, 0.6328, dtype=dtype)
    shape = (32,) if name == "radial" else (32, 32)
    field = torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(0)).requires_grad_()
    wave = propagate(field)
    (slope,) = torch.autograd.grad(wave.abs().square().sum(), field)
    there = field.detach().to(GPU).requires_grad_()
    wave_there = propagate.to(GPU)(there)
    (slope_there,) = torch.autograd.grad(wave_there.abs().square().sum(), there)
    for one, other in ((wave, wave_there), (slope, slope_there)):
        assert (one - other.cpu()).abs().max() < tolerance * one.abs().max()


def test_a_large_hologram_has_the_same_gradient():
    found = []
    for device in ("cpu", GPU):
        printer, settings = large_rank.printer().to(device), large_rank.settings()
        inputs = {"target": load_target("ring", large_rank.SIZE).pixels}
        bands = Bands(large_rank.SIZE, large_rank.BAND, cell_px=4)
        shape = (1, 1, large_rank.SIZE, large_rank.SIZE)
        level = 12 * torch.rand(shape, generator=torch.Generator().manual_seed(0))
        level = level.to(device).requires_grad_()
        loss, _ = BandedHologram(settings, printer, bands, inputs=inputs).objective(level)
        found.append([float(loss.detach()), torch.autograd.grad(loss, level)[0].cpu()])
    (loss, slope), (loss_there, slope_there) = found
    # Convolutions on a GPU may round their factors to 10 bits.
    assert loss_there == pytest.approx(loss, rel=1e-2)
    assert (slope - slope_there).abs().max() < 1e-2 * slope.abs().max()


@pytest.mark.parametrize("parametrisation", ["direct", "gumbel"])
@pytest.mark.parametrize("start", ["random", "wgs"])
def test_a_hologram_is_designed_and_scores_the_same(
    tmp_path, small_settings, make_printer, parametrisation, start
):
    changes = {"parametrisation": parametrisation, "start": start, "iterations": 10}
    settings = small_settings.model_copy(
        update={
            "search": small_settings.search.model_copy(update=changes),
            "window": small_settings.window.model_copy(update={"samples": 2}),
        }
    )
    printer = make_printer(settings.layout).to(GPU)
    other = make_printer(settings.layout, sigma_um=0.3, name="wide").to(GPU)
    design = design_hologram(
        load_target("ring", 128),
        printer,
        tmp_path / "d",
        settings=settings,
        judges=[other],
        robust=True,
        announce=False,
    )
    assert design.run.device.startswith(GPU)
    assert design.polished_loss < design.start_loss
    # Convolutions on a GPU may round their factors to 10 bits. Heights may differ by a nanometre, and scores
    # by one per cent.
    (score,) = score_design(tmp_path / "d", tmp_path / "s", judges=[make_printer(settings.layout)]).scores
    assert score.figures == pytest.approx(design.predicted, rel=1e-2, abs=1e-3)


@pytest.mark.parametrize("path", ["radial", "plane"])
def test_a_lens_is_designed_and_scores_the_same(tmp_path, make_printer, path):
    layout = LayoutSettings(size_px=128, cell_um=0.1, symmetry="radial")
    default = lens_settings("computational")
    settings = default.model_copy(
        update={
            "layout": layout,
            "optics": default.optics.model_copy(update={"distance_um": 40.0}),
            "search": default.search.model_copy(update={"iterations": 4, "polish_rounds": 1}),
            "view": default.view.model_copy(update={"window_px": 64, "path": path}),
            "imaging": default.imaging.model_copy(update={"object_px": 32, "iterations": 10}),
        }
    )
    design = design_lens(make_printer(layout).to(GPU), tmp_path / "d", settings=settings, announce=False)
    assert design.run.device.startswith(GPU)
    assert design.polished_loss <= design.start_loss
    # The same tolerances as for the hologram apply.
    (score,) = score_design(tmp_path / "d", tmp_path / "s", judges=[make_printer(layout)]).scores
    assert score.figures == pytest.approx(design.predicted, rel=1e-2, abs=1e-3)
