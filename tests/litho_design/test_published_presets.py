"""Check that the presets ``paper`` and ``authors`` equal the published settings, and that they run."""

from __future__ import annotations

import math
from operator import attrgetter

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.holograms.settings import hologram_settings
from litho_design.large.lens import RadiusMap
from litho_design.lenses.bench import record, sensor_psf
from litho_design.lenses.objects import object_stack
from litho_design.lenses.settings import ImagingSettings, lens_settings
from litho_design.lenses.task import lens_task, strip_rings
from litho_design.optics.imaging import richardson_lucy
from litho_design.optimisation.parameters import CellMap, GumbelLevels, make_parametrisation
from litho_design.optimisation.search import lower_rate, rate_schedule, search_layout
from litho_design.optimisation.settings import SearchSettings
from litho_design.printers.layout import LayoutSettings
from litho_design.workflows.design import design_lens

SEARCH = {
    "parametrisation": "gumbel", "start": "random", "keep": "last", "polish_rounds": 0
}  # fmt: skip


def tau(value):
    return {"search.temperature_start": value, "search.temperature_end": value}


def rate(optimiser, learning_rate, iterations, schedule, factor=None, each=None):
    stated = {
        "optimiser": optimiser, "learning_rate": learning_rate, "iterations": iterations,
        "rate_schedule": schedule, **({"rate_factor": factor, "rate_iterations": each} if each else {}),
    }  # fmt: skip
    return {f"search.{name}": value for name, value in (SEARCH | stated).items()}


HOLOGRAM = {
    "layout.size_px": 1024, "layout.pitch_um": 0.1, "layout.cell_um": 0.4, "layout.level_height_um": 0.1,
    "layout.symmetry": "none", "optics.distance_um": 300.0,
}  # fmt: skip
LENS = {
    "layout.size_px": 1200, "layout.pitch_um": 0.1, "layout.level_height_um": 0.1,
    "layout.symmetry": "radial", "optics.distance_um": 400.0, "view.aperture": "square",
    "view.path": "plane", "imaging.iterations": 50,
}  # fmt: skip
PAPER = {"layout.levels": 13, "optics.wavelength_um": 0.6328, "optics.index_step": 0.548, **tau(0.5)}
AUTHORS = {"layout.levels": 12, "optics.wavelength_um": 0.633, "optics.index_step": 0.545, **tau(1.0)}


@pytest.mark.parametrize(
    ("preset", "stated"),
    [
        (
            hologram_settings("paper"),
            HOLOGRAM | PAPER | rate("adam", 0.1, 1000, "constant") | {"loss.efficiency_weight": 0.1},
        ),
        (
            hologram_settings("authors"),
            HOLOGRAM | AUTHORS | rate("adam", 0.1, 1000, "plateau", 0.1, 10) | {"loss.scale": "paper"},
        ),
        (
            lens_settings("computational", "paper"),
            LENS | PAPER | rate("adamw", 3.0, 1000, "constant")
            | {"imaging.loss": "l1", "layout.cell_um": 0.1},
        ),
        (
            lens_settings("computational", "authors"),
            LENS | AUTHORS | rate("adamw", 1.0, 2000, "step", 0.5, 25)
            | {"imaging.loss": "smooth-l1", "imaging.read_noise": 0.02, "imaging.photon_noise": 0.004},
        ),
    ],
)  # fmt: skip
def test_presets_are_as_stated(preset, stated):
    assert {name: attrgetter(name)(preset) for name in stated} == stated


def test_the_display_is_imaged_at_its_scale():
    """Check the size of images. In the preset ``paper``, a display of 36 mm is imaged from a distance of 140
    mm. In the preset ``authors``, an image is 120 µm wide, as in the published code.
    """
    for variant, image_um in (("paper", 36e3 * 0.4 / 140), ("authors", 120.0)):
        made = lens_settings("computational", variant)
        frame_px, pixel_um = made.imaging.object_px, made.imaging.pixel_px * made.layout.pitch_um
        # The object is inside a dark border, an eighth on each side, in whole pixels of 1 µm.
        assert (frame_px - 2 * (frame_px // 8)) * pixel_um == pytest.approx(image_um, abs=0.5)
        (chart,) = object_stack(["chart"], frame_px)
        lit = chart.amax(0).nonzero()
        assert lit.max() - lit.min() < image_um / pixel_um
        assert made.view.window_px * made.layout.pitch_um == pytest.approx(image_um, abs=0.5)
        # A period at the cut-off frequency is at least two pixels long.
        cut_off_um = made.optics.wavelength_um / (2 * 60 / math.hypot(60, 400))
        assert pixel_um < cut_off_um / 2


@pytest.mark.parametrize("variant", ["paper", "authors"])
def test_a_small_lens_of_each_preset_can_be_searched(variant, make_printer, tmp_path):
    changes = {
        "layout.size_px": 60, "optics.distance_um": 30.0, "view.window_px": 60, "imaging.object_px": 32,
        "imaging.pixel_px": 2, "search.iterations": 3, "window.yield_draws": 2,
    }  # fmt: skip
    made = lens_settings("computational", variant, changes)
    design = design_lens(make_printer(made.layout), tmp_path, settings=made, announce=False)
    assert design.iterations == 3
    assert design.settings["search"] == made.model_dump(mode="json")["search"]


def test_rings_of_the_published_code_are_as_wide_as_the_diagonal_of_a_pixel():
    cells = CellMap(lens_settings("direct", "authors").layout)
    # The corner pixel is 599.5 √2 px from the centre.
    assert cells.cells == (600,)
    y, x = torch.meshgrid(*[torch.arange(1200, dtype=torch.float64) - 599.5] * 2, indexing="ij")
    assert torch.equal(cells.ring, (torch.hypot(y, x) / 2**0.5).long())
    narrow = LayoutSettings(size_px=16, cell_um=0.05, symmetry="radial")
    with pytest.raises(InputError, match="rings at least one pixel"):
        CellMap(narrow)


@pytest.mark.parametrize("cell_um", [0.1, 0.1 * 2**0.5, 0.25, 0.7])
def test_a_strip_along_a_radius_has_the_rings_of_the_plane(cell_um):
    layout = LayoutSettings(size_px=80, cell_um=cell_um, symmetry="radial")
    cells = CellMap(layout)
    strip = strip_rings(layout, 3, cells.cells[0])
    assert torch.equal(strip[3:5, 3:43], cells.ring[39:41, 40:])
    # For a large lens, the radius is along the two central rows.
    along = RadiusMap(layout)
    radius_px = torch.arange(40) + 0.5
    assert torch.equal(along(torch.arange(40)), (radius_px / (cell_um / 0.1)).floor().long())
    rings = torch.arange(float(along.cells[0]))
    assert torch.allclose(along.average(along(rings)), rings)


@pytest.mark.parametrize("temperature", [0.5, 1.0])
def test_a_soft_sample_is_the_expected_level_of_equation_a2(temperature):
    layout = LayoutSettings(size_px=16, cell_um=0.4)
    parameters = GumbelLevels(layout)
    parameters.start_random(1)
    torch.manual_seed(4)
    # -log U is exponential, so the noise of equation A1, -log(-log U), is minus the log of an exponential.
    noise = -torch.empty_like(parameters.logits).exponential_().log()
    weight = ((parameters.logits.detach() + noise).double() / temperature).exp()
    level = (torch.arange(13.0)[:, None, None] * weight).sum(0) / weight.sum(0)
    sample = parameters.sample(temperature, seed=4)[0, 0, ::4, ::4]
    # Levels up to 12 are in float32.
    assert (sample - level).abs().max() < 1e-5


def test_the_learning_rate_falls_at_fixed_times_or_without_progress():
    def rates(losses, **schedule):
        optimiser = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=8.0)
        rate = rate_schedule(optimiser, SearchSettings(**schedule))
        found = []
        for loss in losses:
            found.append(optimiser.param_groups[0]["lr"])
            optimiser.step()
            lower_rate(rate, loss)
        return found

    halved = rates([1.0] * 7, rate_schedule="step", rate_factor=0.5, rate_iterations=3)
    assert halved == [8, 8, 8, 4, 4, 4, 2]
    # After improving, the loss makes no progress for three steps, one more than the two that are allowed.
    waited = rates([3, 2, 1, 1, 1, 1, 1], rate_schedule="plateau", rate_factor=0.1, rate_iterations=2)
    assert waited == pytest.approx([8] * 6 + [0.8])
    # The loss of a direct lens is negative.
    below = rates([-7, -7, -6.9995, -6.999], rate_schedule="plateau", rate_factor=0.5, rate_iterations=1)
    assert below == [8, 8, 8, 4]
    assert rates([1.0] * 3) == [8, 8, 8]


@pytest.mark.parametrize("schedule", ["step", "plateau"])
def test_a_resumed_search_goes_on_with_its_rate(schedule, tmp_path):
    layout = LayoutSettings(size_px=16, cell_um=0.4)
    settings = SearchSettings(
        iterations=24, checkpoint_every=5, keep="last",
        rate_schedule=schedule, rate_factor=0.1, rate_iterations=4,
    )  # fmt: skip
    calls = []

    def run(folder, stop_at=None):
        def objective(level):
            calls.append(None)
            if len(calls) == stop_at:
                raise KeyboardInterrupt
            error = (level - 5.3).abs().mean()
            # The gradient is constant, but the loss makes no progress.
            return error - error.detach() + 1, {}

        calls.clear()
        parameters = make_parametrisation(layout, settings)
        parameters.start_random(3)
        search_layout(parameters, objective, settings, folder=folder)
        return parameters.height.detach()

    whole = run(None)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, stop_at=20)
    assert torch.equal(run(tmp_path), whole)


def test_photon_noise_grows_with_the_signal_and_leaves_the_gradient_alone():
    """Check images made by a point PSF with half of the light. The variance of an image is b² + a ·
    image.
    """
    grey = torch.tensor([0.25, 1.0])[:, None, None].expand(2, 400, 400).clone().requires_grad_()
    imaging = ImagingSettings(read_noise=0.02, photon_noise=0.004)
    seen = record(grey, torch.full((1, 1), 0.5), imaging, seed=1)
    for image, wanted in zip(seen.detach(), (0.125, 0.5), strict=True):
        variance = 0.02**2 + 0.004 * wanted
        # From 160,000 draws, mean and variance agree within five standard errors.
        assert float(image.mean()) == pytest.approx(wanted, abs=5 * math.sqrt(variance / 160_000))
        assert float(image.var()) == pytest.approx(variance, rel=5 * math.sqrt(2 / 160_000))
    seen.sum().backward()
    assert torch.allclose(grey.grad, torch.tensor(0.5))


def test_smooth_l1_is_half_a_square_below_a_tenth(make_printer):
    changes = {
        "layout.size_px": 64, "view.window_px": 32, "imaging.object_px": 32, "imaging.iterations": 3,
        "optics.distance_um": 40.0,
    }  # fmt: skip
    psf = torch.full((32, 32), 1 / 32**2)
    found = {}
    for loss in ("l1", "smooth-l1"):
        settings = lens_settings("computational", changes=changes | {"imaging.loss": loss})
        task = lens_task(settings, make_printer(settings.layout))
        found[loss] = float(task.loss(psf)[0])
    imaging, objects = settings.imaging, task.objects
    kernel = sensor_psf(psf, imaging.pixel_px)
    error = (richardson_lucy(record(objects, kernel, imaging, seed=0), kernel, 3) - objects).abs().double()
    assert 0.1 < (error < 0.1).double().mean() < 0.9
    smooth = torch.where(error < 0.1, error.square() / 0.2, error - 0.05)
    # These are means of 3072 numbers in float32.
    assert found["l1"] == pytest.approx(float(error.mean()), rel=1e-5)
    assert found["smooth-l1"] == pytest.approx(float(smooth.mean()), rel=1e-5)
