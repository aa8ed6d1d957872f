"""Trade-offs of a hologram: the front of efficiency against likeness, and the signal window."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_design import design_hologram, hologram_settings
from litho_design.cli.app import main
from litho_design.holograms.loss import HologramLoss, counted_pixels, hologram_loss
from litho_design.judging.front import FrontResult
from litho_design.workflows import front
from litho_design.workflows.front import efficiency_front

TINY = {
    "layout.size_px": 48,
    "optics.distance_um": 8,
    "search.iterations": 10,
    "search.polish_rounds": 2,
    "window.yield_draws": 2,
    "window.defocus_sd_um": 0.5,
}


@pytest.mark.pictures
def test_the_front_trades_efficiency_for_likeness(tmp_path, monkeypatch, capsys):
    words = ["hoe", "--model", "none", "--target", "ring", "--front", "0,3", "--out", str(tmp_path)]
    words += [word for path, value in TINY.items() for word in ("--set", f"{path}={value}")]
    monkeypatch.setattr(sys, "argv", ["litho-design", *words])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    alike, bright = FrontResult.read(tmp_path).points
    assert (alike.efficiency_weight, bright.efficiency_weight) == (0, 3)
    assert bright.eff_signal > alike.eff_signal
    assert alike.si_psnr_db > bright.si_psnr_db
    assert alike.on_front
    assert bright.on_front
    assert f"{alike.si_psnr_db:.2f} dB" in capsys.readouterr().out
    assert (tmp_path / alike.folder / "report.html").exists()
    assert "efficiency_weight" in (tmp_path / "front.csv").read_text()
    with pytest.raises(InputError, match="two or more"):
        efficiency_front("ring", "none", tmp_path / "other", weights=(0.1, 0.1))


def test_a_point_is_on_the_front_unless_another_is_as_good_in_both_figures(tmp_path, monkeypatch):
    figures = {0.0: (20.0, 0.1), 0.1: (18.0, 0.3), 1.0: (17.0, 0.2), 3.0: (12.0, 0.3)}

    def made(function, jobs, *given, **named):
        for job in jobs:
            psnr, share = figures[job[0]]
            yield job, SimpleNamespace(predicted={"si_psnr_db": psnr, "eff_signal": share}, baselines=None)

    monkeypatch.setattr(front, "run_jobs", made)
    monkeypatch.setattr(front, "write_front_report", lambda *given: None)
    points = efficiency_front("ring", "none", tmp_path, weights=list(figures)).points
    assert [point.on_front for point in points] == [True, True, False, False]


def test_light_beyond_the_signal_window_is_free():
    target = torch.zeros(20, 20)
    target[8:12, 8:12] = 1
    settings = HologramLoss(signal_window_um=0.35, efficiency_weight=0.0)
    counted = counted_pixels(target, settings, 0.1)
    # Three pixels away along the axes, not along the diagonal.
    assert counted[10, 5]
    assert not counted[10, 4]
    assert not counted[5, 5]
    assert counted_pixels(target, HologramLoss(), 0.1) is None
    image = target / 32
    image[0] = 0.5 / 20
    assert float(hologram_loss(image, target, settings, counted)[0]) == pytest.approx(0, abs=1e-6)
    assert float(hologram_loss(image, target, settings)[0]) > 0.1


def test_a_signal_window_buys_likeness_inside_with_light(tmp_path):
    """The start and the search use the freedom; both figures are told, for the baselines too."""
    made, size = {}, {"layout.size_px": 64, "optics.distance_um": 12, "search.iterations": 15}
    for name, window_um in (("whole", 0.0), ("window", 0.5)):
        loss = {"loss.signal_window_um": window_um, "loss.efficiency_weight": 0}
        settings = hologram_settings(changes=TINY | size | loss)
        made[name] = design_hologram("ring", "none", tmp_path / name, settings=settings, announce=False)
    inside = made["window"].predicted["si_psnr_window_db"]
    assert "si_psnr_window_db" not in made["whole"].predicted
    target = torch.from_numpy(np.load(tmp_path / "whole" / "target.npy"))
    counted = counted_pixels(target, HologramLoss(signal_window_um=0.5), 0.1).numpy()
    seen, wanted = (np.load(tmp_path / "whole" / f)[counted] for f in ("image_share.npy", "target.npy"))
    scale = (seen * wanted).sum() / (seen**2).sum()
    assert inside > -10 * np.log10(((scale * seen - wanted) ** 2).mean()) + 1
    assert made["window"].predicted["eff_signal"] < made["whole"].predicted["eff_signal"]
    assert "si_psnr_window_db" in made["window"].baselines["continuous phase"]
