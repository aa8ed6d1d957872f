"""Test lenses: rings against the plane, scores against theory, and a whole design."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.signal import fftconvolve

from litho_data.foundation.errors import InputError
from litho_design.images.targets import draw_target
from litho_design.judging.loaded import LoadedDesign
from litho_design.lenses.bench import CENTRE_UM, LensBench, RadialLensBench, centre_to_background, sensor_psf
from litho_design.lenses.score import half_maximum_width_um, lens_score, mtf, mtf_at
from litho_design.lenses.settings import ImagingSettings, LensView, lens_settings
from litho_design.lenses.task import check_lens, lens_task
from litho_design.optics import Optics, blaze_efficiency
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.workflows.design import design_lens
from litho_design.workflows.score import score as score_design

LAYOUT = LayoutSettings(size_px=300, cell_um=0.1, symmetry="radial")
OPTICS = Optics(distance_um=100.0)


@pytest.fixture
def settings():
    default = lens_settings("direct")
    search = default.search.model_copy(update={"iterations": 20, "polish_rounds": 2})
    view = default.view.model_copy(update={"window_px": 128})
    imaging = default.imaging.model_copy(update={"object_px": 48, "iterations": 10})
    window = default.window.model_copy(update={"yield_draws": 4})
    changes = {"search": search, "view": view, "imaging": imaging, "window": window}
    return default.model_copy(update={"layout": LAYOUT, "optics": OPTICS} | changes)


@pytest.mark.parametrize("aperture", ["circle", "square"])
def test_perfect_lens_reaches_the_diffraction_limit(aperture):
    # A lens of 30 µm at f = 200 µm has a/f = 0.075, where the paraxial formulas are right to 1 %.
    bench = LensBench(LAYOUT, Optics(distance_um=200.0), LensView(aperture=aperture, window_px=254))
    score = lens_score(bench, bench.ideal_height_um())
    assert score.strehl == pytest.approx(1, abs=1e-12)
    assert score.mtf_volume_ratio == pytest.approx(1, abs=1e-12)
    assert score.cbr == pytest.approx(score.cbr_ceiling)
    psf = bench(bench.ideal_height_um())
    area = math.pi * 15**2 if aperture == "circle" else 30**2
    assert float(psf.max()) / LAYOUT.pitch_um**2 == pytest.approx(area / (0.6328 * 200) ** 2, rel=0.01)
    if aperture == "circle":
        # The full width at half maximum of an Airy disc is 1.029 lambda f / D.
        assert score.fwhm_um == pytest.approx(1.029 * 0.6328 * 200 / 30, rel=0.01)
    else:
        # A section of the focus of a square is sinc^2, with a half width of 0.443 lambda f / D.
        row = psf[127] / psf.max()
        half = 0.443 * 0.6328 * 200 / 30
        position = int((half + 0.05) / 0.1)
        assert float(row[126 + position]) > 0.5 > float(row[128 + position])


@pytest.mark.parametrize("direction", [{"incidence_x": 0.2}, {"incidence_x": -0.1, "incidence_y": 0.3}])
def test_a_perfect_lens_is_as_sharp_in_oblique_light(direction):
    layout, view = LayoutSettings(size_px=200, cell_um=0.1), LensView(window_px=64)
    axial, oblique = (LensBench(layout, Optics(distance_um=40.0, **one), view) for one in ({}, direction))
    psf = axial(axial.ideal_height_um())
    assert (oblique(oblique.ideal_height_um()) - psf).abs().max() < 1e-4 * psf.max()


def test_a_perfect_lens_is_thin_even_if_the_element_is_thick(settings):
    """Check at an NA of 0.6, where the slopes of a thick relief cast shadows: a print is compared with the
    same perfect lens, whichever kind of element it is.
    """
    thick_optics, layout = Optics(distance_um=20.0, element="thick"), settings.layout
    thin, thick = (
        lens_task(settings.model_copy(update={"optics": one}), Printer(None, layout, source="none"))
        for one in (Optics(distance_um=20.0), thick_optics)
    )
    height = thin.bench.ideal_height_um()
    figures, shadowed = thin.score(height), thick.score(height)
    for name in ("cbr_ceiling", "fwhm_ideal_um", "focusing_radius_um"):
        assert getattr(shadowed, name) == getattr(figures, name)
    peaks = [float(one.bench(height).max()) for one in (thick, thin)]
    assert shadowed.strehl == pytest.approx(peaks[0] / peaks[1], rel=1e-6)
    assert shadowed.strehl < 0.8
    assert thick.window_figures(thick.bench(height))["strehl"] == pytest.approx(shadowed.strehl, rel=1e-6)
    assert thick.baselines()["perfect lens"]["strehl"] == pytest.approx(1, abs=1e-12)
    # The bench itself stays that of the thick element.
    assert thick.bench.optics == thick_optics


def test_airy_power_inside_the_focusing_radius():
    bench = LensBench(LAYOUT, OPTICS, LensView(window_px=254))
    score = lens_score(bench, bench.ideal_height_um())
    # The encircled energy is 1 - J0^2(v) - J1^2(v) at v = pi D r / (lambda f), where r = 3 FWHM, which is
    # 3.08 lambda f / D.
    from scipy.special import j0, j1

    v = math.pi * 30 * score.focusing_radius_um / (0.6328 * 100)
    assert score.focusing_efficiency == pytest.approx(1 - j0(v) ** 2 - j1(v) ** 2, abs=0.01)


@pytest.mark.parametrize(("levels", "step_um"), [(13, 0.1), (8, 0.1443), (2, 0.57735)])
def test_a_staircase_lens_loses_as_much_as_the_blaze_formula_states(levels, step_um):
    layout = LAYOUT.model_copy(update={"size_px": 600, "levels": levels, "level_height_um": step_um})
    base = lens_settings("direct")
    task = lens_task(
        base.model_copy(
            update={
                "layout": layout,
                "optics": OPTICS,
            }
        ),
        Printer(None, layout, source="none"),
    )
    task.start_jitter_levels = 0.0
    parameters = task.free_parameters()
    height = task.printer(task.cells(parameters.best_levels())[None, None].float())[0, 0]
    strehl = lens_score(task.bench, height).strehl
    # One wave is 11.5 steps of 0.1 µm. A lens with seven zones loses 1 or 2 % more than the formula states.
    steps = {13: 12, 8: 8, 2: 2}[levels]
    assert strehl == pytest.approx(blaze_efficiency(steps, 1.0), abs=0.03)


def test_ring_path_and_plane_path_give_the_same_wave(make_printer):
    view = LensView(window_px=128, path="radial")
    bench, rings = LensBench(LAYOUT, OPTICS, view), RadialLensBench(LAYOUT, OPTICS, view)
    base = lens_settings("direct")
    task = lens_task(
        base.model_copy(update={"layout": LAYOUT, "optics": OPTICS, "view": view}), make_printer(LAYOUT)
    )
    generator = torch.Generator().manual_seed(0)
    smooth = torch.nn.functional.interpolate(
        torch.rand(1, 1, 10, generator=generator) * 12, size=task.cells.cells[0], mode="linear"
    )[0, 0]
    level = task.cells(smooth)[None, None]
    plane = bench(task.printer(level)[0, 0])
    strip = rings(task.printed_rings(level, task.printer))
    # There are three differences: the edge of the disc is a staircase of pixels (1e-3), the layout ends where
    # its circle touches the sides, and rings are flat over 0.1 µm, whereas this print is rough.
    assert float((plane - strip).abs().sum() / plane.sum()) < 0.04


def test_a_printer_that_knows_the_position_is_asked_for_the_whole_plane(settings, make_printer):
    printer = make_printer(LAYOUT)
    printer.simulator.card = {"process_effects": {"vignetting": {"strength": 0.1}}}
    task = lens_task(settings, printer)
    assert not task.radial
    assert "whole plane" in task.notes[0]
    level = torch.full((1, 1, 300, 300), 3.0)
    # The objective uses the print of the whole element, not of a strip.
    centre_px = round(CENTRE_UM / LAYOUT.pitch_um)
    ratio = centre_to_background(task.bench(printer(level)[0, 0]), centre_px, 300)
    assert float(task.objective(level)[0]) == pytest.approx(-math.log(float(ratio)), rel=1e-6)
    assert printer.tiling_check(level, tile_px=64) is None


def test_errors_of_a_computational_lens_by_independent_code(settings, make_printer):
    """Check the errors against a float64 computation in NumPy and SciPy. It covers all steps from the wave to
    the Richardson-Lucy deconvolution.
    """
    computational = settings.model_copy(update={"task": "computational"})
    imaging, n, window, z, wavelength = computational.imaging, 300, 128, 100.0, 0.6328
    bench = LensBench(LAYOUT, OPTICS, settings.view)
    rough = torch.randn(n, n, generator=torch.Generator().manual_seed(0)) * 0.1
    heights = [bench.ideal_height_um() + part * rough for part in (1.0, 0.5)]
    found = lens_task(computational, make_printer(LAYOUT)).score(*heights)

    # Sum the first Rayleigh-Sommerfeld integral directly over the aperture.
    x = (np.arange(n) - (n - 1) / 2) * 0.1
    inside = np.hypot(x[:, None], x[None, :]) < 15
    apart = (np.arange(n + window - 1) - (n + window - 2) / 2) * 0.1
    r = np.sqrt(apart[:, None] ** 2 + apart[None, :] ** 2 + z**2)
    k = 2 * np.pi / wavelength
    kernel = z / (2 * np.pi * r**2) * (1 / r - 1j * k) * np.exp(1j * k * r) * 0.01
    psfs = []
    for height in heights:
        wave = inside * np.exp(1j * k * 0.548 * height.double().numpy())
        seen = np.abs(fftconvolve(wave, kernel, "full")[n - 1 : n - 1 + window, n - 1 : n - 1 + window]) ** 2
        # A sensor pixel is two pixels wide. Their number is odd, with one on the axis.
        part = (seen / inside.sum())[1:-1, 1:-1]
        psfs.append(part.reshape(63, 2, 63, 2).sum((1, 3)))
    ours = sensor_psf(bench(heights[0]), imaging.pixel_px)
    assert np.abs(ours.numpy() - psfs[0]).max() < 1e-5 * psfs[0].max()

    errors: dict[str, list[float]] = {"direct": [], "design": [], "calibrated": []}
    objects = [np.pad(draw_target(name, 36).astype(float), 6) for name in imaging.test_objects]
    for seed in (1000, 1001, 1002):
        noise = torch.randn(2, 48, 48, generator=torch.Generator().manual_seed(seed)).double().numpy()
        for truth, grain in zip(objects, noise, strict=True):
            image = fftconvolve(truth, psfs[0], "same") + imaging.read_noise * grain
            scale = (image * truth).sum() / (image**2).sum()
            errors["direct"].append(np.abs(scale * image - truth).mean())
            for name, psf in (("design", psfs[1]), ("calibrated", psfs[0])):
                seen, mirrored = image.clip(1e-8), psf[::-1, ::-1]
                weight = fftconvolve(np.ones_like(image), mirrored, "same")
                estimate = np.full_like(image, seen.sum() / weight.sum())
                for _ in range(imaging.iterations):
                    ratio = seen / fftconvolve(estimate, psf, "same").clip(1e-8)
                    estimate *= fftconvolve(ratio, mirrored, "same").clip(0) / weight
                errors[name].append(np.abs(estimate - truth).mean())
    for name, values in errors.items():
        # Our code uses float32, with ten divisions by dark images.
        assert getattr(found, f"mae_{name}") == pytest.approx(np.mean(values), rel=1e-4), name
    # Another PSF changes the error by far more than the tolerance.
    assert found.mae_design != pytest.approx(found.mae_calibrated, rel=0.01)


def test_light_thrown_out_of_the_window_counts_as_background():
    psf = torch.zeros(64, 64)
    psf[27:37, 27:37] = 0.004
    bright = centre_to_background(psf, 10, 300)
    assert float(bright) == pytest.approx(0.004 / (0.6 / (300**2 - 100)), rel=1e-5)
    assert float(centre_to_background(psf / 2, 10, 300)) < 0.5 * float(bright)


@pytest.mark.parametrize("pitch_um", [0.05, 0.1, 0.2, 0.3, 0.35])
@pytest.mark.parametrize("window_px", [24, 25])
def test_the_central_box_is_centred_and_has_one_size_at_every_pitch(pitch_um, window_px):
    """Check the light in the box of a linear ramp, which is its value on the axis times 1 µm²."""
    y, x = np.meshgrid(*((np.arange(window_px) - (window_px - 1) / 2) * pitch_um,) * 2, indexing="ij")
    psf = torch.from_numpy((2 + x - 0.5 * y) * 1e-3 * pitch_um**2)
    element_px = 300
    box = 2e-3 * CENTRE_UM**2
    wanted = box * ((element_px * pitch_um) ** 2 - CENTRE_UM**2) / (1 - box)
    ratio = centre_to_background(psf, CENTRE_UM / pitch_um, element_px)
    assert float(ratio) == pytest.approx(wanted, rel=1e-12)
    with pytest.raises(InputError, match="PSF window of a lens"):
        LensBench(LayoutSettings(size_px=64, pitch_um=0.05), OPTICS, LensView(window_px=16))


def test_width_of_a_gaussian():
    x = torch.arange(-40, 40).double() * 0.1
    psf = torch.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 0.8**2))
    assert half_maximum_width_um(psf, 0.1) == pytest.approx(2.3548 * 0.8, abs=0.02)


def test_width_of_a_gaussian_in_an_odd_window():
    # 17 px are padded to 65, not 68, so assuming a quarter of the pitch would make the width 4.6 % too small.
    x = torch.arange(-8, 9).double() * 0.1
    psf = torch.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 0.2**2))
    # Of the samples on the rim of a circle of 0.24 µm radius, half count, which is 2 % of its diameter.
    assert half_maximum_width_um(psf, 0.1) == pytest.approx(2.3548 * 0.2, rel=0.02)


def test_a_window_that_cuts_the_focus_is_reported(settings, make_printer):
    # At NA 0.148, the radius is 3 * 0.514 * 0.6328 / NA = 6.6 µm, but the window is only 12.8 µm wide.
    (note,) = lens_task(settings, make_printer(LAYOUT)).notes
    assert "--window-px 132" in note
    wide = settings.model_copy(update={"view": settings.view.model_copy(update={"window_px": 132})})
    task = lens_task(wide, make_printer(LAYOUT))
    assert task.notes == []
    radius_um = lens_score(task.bench, task.bench.ideal_height_um()).focusing_radius_um
    # Compare the sampled width with the Airy formula in the note.
    assert radius_um == pytest.approx(132 * 0.1 / 2, rel=0.01)


@pytest.mark.parametrize(
    ("objects", "message"),
    [
        ({"objects": ("ring", "text")}, "in the design and in the test"),
        ({"objects": ("face",)}, "not one of"),
        ({"objects": ()}, "are needed"),
        ({"test_objects": ("ring",)}, "are needed"),
    ],
)
def test_objects_of_the_score_are_held_out(objects, message):
    with pytest.raises(ValidationError, match=message):
        ImagingSettings(**objects)


@pytest.mark.parametrize("task", ["direct", pytest.param("computational", marks=pytest.mark.pictures)])
def test_lens_design_improves_and_is_judged_with_both_psfs(tmp_path, settings, make_printer, task):
    settings = settings.model_copy(update={"task": task})
    printer = make_printer(LAYOUT)
    design = design_lens(printer, tmp_path / "design", settings=settings, announce=False)
    assert design.polished_loss <= design.start_loss
    other = make_printer(LAYOUT, sigma_um=0.3, gain=0.5, name="other")
    own, foreign = score_design(tmp_path / "design", tmp_path / "score", judges=[printer, other]).scores
    assert own.figures == pytest.approx(design.predicted, rel=1e-5)
    assert foreign.independent
    assert foreign.figures["strehl"] < own.figures["strehl"]
    if task == "computational":
        # The design uses one PSF for image and deconvolution. For another print, only calibration is right.
        assert own.figures["mae_design"] == pytest.approx(own.figures["mae_calibrated"], rel=1e-6)
        assert foreign.figures["mae_design"] != foreign.figures["mae_calibrated"]
    assert LoadedDesign(tmp_path / "design").target is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layout": LAYOUT.model_copy(update={"symmetry": "none"})}, "ring layout"),
        ({"layout": LAYOUT.model_copy(update={"size_px": 301})}, "even number"),
    ],
)
def test_ring_path_needs_rings(settings, make_printer, change, message):
    changed = settings.model_copy(update=change)
    with pytest.raises(InputError, match=message):
        lens_task(changed, make_printer(changed.layout))


@pytest.mark.parametrize("tilt", [{}, {"incidence_x": 0.25}, {"incidence_x": -0.2, "incidence_y": 0.2}])
@pytest.mark.parametrize("aperture", ["circle", "square"])
def test_the_outermost_zone_is_one_wave_of_the_steepest_path(aperture, tilt):
    """Check the zone against the path that a lens has to correct, at the rim point where it is steepest."""
    half_um, focal_um = 10.0, 20.0
    s = math.hypot(*tilt.values())
    r = half_um * (math.sqrt(2) if aperture == "square" else 1)
    path = [math.hypot(one, focal_um) + s * one for one in (r - 1e-4, r)]
    zone_um = 0.6328 / ((path[1] - path[0]) / 1e-4)

    def check(cell_um, distance_um=focal_um):
        layout = {"layout.size_px": 200, "layout.cell_um": cell_um, "optics.distance_um": distance_um}
        light = {f"optics.{name}": value for name, value in tilt.items()}
        view = {"view.aperture": aperture, "view.path": "plane"}
        check_lens(lens_settings(changes=layout | light | view), radial=False)

    check(0.499 * zone_um)
    with pytest.raises(InputError, match=f"an outermost zone of the lens {zone_um:.3g} µm") as caught:
        check(0.501 * zone_um)
    # The advised distance can be used.
    check(0.501 * zone_um, float(str(caught.value).split("--distance-um ")[1].split()[0]))
    if tilt:
        with pytest.raises(InputError, match="use smaller cells"):
            check(0.6328 / (2 * s) + 0.01)


def test_an_mtf_is_interpolated_linearly_between_samples():
    """Check the MTF of a spot that is wider along one axis. It is the mean of the MTFs along both axes."""
    y, x = np.meshgrid(*(np.arange(32) - 16.0,) * 2, indexing="ij")
    psf, pitch_um = torch.from_numpy(np.exp(-(x**2) / 18 - y**2 / 4.5)), 0.2
    curve = mtf(psf)
    samples = [(curve[0, k] + curve[k, 0]) / 2 for k in range(4)]
    for share in (0.0, 0.25, 0.75):
        wanted = (1 - share) * samples[2] + share * samples[3]
        assert mtf_at(psf, (2 + share) / (32 * pitch_um), pitch_um) == pytest.approx(float(wanted), rel=1e-9)
    # Gaussian spots of 3 and 1.5 px have Gaussian transfer functions.
    closed = [np.exp(-2 * (np.pi * sd * 2 / 32) ** 2) for sd in (3.0, 1.5)]
    assert float(samples[2]) == pytest.approx(np.mean(closed), rel=1e-6)
