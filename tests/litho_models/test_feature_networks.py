"""Check that feature networks separate the print from what the microscope adds along x."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from litho_models.fitting import TrainingConfig, fit_in_cache, pixels
from litho_models.frozen.files import load_frozen
from litho_models.layers import pixelwise
from litho_models.models import build_model
from litho_models.models.pbl import Pbl, PblConfig
from litho_models.prediction.tiles import predict_scan
from tests.litho_models.prints import make_scan, make_scans, printed_height_um

pytestmark = pytest.mark.numerics

FEATURES = {"blurs_um": (0.3,), "slope_blurs_um": (0.1, 0.2), "shifts_um": (0.2, 0.3), "steep_um": (0.4,)}
NARROW = {"sigma_diffusion_init_um": 0.3, "surroundings": FEATURES, "scan_axis": FEATURES}


def narrow(**fields: object) -> Pbl:
    torch.manual_seed(0)
    model = build_model("pbl", **{**NARROW, **fields})
    assert isinstance(model, Pbl)
    return model.eval()


def moved(model: Pbl) -> Pbl:
    """Change every parameter at random, so that every part of the model has an effect."""
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


def layout() -> torch.Tensor:
    return torch.randint(0, 13, (1, 1, 60, 72), generator=torch.Generator().manual_seed(1)) * 0.1


def test_the_printer_does_not_know_x_from_y_and_the_scan_axis_does():
    model = moved(narrow())
    with torch.no_grad():
        turned = [part(layout().mT).mT - part(layout()) for part in (model.printer(), model)]
    # The order of sums differs, so heights of 1 µm differ by 1e-7 of their value.
    assert float(turned[0].abs().max()) < 1e-5
    assert float(turned[1].abs().max()) > 1e-3


def test_a_print_that_is_constant_along_x_is_measured_as_it_is_printed():
    model = moved(narrow())
    field = layout()
    steps_along_y = field[..., :1].expand_as(field).contiguous()
    with torch.no_grad():
        assert torch.allclose(model(steps_along_y), model.printer()(steps_along_y), rtol=0, atol=1e-5)
        assert float((model(field) - model.printer()(field)).abs().max()) > 1e-3


def test_fixed_weights_and_learnt_ones_have_the_same_heights_and_slopes(monkeypatch):
    # There are several blocks of pixels, of which the last is not full.
    monkeypatch.setattr(pixelwise, "_PIXELS_AT_ONCE", 700)
    model, found = moved(narrow()).double(), []
    for learns in (True, False):
        field = layout().double().requires_grad_()
        height = model.requires_grad_(learns)(field)
        pull = torch.rand(height.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
        found.append((height.detach(), *torch.autograd.grad((pull * height).sum(), field)))
    # The sums have some hundred products of order one, in double precision.
    for learnt, fixed in zip(*found, strict=True):
        assert float((fixed - learnt).abs().max()) < 1e-11


def test_a_fit_to_pixels_separates_what_the_microscope_adds_along_x_from_the_print(monkeypatch):
    def lost_um(printed: np.ndarray) -> np.ndarray:
        return 0.15 * np.abs(np.gradient(printed, 0.1, axis=1))

    # With small batches, the fit takes as many steps as with a hundred scans.
    monkeypatch.setattr(pixels, "BATCH_PX", 256)
    scans = []
    for scan in make_scans(5, bow_um=0.02):
        lost = lost_um(printed_height_um(scan.layout_um))
        scans.append(replace(scan, height_um=(scan.height_um - lost).astype(np.float32)))
    model = narrow()
    record = pixels.fit_feature_networks(model, scans, [], TrainingConfig(nuisance="full", steps=7))
    assert record.step == 7 + pixels.EPOCHS * -(-5 * 96**2 // 256)
    # White noise of 4 nm has a mean absolute value of 3.2 nm. The error of the fit adds some nm.
    assert 3.2 < record.training_mae_nm < 2 * 3.2
    unseen = make_scan(20, noise_um=0.0, datum_um=0.0)
    printed = printed_height_um(unseen.layout_um)
    lost = lost_um(printed)

    def error_nm(part: Pbl, truth: np.ndarray) -> float:
        return 1000 * float(np.abs(predict_scan(part, unseen) - truth).mean())

    # Print and scan differ by 15.7 nm. The error of each is below half of that.
    apart = 1000 * float(lost.mean())
    assert error_nm(model, printed - lost) < 0.5 * apart < 0.6 * error_nm(model, printed)
    assert error_nm(model.printer(), printed) < 0.5 * apart < 0.6 * error_nm(model.printer(), printed - lost)


def test_a_finished_chain_is_found_in_the_cache_and_the_networks_are_fitted_to_the_same(tmp_path):
    scans = make_scans(3, size_px=48)
    config = TrainingConfig.of_recipe("fast", "pbl", steps=2, crop_px=32)
    assert config.validation_scans == 0
    first, second = (fit_in_cache("pbl", scans, config, tmp_path) for _ in range(2))
    for (name, a), b in zip(
        first.model.state_dict().items(), second.model.state_dict().values(), strict=True
    ):
        assert torch.equal(a, b), name
    assert first.history[0] == second.history[0]
    assert isinstance(first.model, Pbl)
    # Both the chain and the networks that follow it were trained.
    assert not torch.equal(first.model.tau, build_model("pbl").state_dict()["tau"])
    assert all(
        float(network.linear.weight.detach().abs().max()) > 0 for network in first.model.feature_networks
    )


def test_older_cards_and_the_published_variants_have_the_chain_alone():
    new = ("surroundings", "scan_axis", "transposable")
    card = load_frozen("zoo:pbl").card["hyper_parameters"]
    older = {name: value for name, value in card.items() if name not in new}
    for config in (PblConfig.model_validate(older), PblConfig.of_variant("paper"), PblConfig()):
        model = Pbl(config)
        assert (model.feature_networks, model.printer(), model.chain()) == ([], model, model)
        assert not model.mismatch.transposable
    assert len(Pbl(PblConfig.of_variant("default")).feature_networks) == 2
    with pytest.raises(ValueError, match="replicate"):
        PblConfig.of_variant("paper", surroundings={})
