"""Check that a large element gives the same result as a whole and in bands, on any number of processes."""

from __future__ import annotations

import multiprocessing
import socket
from pathlib import Path

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.exports.files import export, import_levels
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.judging.loaded import load_design
from litho_design.large.bands import Bands
from litho_design.large.hologram import BandedHologram
from litho_design.large.lens import RingLens
from litho_design.large.propagator import BandedPropagator
from litho_design.lenses.settings import lens_settings
from litho_design.lenses.task import lens_task
from litho_design.optics import Optics, centred_grid, make_propagator
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.ranks import Ranks
from litho_design.optimisation.search import search_layout
from litho_design.printers.printer import Printer
from litho_design.tasks.design import LEVELS_FILE, RING_HEIGHT_FILE, RINGS_FILE, Design
from litho_design.workflows.design import design_lens
from litho_design.workflows.score import score
from tests.litho_design import large_rank
from tests.litho_design.conftest import BlurPrinter
from tests.litho_design.large_rank import BAND, SIZE


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """Run the work in a single process and return its folder."""
    folder = tmp_path_factory.mktemp("one")
    large_rank.work(folder, Ranks())
    return folder


@pytest.mark.parametrize(
    ("size", "distance_um", "pitch_um", "kind"),
    [
        (97, 30.0, 0.1, "rayleigh-sommerfeld"),
        (96, 100.0, 0.5, "angular-spectrum"),  # with a period longer than the element
        (96, 1e4, 4.0, "angular-spectrum"),  # with the element as its period
    ],
)
def test_propagation_in_bands_is_that_of_the_whole(size, distance_um, pitch_um, kind):
    optics = Optics(distance_um=distance_um, propagation=kind)
    grid = centred_grid((size, size), pitch_um)
    whole, banded = make_propagator(grid, grid, optics), BandedPropagator(pitch_um, optics, Bands(size, 40))
    draw = torch.Generator().manual_seed(0)
    field, other = (torch.randn(size, size, dtype=torch.complex64, generator=draw) for _ in range(2))
    # A float32 transform has rounding errors of a few 6e-8 · sqrt(log2(192**2)) of the largest amplitude.
    for one, two in ((whole(field), banded(field)), (whole.adjoint(field), banded.adjoint(field))):
        assert (one - two).abs().max() < 1e-6 * one.abs().max()
    field.requires_grad_()
    (slope,) = torch.autograd.grad((banded(field).conj() * other).sum().real, field)
    assert torch.equal(slope, banded.adjoint(other))


def test_loss_and_gradient_in_bands_are_those_of_the_whole():
    settings, printer = large_rank.settings(), large_rank.printer()
    target = load_target("ring", SIZE)
    level = (12 * torch.rand(1, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))).requires_grad_()
    found = []
    for task in (
        HologramTask(settings, printer, inputs={"target": target.pixels}),
        BandedHologram(settings, printer, Bands(SIZE, BAND, cell_px=4), inputs={"target": target.pixels}),
    ):
        loss, _ = task.objective(level)
        found.append((loss.detach(), torch.autograd.grad(loss, level)[0]))
    (loss, slope), (banded_loss, banded_slope) = found
    assert banded_loss == pytest.approx(float(loss), rel=1e-6)
    # The transforms have float32 rounding errors, as above.
    assert (slope - banded_slope).abs().max() < 1e-6 * slope.abs().max()


@pytest.mark.long
def test_ranks_give_the_layout_of_one_process(alone, tmp_path):
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.litho_design.large_rank"])
    running = {}
    for count in (2, 3, 5):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        folder = tmp_path / str(count)
        folder.mkdir()
        given = [(rank, count, port, folder) for rank in range(count)]
        running[count] = [context.Process(target=large_rank.start, args=one) for one in given]
        for process in running[count]:
            process.start()
    wanted, layout = np.load(alone / "0.npz"), np.load(alone / "design" / LEVELS_FILE)
    for count, processes in running.items():
        for process in processes:
            process.join(120)
            assert process.exitcode == 0
        parts = [np.load(tmp_path / str(count) / f"{rank}.npz") for rank in range(count)]
        for name in ("field", "back", "gradient"):
            joined = np.concatenate([part[name] for part in parts])
            assert np.abs(joined - wanted[name]).max() <= 1e-6 * np.abs(wanted[name]).max(), name
        # The sum over pixels is in double precision. Only its terms are rounded to float32.
        assert [float(part["loss"]) for part in parts] == pytest.approx(
            [float(wanted["loss"])] * count, rel=1e-9
        )
        np.testing.assert_array_equal(np.load(tmp_path / str(count) / "design" / LEVELS_FILE), layout)
        assert not list((tmp_path / str(count) / "design").glob("checkpoint*"))


def test_an_interrupted_run_ends_the_same_and_other_checkpoints_are_refused(alone, tmp_path, monkeypatch):
    bands = Bands(SIZE, BAND, cell_px=4)

    def stopped(parameters, objective, *given, **named):
        calls = iter(range(14))

        def interrupted(level):
            if next(calls, None) is None:
                raise KeyboardInterrupt
            return objective(level)

        return search_layout(parameters, interrupted, *given, **named)

    monkeypatch.setattr("litho_design.tasks.run.search_layout", stopped)
    with pytest.raises(KeyboardInterrupt):
        large_rank.design(tmp_path, bands)
    monkeypatch.undo()
    (kept,) = tmp_path.glob("checkpoint*.pt")
    kept.rename(tmp_path / "checkpoint-1-of-2.pt")
    with pytest.raises(InputError, match="another number of processes"):
        large_rank.design(tmp_path, bands)
    (tmp_path / "checkpoint-1-of-2.pt").rename(kept)
    large_rank.design(tmp_path, bands)
    layouts = [np.load(folder / LEVELS_FILE) for folder in (alone / "design", tmp_path)]
    np.testing.assert_array_equal(*layouts)


def test_a_score_in_bands_is_that_of_the_whole(alone, tmp_path):
    design, printer = alone / "design", large_rank.printer()
    (streamed,) = score(design, tmp_path / "bands", judges=[printer], band_px=48).scores
    (whole,) = score(load_design(design), tmp_path / "whole", judges=[printer]).scores
    assert len(streamed.figures) == 10
    for name, value in streamed.figures.items():
        # The waves differ by rounding, 1e-6 of the largest amplitude. The scores are sums of their squares.
        assert value == pytest.approx(whole.figures[name], rel=1e-4, abs=1e-7), name
    assert streamed.rms_height_difference_um == pytest.approx(whole.rms_height_difference_um, abs=1e-7)
    # The record of the design has the same scores, except for the zero order.
    predicted = Design.read(design).predicted
    assert predicted == pytest.approx({name: whole.figures[name] for name in predicted}, rel=1e-4, abs=1e-7)


def test_what_a_large_element_cannot_have_is_refused():
    settings, printer, wide = large_rank.settings(), large_rank.printer(), Bands(SIZE, BAND, cell_px=4)
    inputs = {"target": load_target("ring", SIZE).pixels}
    with pytest.raises(InputError, match="at most one per band"):
        Bands(SIZE, 64, Ranks(0, 4))
    with pytest.raises(InputError, match="rows of a band"):
        BandedHologram(settings, printer, Bands(SIZE, 12, cell_px=4), inputs=inputs)
    thick = settings.model_copy(update={"optics": settings.optics.model_copy(update={"element": "thick"})})
    with pytest.raises(InputError, match=r"optics\.element of a large element"):
        BandedHologram(thick, printer, wide, inputs=inputs)
    far = settings.model_copy(
        update={"optics": settings.optics.model_copy(update={"propagation": "far-field"})}
    )
    with pytest.raises(InputError, match="propagation of a large element, got far-field"):
        BandedHologram(far, printer, wide, inputs=inputs)
    with pytest.raises(InputError, match="0 % of its pixels above half brightness"):
        BandedHologram(settings, printer, wide, inputs={"target": 0.4 * inputs["target"]})
    printer.simulator.reach_um = None
    with pytest.raises(InputError, match="depends on the whole image"):
        BandedHologram(settings, printer, wide, inputs=inputs)


@pytest.mark.parametrize("path", ["radial", "plane"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"optics.incidence_x": 0.3}, "oblique incidence"),
        ({"optics.propagation": "far-field"}, "propagation of a lens"),
        ({"layout.size_px": 101}, "an even number"),
        ({"optics.distance_um": 1.0, "layout.cell_um": 0.4}, "an outermost zone"),
        ({"view.aperture": "square"}, "a ring layout behind a circular aperture"),
    ],
)
def test_a_lens_in_rings_is_checked_like_a_search_along_a_radius(path, change, message):
    small = {"layout.size_px": 100, "optics.distance_um": 40.0, "view.window_px": 64, "view.path": path}
    settings = lens_settings(changes=small | change)
    with pytest.raises(InputError, match=message):
        RingLens(settings, Printer(None, settings.layout, source="none"), 64)


def test_a_lens_in_rings_equals_the_lens_of_the_plane(tmp_path):
    changes = {
        "layout.size_px": 256,
        "optics.distance_um": 40.0,
        "view.window_px": 64,
        "search.iterations": 6,
    }
    settings = lens_settings(changes=changes | {"search.evaluate_every": 2})
    printer = Printer(BlurPrinter(), settings.layout, source="closed form")
    plane, rings = lens_task(settings, printer), RingLens(settings, printer, 48)
    free = 12 * torch.rand(plane.cells.cells, generator=torch.Generator().manual_seed(0))
    radius = rings.cells(free[: rings.cells.cells[0]])[None, None]
    printed = rings.search_print(radius, printer)
    # Outside the aperture, the plane has corners, which affect the print over 8 px. 1e-5 µm is rounding.
    assert (printed - plane.printed_rings(plane.cells(free)[None, None], printer))[:-8].abs().max() < 1e-5
    found, whole = (
        (one.objective(two)[0], one.score(one.bench.ideal_height_um()))
        for one, two in ((rings, radius), (plane, plane.cells(free)[None, None]))
    )
    # A circle of square pixels is compared with true rings: one edge pixel in 128, twice that in power.
    assert found[1].focusing_efficiency == pytest.approx(whole[1].focusing_efficiency, rel=1 / 64)
    assert found[1].fwhm_um == pytest.approx(whole[1].fwhm_um, rel=1 / 64)
    design = design_lens(printer, tmp_path, settings=settings, tile_px=48, announce=False)
    assert design.argmax_loss < design.start_loss
    level, height = (np.load(tmp_path / name) for name in (RINGS_FILE, RING_HEIGHT_FILE))
    assert level.shape == height.shape == (128,)
    again = rings.score(rings.printed_um(torch.from_numpy(level))).model_dump()
    assert design.predicted == pytest.approx(again, rel=1e-6)
    assert 0.2 < design.predicted["strehl"] <= 1
    # The exported plane consists of the rings, with the last ring extended into its corners.
    cells = CellMap(settings.layout)
    ring = torch.from_numpy(level[:: settings.layout.cell_px])
    whole = cells(torch.cat([ring, ring[-1:].expand(cells.cells[0] - len(ring))])).numpy()
    for kind in ("tiff", "gds", "png16"):
        np.testing.assert_array_equal(import_levels(export(tmp_path, kind, tmp_path / kind))[0], whole)
    # The model of the design gives the prediction again. Nominal heights lack the losses of the print.
    own, nominal = score(tmp_path, tmp_path / "score", judges=[printer, "none"]).scores
    assert own.figures == pytest.approx(design.predicted, rel=1e-6)
    assert own.rms_height_difference_um < 1e-6
    area = np.arange(128) + 0.5
    off = settings.layout.level_height_um * level - height
    rms = np.sqrt((off**2 * area).sum() / area.sum())
    assert nominal.rms_height_difference_um == pytest.approx(rms, rel=1e-4)
    changed = settings.model_copy(update={"search": settings.search.model_copy(update={"iterations": 7})})
    with pytest.raises(InputError, match=r"other settings \(search\.iterations"):
        design_lens(printer, tmp_path, settings=changed, tile_px=48, announce=False)
    with pytest.raises(InputError, match="score of a lens in rings, got bands"):
        score(tmp_path, tmp_path / "bands", judges=[printer], band_px=64)
    (tmp_path / RINGS_FILE).write_bytes(b"")
    with pytest.raises(InputError, match="a file that changed after the design"):
        export(tmp_path, "tiff", tmp_path / "again")
