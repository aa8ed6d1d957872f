"""Check that effects act in the order of their stages, and that designs see no measurement effect."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_models.effects import CATALOGUE
from litho_models.effects.chain import EffectChain
from litho_models.effects.films import FILM_LAWS
from litho_models.frozen.files import load_frozen, save_frozen
from litho_models.models import build_model

pytestmark = pytest.mark.numerics

LAYOUT = (torch.rand(1, 1, 40, 40, generator=torch.Generator().manual_seed(0)) * 12).floor() / 10
_MODELLED = {one.name: one for one in (*CATALOGUE.values(), *FILM_LAWS.values()) if not one.per_scan}
MEASUREMENT = [e for e in CATALOGUE.values() if e.role == "measurement" and not e.per_scan]


def chain_of(effects: dict[str, dict[str, float]]) -> EffectChain:
    base = build_model("physics", sigma_diffusion_init_um=0.3)
    return EffectChain(base, effects)


def test_without_effects_the_chain_is_the_base_bit_for_bit() -> None:
    chain = chain_of({})
    assert torch.equal(chain(LAYOUT), chain.base(LAYOUT))


def test_effects_act_in_the_order_of_the_catalogue_whatever_the_order_given() -> None:
    effects = {"height-saturation": {"rate_per_um": 0.3}, "vignetting": {"strength": 0.2}}
    turned = dict(reversed(effects.items()))
    assert torch.equal(chain_of(effects)(LAYOUT), chain_of(turned)(LAYOUT))
    chain = chain_of(effects)
    by_hand = CATALOGUE["vignetting"](LAYOUT, {"strength": 0.2}, _context())
    by_hand = CATALOGUE["height-saturation"](chain.base(by_hand), {"rate_per_um": 0.3}, _context())
    assert torch.equal(chain(LAYOUT), by_hand)


@pytest.mark.parametrize("effect", MEASUREMENT, ids=[e.name for e in MEASUREMENT])
def test_no_measurement_effect_changes_the_process_model(effect, tmp_path) -> None:
    process = {"vignetting": {"strength": 0.1}}
    typical = {name: p.typical for name, p in effect.parameters.items()}
    on, off = chain_of({**process, effect.name: typical}), chain_of(process)
    assert not torch.equal(on(LAYOUT), off(LAYOUT))
    measured = {effect.name: on.values[effect.name]}
    save_frozen(on.base, tmp_path / "model", process_effects=off.values, measurement_effects=measured)
    assert torch.equal(load_frozen(tmp_path / "model")(LAYOUT), off(LAYOUT).detach())
    with pytest.raises(InputError, match=f"{effect.name}, whose role is measurement"):
        save_frozen(on.base, tmp_path / "other", process_effects=on.values)


def test_a_corrected_model_freezes_and_loads_to_the_same_heights(tmp_path) -> None:
    chain = chain_of({"galvo-lag": {"length_um": 0.2, "direction": -1.0}})
    save_frozen(chain.base, tmp_path / "model", process_effects=chain.values)
    loaded = load_frozen(tmp_path / "model")
    assert torch.equal(loaded(LAYOUT), chain(LAYOUT).detach())


@pytest.mark.parametrize("name", [*_MODELLED])
def test_a_batch_of_two_layouts_gives_the_two_single_prints(name) -> None:
    typical = {key: p.typical for key, p in _MODELLED[name].parameters.items()}
    chain = EffectChain(build_model("affine"), {name: typical})
    two = torch.cat([LAYOUT, LAYOUT.flip(-1) / 2]).requires_grad_()
    heights = chain(two)
    assert torch.equal(heights, torch.cat([chain(two[:1]), chain(two[1:])]))
    slopes = torch.autograd.grad(heights[1].sum(), two)[0]
    assert not slopes[0].any()
    assert slopes[1].any()


def test_chains_that_share_a_cache_differ_by_the_frames_of_their_effects() -> None:
    effect, context = "slope-thinning", replace(_context(), quarter_turns=1)
    values = {effect: {"along_x_um": 0.1, "exponent": 1.0}}
    scan, turned = (EffectChain(build_model("identity"), values, {effect: f}) for f in ("scan", "print"))
    known: dict = {}
    assert torch.equal(scan(LAYOUT, context, known), scan(LAYOUT, context))
    assert torch.equal(turned(LAYOUT, context, known), turned(LAYOUT, context))
    assert not torch.equal(turned(LAYOUT, context), scan(LAYOUT, context))


def _context():
    from litho_models.effects import FieldContext

    return FieldContext(LAYOUT, 0.1, 1.2)
