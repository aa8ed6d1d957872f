"""Test the spot of Physics, which is given, fitted as a circle, or fitted with one width per axis."""

from __future__ import annotations

import pytest
import torch

from litho_models.models import build_model
from litho_models.simulator import Simulator
from tests.tensors import assert_close

PITCH_UM = 0.1
SPOTS = ("given", "round", "elliptical")
WIDTHS = {"round": ("spot",), "elliptical": ("spot_y", "spot_x")}


def model_of(kind: str, **widths_um: float) -> Simulator:
    """Return Physics in float64, with a short diffusion and the widths ``spot`` or ``spot_y``, ``spot_x``."""
    model = build_model(
        "physics", pitch_um=PITCH_UM, level_height_um=0.1, levels=13, spot=kind, sigma_diffusion_init_um=0.3
    ).double()
    for name, width in widths_um.items():
        key = f"raw_{name}_um"
        getattr(model, key).data = model.ranges[key].raw(width).double()  # type: ignore[attr-defined]
    return model


def layout(seed: int = 0) -> torch.Tensor:
    """Return a layout (1, 1, 40, 48) in µm with blocks of random levels."""
    coarse = (
        torch.randint(0, 13, (1, 1, 10, 12), generator=torch.Generator().manual_seed(seed)).double() * 0.1
    )
    return coarse.repeat_interleave(4, -2).repeat_interleave(4, -1)


def printed(model: Simulator, field: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return model(field)


@pytest.mark.parametrize(("spot", "count"), [("given", 0), ("round", 1), ("elliptical", 2)])
def test_a_spot_has_as_many_numbers_as_it_has_widths(spot: str, count: int) -> None:
    model = model_of(spot)
    assert len(list(model.parameters())) == len(list(model_of("given").parameters())) + count
    widths = {name: float(value) for name, value in model.values.items() if "spot" in name}
    # Before a fit, the widths are the given ones.
    assert list(widths.values()) == pytest.approx([0.2] * count)


def test_spots_of_the_same_width_print_the_same() -> None:
    prints = [printed(model_of(spot), layout()) for spot in SPOTS]
    for other in prints[1:]:
        # The given width is kept in float32.
        assert_close(other, prints[0], rtol=0, atol=1e-7)


def test_a_turned_layout_with_swapped_widths_prints_turned() -> None:
    one = printed(model_of("elliptical", spot_y=0.1, spot_x=0.3), layout())
    other = printed(model_of("elliptical", spot_y=0.3, spot_x=0.1), layout().mT)
    assert_close(other, one.mT, rtol=0, atol=1e-12)
    assert (one - printed(model_of("elliptical", spot_y=0.3, spot_x=0.1), layout())).abs().max() > 0.02


@pytest.mark.parametrize("axis", ["x", "y"])
def test_an_edge_is_blurred_by_the_width_across_it(axis: str) -> None:
    edge = torch.zeros(1, 1, 40, 40, dtype=torch.float64)
    edge[..., 20:] = 0.8
    field = edge if axis == "x" else edge.mT
    other = "y" if axis == "x" else "x"
    narrow, wide, across = (
        printed(model_of("elliptical", **{f"spot_{axis}": own, f"spot_{other}": its}), field)
        for own, its in ((0.15, 0.1), (0.15, 0.4), (0.3, 0.1))
    )
    # Both kernels are truncated at 4 sigma of the wider one, which loses 6e-5 of a step.
    assert_close(wide, narrow, rtol=0, atol=6e-5)
    assert (across - narrow).abs().max() > 0.02


@pytest.mark.parametrize("spot", ["round", "elliptical"])
def test_derivatives_by_the_widths_are_difference_quotients(spot: str) -> None:
    # The kernel ends at a whole pixel, which does not change at these widths.
    model, field = model_of(spot, **dict.fromkeys(WIDTHS[spot], 0.21)), layout()
    weight = torch.linspace(-1, 1, field.numel(), dtype=torch.float64).reshape(field.shape)
    (model(field) * weight).sum().backward()
    for key, parameter in model.named_parameters():
        if "spot" in key:
            step = 1e-4
            values = []
            for sign in (1, -1):
                parameter.data += sign * step
                values.append(float((printed(model, field) * weight).sum()))
                parameter.data -= sign * step
            assert parameter.grad is not None
            # Central differences err by step² times the third derivative of a sum of hundreds of terms.
            assert float(parameter.grad) == pytest.approx((values[0] - values[1]) / (2 * step), abs=1e-5)


@pytest.mark.parametrize("spot", SPOTS)
def test_the_inner_part_of_a_field_prints_the_same_without_its_surroundings(spot: str) -> None:
    model, field = model_of(spot), layout()
    reach = model.reach_px
    assert reach is not None
    inside = model.interior(torch.nn.functional.pad(field, (reach,) * 4, mode="replicate"))
    assert_close(inside.detach(), printed(model, field), rtol=0, atol=1e-9)


def test_a_width_stays_within_its_range() -> None:
    model = model_of("round")
    model.raw_spot_um.data.fill_(50.0)
    assert float(model.values["spot_um"]) <= 0.8
    model.raw_spot_um.data.fill_(-50.0)
    assert float(model.values["spot_um"]) >= 0.0
