"""Check that the light outside the signal window of a hologram is not constrained, and that this improves the
image inside the window.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from litho_design import design_hologram, hologram_settings
from litho_design.holograms.loss import counted_pixels, hologram_loss
from litho_design.holograms.settings import HologramLoss

TINY = {
    "layout.size_px": 48,
    "optics.distance_um": 8,
    "search.iterations": 10,
    "search.polish_rounds": 2,
    "window.yield_draws": 2,
    "window.defocus_sd_um": 0.5,
}


def test_light_beyond_the_signal_window_is_free():
    target = torch.zeros(20, 20)
    target[8:12, 8:12] = 1
    settings = HologramLoss(signal_window_um=0.35, efficiency_weight=0.0)
    counted = counted_pixels(target, settings, 0.1)
    # The window extends three pixels beyond the target along the axes, and less along the diagonal.
    assert counted[10, 5]
    assert not counted[10, 4]
    assert not counted[5, 5]
    assert counted_pixels(target, HologramLoss(), 0.1) is None
    image = target / 32
    image[0] = 0.5 / 20
    assert float(hologram_loss(image, target, settings, counted)[0]) == pytest.approx(0, abs=1e-6)
    assert float(hologram_loss(image, target, settings)[0]) > 0.1


def test_a_signal_window_gives_more_likeness_inside_for_less_light(tmp_path):
    """Check that a signal window improves the image inside it, and that its score is reported."""
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
