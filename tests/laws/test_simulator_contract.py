"""Check the contract of simulators with the same tests for all models and variants."""

from __future__ import annotations

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_models.frozen.files import load_frozen, save_frozen
from litho_models.models import MODELS, build_model
from litho_models.prediction.tiles import predict_field
from litho_models.simulator import VARIANTS, Simulator

pytestmark = pytest.mark.numerics


def fields_of(name: str, variant: str) -> dict[str, object]:
    """Return the settings of a variant, without its name."""
    return build_model(name, variant).config.model_dump(exclude={"variant"})


# A variant with the same settings as the default is not tested separately.
CASES = [
    (name, variant)
    for name in MODELS
    for variant in VARIANTS
    if variant == "default" or fields_of(name, variant) != fields_of(name, "default")
]
# Narrow blurs keep the fields of these tests small, and few channels keep them fast. The contract does not
# depend on them.
NARROW = {
    "affine-mtf": {"sigmas_um": (0.1, 0.2, 0.3)},
    "linear": {"sigmas_um": (0.1, 0.2, 0.3)},
    "features": {"sigmas_um": (0.0, 0.1, 0.3), "shifts_um": (0.2, 0.5)},
    "random-features": {
        "sigmas_um": (0.0, 0.3),
        "slope_sigmas_um": (0.15,),
        "shifts_um": (0.2,),
        "streak_sigmas_um": (0.2,),
        "steep_sigmas_um": (0.1,),
        "steep_widths_um": (0.3,),
        "units": 70,
    },
    "pbl": {"sigma_diffusion_init_um": 0.3, "pointwise_channels": (8, 4), "areawise_channels": (8, 4)},
    "physics": {"sigma_diffusion_init_um": 0.3},
    "e-beam": {"two-spots.sigma_um": 0.08, "two-spots.back_um": 0.2, "diffusion.sigma_um": 0.09},
    "projection": {"lens.wavelength_um": 0.15, "diffusion.sigma_um": 0.08},
    "laser-writer": {"spot.sigma_um": 0.1},
    "dmd-grayscale": {"spot.sigma_um": 0.1, "diffusion.sigma_um": 0.08},
    "fno": {"width": 6, "modes": (4, 4), "projection_channels": 8},
}
# These settings apply to the default variant only.
SMALL_PARTS = {
    "fno": {"tile_px": 32, "overlap_px": 16},
    "pbl": {
        "surroundings": {
            "blurs_um": (0.2,),
            "slope_blurs_um": (0.1,),
            "shifts_um": (0.2,),
            "steep_um": (0.3,),
        },
        "scan_axis": {"blurs_um": (0.2,), "slope_blurs_um": (0.1,), "shifts_um": (0.2,), "steep_um": (0.3,)},
    },
}
LOCAL = [name for name in MODELS if build_model(name).reach_px is not None]


def make(name: str, variant: str = "default", **fields: object) -> Simulator:
    """Return a model whose parameters all differ from their start, so that every part has an effect."""
    torch.manual_seed(0)
    parts = SMALL_PARTS.get(name, {}) if variant == "default" else {}
    model = build_model(name, variant, **{**NARROW.get(name, {}), **parts, **fields})
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.03 * torch.randn_like(parameter))
    return model.eval()


def layout(ny: int = 80, nx: int = 96, seed: int = 1) -> torch.Tensor:
    torch.manual_seed(seed)
    return torch.randint(0, 13, (1, 1, ny, nx)) * 0.1


def test_there_are_models_to_test():
    baselines = {"identity", "affine", "affine-mtf", "blur-table", "linear", "features", "random-features"}
    assert set(MODELS) >= baselines | {"physics", "pbl", "fno"}


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_height_has_the_shape_of_the_layout_and_is_in_micrometres(name, variant):
    model = make(name, variant)
    with torch.no_grad():
        for shape in ((80, 96), (65, 71)):
            height = model(layout(*shape))
            assert height.shape == (1, 1, *shape)
            assert height.dtype == torch.float32
            assert torch.isfinite(height).all()
    if variant == "default":
        untrained = build_model(name)
        with torch.no_grad():
            uniform = untrained(torch.full((1, 1, 64, 64), 0.6))
        # Untrained default models start near the nominal height: 0.6 µm, not 0.6 nm or 600.
        assert 0.2 < float(uniform[..., 32, 32]) < 1.0


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_samples_of_a_batch_do_not_touch_each_other(name, variant):
    model = make(name, variant)
    a, b = layout(seed=1), layout(seed=2)
    with torch.no_grad():
        together = model(torch.cat([a, b]))
        # Another batch size may change the order of sums, and so a few float32 roundings at 1 µm.
        assert torch.allclose(together[:1], model(a), atol=2e-6)
        assert torch.allclose(together[1:], model(b), atol=2e-6)


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_gradient_equals_finite_difference(name, variant):
    model = make(name, variant).double()
    field = (layout(60, 64).double() + 0.05).clamp(0.02, 1.18).requires_grad_()
    torch.manual_seed(3)
    direction = torch.randn_like(field)
    weight = torch.randn_like(field)
    (gradient,) = torch.autograd.grad((weight * model(field)).sum(), field)
    step = 1e-6
    with torch.no_grad():
        high, low = model(field + step * direction), model(field - step * direction)
        difference = float((weight * (high - low)).sum() / (2 * step))
    directional = float((gradient * direction).sum())
    assert gradient.isfinite().all()
    # In double precision, rounding errors are 1e-16/1e-6 = 1e-10 per pixel. A few of the 4,000 pixels cross
    # kinks of leaky ReLU or of the tables, where slopes change by a few per cent.
    assert difference == pytest.approx(directional, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_a_print_without_its_border_is_the_print_cut(name, variant, tmp_path):
    model = load_frozen(save_frozen(make(name, variant), tmp_path / "model")).double()
    ny, nx = 104, 112
    field = torch.cat([layout(ny, nx, seed) for seed in (1, 2)]).double().requires_grad_()
    whole = model(field)
    # The widest border excludes whole tiles of 32 px, and is wider than most receptive radii.
    for border_px in (0, 3, 48):
        cut = whole[..., border_px : ny - border_px, border_px : nx - border_px]
        inside = model.inside(field, border_px)
        weight = torch.rand_like(cut)
        slopes = [
            torch.autograd.grad((weight * height).sum(), field, retain_graph=True)[0]
            for height in (cut, inside)
        ]
        # The sums have some thousand products of order one, in double precision. The treatment of the edge
        # does not reach the middle.
        assert torch.allclose(inside, cut, atol=1e-10, rtol=0)
        assert torch.allclose(*slopes, atol=1e-10, rtol=0)
    for impossible in (-1, ny // 2):
        with pytest.raises(InputError, match="border"):
            model.inside(field, impossible)


@pytest.mark.parametrize("name", [name for name in MODELS if list(build_model(name).parameters())])
def test_every_parameter_gets_a_gradient(name):
    model = make(name)
    model(layout()).square().sum().backward()
    for key, parameter in model.named_parameters():
        if not parameter.requires_grad:
            assert model.ranges[key].name in model.config.fixed
            continue
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all(), key
        assert parameter.grad.abs().max() > 0, key


def crop_difference_um(model, field, offset_px, border_px):
    """Return the absolute differences between predictions for a field and its crop, away from the border."""
    y, x = offset_px
    inner = (..., slice(border_px, -border_px or None), slice(border_px, -border_px or None))
    with torch.no_grad():
        whole, crop = predict_field(model, field)[..., y:, x:], predict_field(model, field[..., y:, x:])
    return (whole[inner] - crop[inner]).abs()


@pytest.mark.parametrize("name", LOCAL)
def test_a_crop_predicts_what_the_whole_field_does_beyond_the_receptive_radius(name):
    model = make(name)
    reach = model.reach_px
    size = 2 * reach + 40
    difference = crop_difference_um(model, layout(size + 24, size + 24), (10, 6), reach)
    assert difference.numel() >= 40 * 40
    # The tolerance is some float32 rounding errors at 1 µm.
    assert difference.max() < 1e-5


@pytest.mark.parametrize(("name", "variant"), [case for case in CASES if make(*case).reach_px is None])
def test_a_model_without_a_receptive_radius_sees_the_crop(name, variant):
    model = make(name, variant)
    field = 0.7 * layout(150, 150)
    field[..., :8, :4] = 1.2  # the crop excludes the highest level
    difference = crop_difference_um(model, field, (10, 6), 32)
    # There must be a difference, or else the model would have a receptive radius. But the error stays small.
    assert 0 < difference.max() < 1


@pytest.mark.parametrize("name", [name for name in MODELS if make(name).tile])
def test_a_crop_on_the_same_grid_of_tiles_predicts_what_the_whole_field_does(name):
    model = make(name)
    size, overlap = model.tile
    field = layout(150, 150)
    difference = crop_difference_um(model, field, (size - overlap, 2 * (size - overlap)), size)
    # Tiles that start at the same pixels and do not touch the crop's edge have the same input.
    assert difference.max() < 1e-5


@pytest.mark.parametrize("name", [name for name in LOCAL if make(name).reach_px > 0])
def test_the_receptive_radius_is_not_overstated(name):
    model = make(name)
    reach = model.reach_px
    size = 2 * reach + 21
    field = layout(size, size)
    changed = field.clone()
    centre = size // 2
    changed[..., centre, centre] += 0.4
    with torch.no_grad():
        response = (model(changed) - model(field)).abs()[0, 0]
    assert float(response[centre, centre]) > 0
    beyond = response.clone()
    beyond[centre - reach : centre + reach + 1, centre - reach : centre + reach + 1] = 0
    assert float(beyond.max()) < 1e-6


@pytest.mark.parametrize("name", list(MODELS))
def test_tiles_give_the_whole_field(name):
    model = make(name)
    field = layout(150, 170)
    with torch.no_grad():
        assert torch.allclose(predict_field(model, field, tile_px=64), model(field), atol=1e-5)


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_a_frozen_model_is_the_model(name, variant, tmp_path):
    model = make(name, variant)
    save_frozen(model, tmp_path / "model")
    frozen = load_frozen(tmp_path / "model")
    field = layout().requires_grad_()
    height = frozen(field, pitch_um=0.1)
    with torch.no_grad():
        learning = model(layout())
    # Trainable and fixed weights may be summed in different orders, so heights of 1 µm may differ by some
    # 1e-7 of their value. With fixed weights, the frozen model equals the model bit for bit.
    assert torch.allclose(height, learning, rtol=0, atol=1e-6)
    assert torch.equal(height, model.requires_grad_(False)(layout()))
    height.sum().backward()
    assert field.grad.isfinite().all()
    assert field.grad.abs().sum() > 0
    assert not any(parameter.requires_grad for parameter in frozen.parameters())
    assert frozen.name == name


@pytest.mark.parametrize("name", list(MODELS))
def test_a_frozen_model_takes_layouts_of_its_own_precision_only(name, tmp_path):
    model = make(name)
    save_frozen(model, tmp_path / "model")
    frozen, others = load_frozen(tmp_path / "model"), [torch.int64, torch.uint8, torch.bool]
    if list(model.parameters()):
        others += [torch.float64, torch.float16, torch.bfloat16]
    for dtype in others:
        with pytest.raises(InputError, match=r"wanted torch\.float32, like the weights"):
            frozen(layout().to(dtype))
    single, double = frozen(layout()), frozen.double()(layout().double())
    assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
    # These small models amplify rounding errors of 1e-7 of 1 µm some tens of times. At the edges of e-beam
    # in flat resist, the amplification is 1/5e-3.
    assert torch.allclose(single.double(), double, rtol=0, atol=1e-4 if name == "e-beam" else 1e-5)


@pytest.mark.parametrize(("name", "variant"), [("physics", "paper"), ("physics", "authors")])
def test_the_published_shrinkage_depends_on_the_crop_and_says_so(name, variant):
    model = make(name, variant)
    assert model.reach_px is None
    field = layout(96, 96)
    with torch.no_grad():
        tall = field.clone()
        tall[..., :8, :8] = 1.2
        difference = (model(tall) - model(field))[..., 60:, 60:].abs().max()
    assert float(difference) > 1e-4


def test_pointwise_networks_by_knots_equal_those_per_pixel():
    by_knots = make("pbl")
    per_pixel = make("pbl", knots=0)
    per_pixel.load_state_dict(by_knots.state_dict())
    with torch.no_grad():
        difference = (by_knots(layout()) - per_pixel(layout())).abs().max()
    # 1,025 knots over 1.2 µm are 1.2 nm apart. The error is largest at a kink between two knots: a quarter
    # of the spacing times the change of slope. This change is below 0.1, so the error is below 0.03 nm.
    assert float(difference) < 5e-5
