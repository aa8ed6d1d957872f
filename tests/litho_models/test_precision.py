"""Check that a frozen model predicts in the chosen precision, and warns if that is slower here."""

from __future__ import annotations

import pytest
import torch

from litho_models import load_frozen, save_frozen
from litho_models.fitting import TrainingConfig, fit
from litho_models.layers import precision as precisions
from litho_models.layers.precision import has_bfloat16_unit
from litho_models.models import build_model
from tests.litho_models.prints import make_scans

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("rough_networks")]

LAYOUT_UM = 0.1 * torch.randint(0, 13, (1, 1, 96, 96), generator=torch.Generator().manual_seed(0))
SHRINKAGE = {"vertical-shrinkage": {"fraction": 0.1}}
WARNING = "run in bfloat16, but this processor has no bfloat16 unit: float32 is faster"


@pytest.fixture(scope="module")
def pbl():
    torch.manual_seed(0)
    model = build_model("pbl", sigma_diffusion_init_um=0.2)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.03 * torch.randn_like(parameter))
    return model


def off_by(value: torch.Tensor, reference: torch.Tensor) -> float:
    return float((value - reference).norm() / reference.norm())


@pytest.mark.parametrize("effects", [{}, SHRINKAGE])
def test_precision_holds_inside_the_block_and_nowhere_else(effects, pbl, tmp_path):
    frozen = load_frozen(save_frozen(pbl, tmp_path / "pbl", process_effects=effects))

    def printed() -> tuple[torch.Tensor, torch.Tensor]:
        layout = LAYOUT_UM.clone().requires_grad_()
        height = frozen(layout)
        assert height.dtype == torch.float32
        return height.detach(), torch.autograd.grad(height.square().sum(), layout)[0]

    before = printed()
    with frozen.at_precision("bfloat16"):
        reduced = printed()
        with frozen.at_precision("float32"):
            inner = printed()
        assert off_by(printed()[0], reduced[0]) < 1e-6
    assert off_by(inner[0], before[0]) < 1e-6
    with pytest.raises(KeyError), frozen.at_precision("bfloat16"):
        raise KeyError
    assert max(off_by(a, b) for a, b in zip(printed(), before, strict=True)) < 1e-6
    # bfloat16 rounds the products of five layers by up to 2^-9. What bypasses these layers is exact.
    assert 1e-5 < off_by(reduced[1], before[1]) < 0.03
    assert 1e-5 < off_by(reduced[0], before[0]) < 0.01


def test_a_frozen_model_states_its_tile_and_reach_also_with_effects(pbl, tmp_path):
    fno = build_model("fno")
    for model in (pbl, fno):
        plain = load_frozen(save_frozen(model, tmp_path / model.name))
        assert plain.tile == model.tile
        assert plain.reach_um == model.reach_um
    with_effects = load_frozen(save_frozen(fno, tmp_path / "effects", process_effects=SHRINKAGE))
    assert with_effects.tile == fno.tile
    assert with_effects.reach_um is None
    layout = torch.rand(1, 1, 150, 150)
    assert torch.equal(with_effects.inside(layout, 5), with_effects(layout)[..., 5:-5, 5:-5])


@pytest.mark.parametrize(
    ("found", "has_unit"),
    [({"avx512_f": True, "avx512_bf16": False}, False), ({"amx_bf16": True}, True), ({"bf16": True}, True)],
)
def test_the_unit_is_told_by_what_pytorch_finds(found, has_unit, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: found)
    assert has_bfloat16_unit() == has_unit


@pytest.mark.parametrize("has_unit", [False, True])
def test_a_precision_that_loses_here_is_warned_of_once(has_unit, pbl, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(precisions, "has_bfloat16_unit", lambda: has_unit)
    precisions._say.cache_clear()
    frozen = load_frozen(save_frozen(pbl, tmp_path / "pbl"))
    for precision in ("float32", "bfloat16", "bfloat16"):
        with frozen.at_precision(precision):
            frozen(LAYOUT_UM)
    told = [] if has_unit else [f"networks {WARNING}"]
    assert capsys.readouterr().err.splitlines() == told
    precisions._say.cache_clear()
    settings = {"steps": 2, "rounds": 1, "batch": 1, "crop_px": 16, "validation_scans": 0}
    for precision in ("32-true", "bf16-mixed"):
        fit("pbl", make_scans(2, size_px=32), TrainingConfig(**settings, precision=precision))
    assert capsys.readouterr().err.splitlines() == told
