"""Test the process window: its draws, its risk, and the benefit of a robust search."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design.holograms.bench import HologramBench
from litho_design.holograms.task import HologramTask
from litho_design.images.targets import load_target
from litho_design.optics import Optics
from litho_design.optimisation.process_window import Draw, ProcessWindow, draws, risk
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.tasks.design import HEIGHT_FILE
from litho_design.workflows.design import design_hologram

RING = {"target": load_target("ring", 128).pixels}


def test_draws_have_their_spread_and_repeat():
    window = ProcessWindow(gain_sd=0.05, defocus_sd_um=4.0, wavelength_sd_um=0.001)
    many = draws(window, Optics(), 4000)
    assert draws(window, Optics(), 3) == many[:3]
    # From 4000 draws, a standard deviation has a standard error of 1.1 %.
    assert np.std([draw.gain for draw in many]) == pytest.approx(0.05, rel=0.05)
    assert np.std([draw.optics.distance_um for draw in many]) == pytest.approx(4.0, rel=0.05)
    assert np.std([draw.optics.wavelength_um for draw in many]) == pytest.approx(0.001, rel=0.05)


def test_a_yield_is_of_prints_that_no_search_saw(small_settings, make_printer):
    window = ProcessWindow(samples=16)
    searched, unseen = draws(window, Optics(), 16), draws(window, Optics(), 16, unseen=True)
    assert not {draw.gain for draw in searched} & {draw.gain for draw in unseen}
    assert unseen[:3] == draws(window, Optics(), 3, unseen=True)
    task = HologramTask(small_settings, make_printer(small_settings.layout), inputs=RING)
    height = torch.rand(128, 128, generator=torch.Generator().manual_seed(0))
    told = [score["eff_signal"] for score in task.window_scores(height, 2)]
    seen_by_score = draws(small_settings.window, small_settings.optics, 2, unseen=True)
    for share, draw in zip(told, seen_by_score, strict=True):
        image = HologramBench(small_settings.layout, draw.optics)(draw.apply(height, 0.1))
        assert share == pytest.approx(float(image[task.target > 0.5].sum()), rel=1e-6)


def test_a_spread_without_a_positive_wavelength_is_refused(small_settings, make_printer):
    wide = small_settings.model_copy(update={"window": ProcessWindow(wavelength_sd_um=1.0)})
    with pytest.raises(InputError, match=r"spread of 1 µm.*wavelength-sd-um"):
        HologramTask(wide, make_printer(wide.layout), inputs=RING)


def test_risk_formulas():
    losses = torch.tensor([1.0, 2.0, 3.0, 6.0])
    assert float(risk(losses, 0.5)) == pytest.approx(4.5)
    assert float(risk(losses, 0.01)) == pytest.approx(6)


def test_extra_blur_keeps_the_mean_and_damps_a_wave_by_its_gaussian():
    x = (torch.arange(128) + 0.5) * 0.1
    wave = torch.cos(2 * torch.pi * x / 1.6).double().expand(128, 128)
    blurred = Draw(1.0, 0.0, 0.2, Optics()).apply(wave, 0.1)
    # The factor is exp(-2 pi^2 sigma^2 f^2). The kernel is truncated at four sigma.
    expected = np.exp(-2 * np.pi**2 * 0.2**2 / 1.6**2)
    middle = slice(32, 96)
    assert torch.allclose(blurred[middle, middle], expected * wave[middle, middle], atol=1e-3)


def test_a_spread_that_reaches_the_element_is_refused_before_the_search(
    tmp_path, small_settings, make_printer
):
    # The distance of 1 µm is a third of a standard deviation, so some of 16 draws are behind the element.
    settings = small_settings.model_copy(update={"optics": Optics(distance_um=1.0)})
    with pytest.raises(InputError, match=r"defocus spread of 3 µm.*defocus-sd-um"):
        design_hologram(
            load_target("ring", 128), make_printer(settings.layout), tmp_path / "near", settings=settings
        )
    assert not (tmp_path / "near").exists()
    calm = settings.model_copy(update={"window": ProcessWindow(defocus_sd_um=0.1)})
    HologramTask(calm, make_printer(settings.layout), inputs=RING)


@pytest.mark.parametrize("distance_um", [8.0, 10.0])
def test_an_advised_distance_can_be_used(small_settings, distance_um):
    """Check that a design accepts the distance and the spread that a note or a refusal advises, and that a
    slightly larger spread would be refused.
    """

    def task(distance_um: float, **window: float) -> HologramTask:
        settings = small_settings.model_copy(
            update={
                "layout": LayoutSettings(size_px=64),
                "optics": Optics(distance_um=distance_um),
                "window": ProcessWindow(**window),
            }
        )
        return HologramTask(settings, Printer(None, settings.layout, source="none"), inputs=inputs)

    inputs = {"target": load_target("text", 64).pixels}
    try:
        said = task(distance_um).notes[-1]
    except InputError as refused:
        spread_um = float(re.search(r"--defocus-sd-um ([\d.]+) or less", str(refused))[1])
        said = task(distance_um, defocus_sd_um=spread_um).notes[-1]
    near_um, spread_um = map(float, re.search(r"-um ([\d.]+) with --defocus-sd-um ([\d.]+)", said).groups())
    assert not any("blurred" in note for note in task(near_um, defocus_sd_um=spread_um).notes)
    with pytest.raises(InputError, match=f"--defocus-sd-um {spread_um:g} or less"):
        task(near_um, defocus_sd_um=1.1 * spread_um)


@pytest.mark.long
def test_a_robust_search_lowers_the_risk_it_minimises(tmp_path, small_settings, make_printer):
    spread = ProcessWindow(gain_sd=0.08, blur_sd_um=0.05, defocus_sd_um=2.0, samples=6)
    search = small_settings.search.model_copy(update={"iterations": 60})
    nominal = small_settings.model_copy(update={"search": search})
    robust = nominal.model_copy(update={"window": spread})
    target = load_target("ring", 128)
    risks = {}
    # These draws differ from those of the search, because the benefit must extend to unseen prints.
    unseen = robust.model_copy(update={"window": spread.model_copy(update={"seed": 1})})
    judge = HologramTask(unseen, make_printer(robust.layout), inputs={"target": target.pixels})
    for name, settings in (("nominal", nominal), ("robust", robust)):
        design_hologram(
            target, make_printer(settings.layout), tmp_path / name, settings=settings, announce=False
        )
        height = torch.from_numpy(np.load(tmp_path / name / HEIGHT_FILE))
        losses = torch.tensor([score["loss"] for score in judge.window_scores(height, 24)])
        risks[name] = float(risk(losses, spread.tail))
    assert risks["robust"] < risks["nominal"]
