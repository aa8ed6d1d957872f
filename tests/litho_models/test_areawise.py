"""Check that a frozen PBL predicts the same print as the trained PBL, with and without the border."""

from __future__ import annotations

import pytest
import torch

from litho_models.frozen.files import load_frozen, save_frozen
from litho_models.models import build_model

pytestmark = pytest.mark.numerics


def test_a_frozen_pbl_prints_what_the_trained_one_does(tmp_path):
    torch.manual_seed(0)
    few = {"blurs_um": (0.2,), "slope_blurs_um": (0.1,), "shifts_um": (0.2,), "steep_um": (0.3,)}
    model = build_model("pbl", sigma_diffusion_init_um=0.2, surroundings=few, scan_axis=few)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.03 * torch.randn_like(parameter))
    reach = model.reach_px
    layout = torch.randint(0, 13, (1, 1, 2 * reach + 30, 2 * reach + 40)) * 0.1
    trained = model(layout)
    assert trained.grad_fn is not None
    frozen = load_frozen(save_frozen(model, tmp_path / "pbl"))
    assert torch.allclose(frozen(layout), trained.detach(), atol=1e-6)
    inside = frozen.inside(layout, reach)
    assert inside.shape == (1, 1, 30, 40)
    assert torch.allclose(inside, trained.detach()[..., reach:-reach, reach:-reach], atol=1e-6)
