"""Test designs with several models: the formula and the effect of the penalty, and the check of tiles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.score import judge_design
from litho_design.lenses.bench import RadialLensBench
from litho_design.lenses.settings import LensView, lens_settings
from litho_design.optics import Optics
from litho_design.optimisation.parameters import CellMap
from litho_design.optimisation.process_window import disagreement_um
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.tasks.design import LEVELS_FILE, Design
from litho_design.tasks.width import Width
from litho_design.workflows.design import design_hologram, design_lens


def test_disagreement_is_the_rms_spread_without_the_datum():
    pattern = torch.tensor([[1.0, -1.0], [-1.0, 1.0]])
    # Two models give ±0.1 of a pattern of unit rms, one of them 5 µm higher. The spread is 0.1 everywhere.
    apart = torch.stack([0.1 * pattern, -0.1 * pattern + 5])
    assert float(disagreement_um(apart)) == pytest.approx(0.1, rel=1e-5)


def test_rings_are_weighted_by_their_area():
    layout = LayoutSettings(size_px=200, cell_um=0.1, symmetry="radial")
    rings = torch.stack([torch.linspace(0, 1, 100), torch.linspace(0, 1, 100) ** 3])
    bench = RadialLensBench(layout, Optics(distance_um=40.0), LensView(window_px=64))
    plane = CellMap(layout)
    inside = plane(torch.arange(plane.cells[0])) < 100
    spread = torch.nn.functional.pad(rings, (0, plane.cells[0] - 100))
    pixels = torch.stack([plane(profile)[inside] for profile in spread])
    weighted = disagreement_um(rings, bench.propagator.ring_area_um2.float())
    # The rings consist of whole pixels, so the area of the outermost ones is wrong by one per cent.
    assert float(weighted) == pytest.approx(float(disagreement_um(pixels)), rel=0.01)
    assert abs(float(disagreement_um(rings)) / float(weighted) - 1) > 0.05


def test_where_all_models_agree_there_is_no_penalty_and_a_finite_gradient():
    height = torch.rand(8, 8, requires_grad=True)
    spread = disagreement_um(torch.stack([height, height]))
    spread.backward()
    # The square root has a floor of 1e-6 µm.
    assert float(spread.detach()) == pytest.approx(1e-6, rel=1e-3)
    assert torch.isfinite(height.grad).all()


def test_the_penalty_brings_the_models_together(tmp_path, small_settings, make_printer):
    target, layout = load_target("ring", 64), LayoutSettings(size_px=64)
    tiny = {"layout": layout, "optics": Optics(distance_um=12.0)}
    small_settings = small_settings.model_copy(update=tiny)

    def models() -> tuple[Printer, Printer]:
        return make_printer(layout, sigma_um=0.2), make_printer(layout, sigma_um=0.35, name="wide")

    def waves(folder: Path) -> float:
        level = torch.from_numpy(np.load(folder / LEVELS_FILE)).float()[None, None]
        apart_um = disagreement_um(torch.stack([one(level)[0, 0] for one in models()]))
        return float(apart_um) / small_settings.optics.wave_height_um

    apart = {}
    for weight in (0.0, 20.0):
        ensemble = small_settings.ensemble.model_copy(update={"weight": weight})
        settings = small_settings.model_copy(update={"ensemble": ensemble})
        main, other = models()
        design = design_hologram(
            target,
            main,
            tmp_path / f"{weight:g}",
            settings=settings,
            judges=[other],
            robust=True,
            announce=False,
        )
        assert design.width.searched_with == 2
        assert Design.read(tmp_path / f"{weight:g}") == design
        apart[weight] = waves(tmp_path / f"{weight:g}")
    assert apart[20.0] < 0.8 * apart[0.0]
    # The loss is that of the worst member plus the weighted disagreement in waves.
    main, other = models()
    inputs = {"target": target.pixels}
    level = torch.from_numpy(np.load(tmp_path / "0" / LEVELS_FILE)).float()[None, None]
    alone = [float(HologramTask(small_settings, p, inputs=inputs).objective(level)[0]) for p in (main, other)]
    for weight in (0.0, 3.0):
        wanted = max(alone) + weight * apart[0.0]
        ensemble = small_settings.ensemble.model_copy(update={"weight": weight})
        settings = small_settings.model_copy(update={"ensemble": ensemble})
        both = HologramTask(settings, main, inputs=inputs, ensemble=[other])
        assert float(both.objective(level)[0]) == pytest.approx(wanted, rel=1e-5)


def test_a_lens_takes_an_ensemble_too(tmp_path, make_printer):
    layout = LayoutSettings(size_px=128, cell_um=0.1, symmetry="radial")
    default = lens_settings("direct")
    settings = default.model_copy(
        update={
            "layout": layout,
            "optics": default.optics.model_copy(update={"distance_um": 40.0}),
            "search": default.search.model_copy(update={"iterations": 4, "polish_rounds": 0}),
            "view": default.view.model_copy(update={"window_px": 64}),
            "window": default.window.model_copy(update={"samples": 2}),
        }
    )
    other = make_printer(layout, sigma_um=0.3, name="wide")
    design = design_lens(
        make_printer(layout), tmp_path, settings=settings, judges=[other], robust=True, announce=False
    )
    assert design.width.searched_with == 2
    assert design.width.disagreement > 0
    # Both models of the search know the layout. Only the third model is independent of it.
    judges = [make_printer(layout), other, make_printer(layout, sigma_um=0.4, name="third")]
    scores = judge_design(LoadedDesign(tmp_path), judges).scores
    assert [one.independent for one in scores] == [False, False, True]
    assert (tmp_path / "window.csv").exists()


def test_tiles_with_a_halo_print_the_same_as_the_whole(make_printer):
    layout = LayoutSettings(size_px=320)
    level = torch.randint(0, 13, (1, 1, 320, 320), generator=torch.Generator().manual_seed(0)).float()
    check = make_printer(layout).tiling_check(level, tile_px=128)
    assert check is not None
    assert check.tiles == 2
    # Heights of 1 µm in float32 are summed over 17 taps in another order.
    assert check.max_nm < 1e-2
    assert make_printer(layout).tiling_check(level, tile_px=320) is None
    assert Printer(None, layout, source="none").tiling_check(level, tile_px=128) is None


def test_a_model_that_depends_on_the_whole_image_is_detected():
    class Normalising(torch.nn.Module):
        name, reach_um, guard_px = "normalising", None, 64

        def forward(self, layout_um, pitch_um):
            return layout_um / layout_um.max()

    layout = LayoutSettings(size_px=256)
    level = torch.full((1, 1, 256, 256), 6.0)
    level[..., 100:104, 250:] = 12.0
    # A height of zero stays zero after normalisation.
    level[..., 40:60, :] = 0.0
    # Tiles that do not contain the high corner are divided by half the height. They print 1 µm where the
    # whole layout prints 0.5 µm.
    check = Printer(Normalising(), layout, source="test").tiling_check(level, tile_px=64)
    assert check.max_nm == pytest.approx(500, rel=1e-5)


def test_models_disagree_most_on_the_level_whose_heights_are_farthest_apart():
    """Check which level has the largest disagreement. The heights of each model are counted from its own
    level 0.
    """
    heights = {"one": [0.1, 0.3, 0.6, 0.7], "two": [0.5, 0.8, 1.4, 1.2]}
    width = Width(searched_with=1, figures={}, returned="", figure="", less=False, level_heights_um=heights)
    assert width.open_level == pytest.approx((2, 0.5, 0.9))
