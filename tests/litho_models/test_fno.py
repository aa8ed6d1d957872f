"""Check the FNO: its spectral layer against the Fourier sum, its periodic tiles and its blending weights."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_models.fitting import TrainingConfig, fit
from litho_models.models import build_model
from litho_models.models.fno import PeriodicConvolution, SpectralConvolution
from litho_models.prediction.tiles import blend_tiles, blending_window, predict_scan
from litho_models.simulator import Tile
from tests.litho_models.prints import make_scans

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("rough_networks")]

SMALL = {"width": 6, "modes": (4, 4), "projection_channels": 16, "tile_px": 32, "overlap_px": 16}
QUICK = {"steps": 12, "rounds": 3, "batch": 2, "precision": "32-true", "nuisance": "offset"}


def trained(**fields):
    """Return a small FNO whose weights all differ from their initial values."""
    torch.manual_seed(0)
    model = build_model("fno", **{**SMALL, **fields}).double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return model.eval()


@pytest.mark.parametrize("shape", [(7, 8), (9, 6), (8, 2), (6, 5), (4, 3), (1, 6)])
def test_the_spectral_layer_is_the_fourier_sum(shape):
    ny, nx = shape
    modes_y, modes_x, channels = 3, 2, 2
    kept_y = min(modes_y, ny // 2)
    torch.manual_seed(1)
    layer = SpectralConvolution(channels, (modes_y, modes_x)).double()
    layer.weight.data.normal_()
    field = torch.randn(1, ny, nx, channels, dtype=torch.float64)
    weight = torch.view_as_complex(layer.weight.detach()).numpy()
    y, x = np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij")
    wanted = np.zeros((channels, ny, nx))
    frequencies = [(0, k, k) for k in range(kept_y)] + [(1, modes_y - k, -k) for k in range(1, kept_y + 1)]
    for sign, row, ky in frequencies:
        for kx in range(modes_x):
            wave = np.exp(-2j * np.pi * (ky * y / ny + kx * x / nx))
            spectrum = (field[0].numpy() * wave[..., None]).sum(axis=(0, 1))
            mixed = spectrum @ weight[sign, :, :, row, kx]
            # A positive k_x also represents its mirror image. The first and the last k_x have none.
            share = (1 if kx in (0, nx / 2) else 2) / (ny * nx)
            wanted = wanted + share * (mixed[:, None, None] * wave.conj()).real
    with torch.no_grad():
        found = layer(field)[0].permute(2, 0, 1).numpy()
    # The sums have some dozen products of order one, in double precision.
    assert np.abs(found - wanted).max() < 1e-12


def test_fixed_weights_have_the_gradient_of_weights_that_learn():
    model = trained()
    field = torch.rand(1, 1, 40, 50, dtype=torch.float64, requires_grad=True)
    pull = torch.randn(1, 1, 40, 50, dtype=torch.float64)
    learning = torch.autograd.grad((model(field) * pull).sum(), field)[0]
    model.requires_grad_(False)
    fixed = torch.autograd.grad((model(field) * pull).sum(), field)[0]
    assert learning.abs().max() > 0.1
    assert (learning - fixed).abs().max() < 1e-12


@pytest.mark.parametrize("name", ["hidden.bias", "last.bias"])
def test_a_bias_that_learns_alone_has_the_gradient_of_one_among_many(name):
    model = trained()
    field = torch.rand(1, 1, 40, 50, dtype=torch.float64, requires_grad=True)

    def gradient():
        bias = model.get_parameter(name)
        model(field).sum().backward()
        found, bias.grad = bias.grad, None
        return found

    among_many = gradient()
    model.requires_grad_(False).get_parameter(name).requires_grad_()
    alone = gradient()
    assert alone is not None
    assert among_many.abs().max() > 1
    assert (alone - among_many).abs().max() < 1e-9


@pytest.mark.parametrize(("shape", "side"), [((5, 7), 3), ((4, 3), 5), ((3, 3), 7)])
def test_the_local_layer_is_periodic_and_so_is_its_gradient(shape, side):
    torch.manual_seed(2)
    layer = PeriodicConvolution(2, 2, side).double()
    reference = torch.nn.Conv2d(2, 2, side, padding=side // 2, padding_mode="circular").double()
    reference.load_state_dict(layer.state_dict())
    field = torch.randn(2, *shape, 2, dtype=torch.float64, requires_grad=True)
    pull = torch.randn(2, *shape, 2, dtype=torch.float64)
    found, wanted = layer(field), reference(field.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    slopes = [torch.autograd.grad((height * pull).sum(), field)[0] for height in (found, wanted)]
    # The sums have up to 98 products of order one, in double precision.
    assert (found - wanted).abs().max() < 1e-12
    assert (slopes[0] - slopes[1]).abs().max() < 1e-12


def test_a_tile_is_periodic_without_coordinates():
    model = trained()
    field = torch.rand(1, 1, 32, 32, dtype=torch.float64)
    with torch.no_grad():
        turned = model.interior(field.roll((5, -11), (-2, -1)))
        straight = model.interior(field).roll((5, -11), (-2, -1))
    assert float((turned - straight).abs().max()) < 1e-12


def test_coordinates_break_the_periodicity():
    model = trained(coordinates=True)
    field = torch.rand(1, 1, 32, 32, dtype=torch.float64)
    with torch.no_grad():
        change = model.interior(field.roll(9, -1)) - model.interior(field).roll(9, -1)
    assert float(change.abs().max()) > 1e-3


def test_a_field_moved_by_whole_strides_moves_its_print():
    model = trained()
    stride = SMALL["tile_px"] - SMALL["overlap_px"]
    # The pattern has a wide uniform border, so that only the pattern moves.
    field = torch.zeros(1, 1, 160, 160, dtype=torch.float64)
    field[..., 48:80, 48:80] = torch.rand(32, 32, dtype=torch.float64)
    with torch.no_grad():
        moved = model(field.roll((2 * stride, stride), (-2, -1)))
        straight = model(field).roll((2 * stride, stride), (-2, -1))
    assert float((moved - straight).abs().max()) < 1e-12


@pytest.mark.parametrize("tile", [Tile(32, 16), Tile(32, 10), Tile(31, 15), Tile(16, 0)])
@pytest.mark.parametrize("shape", [(5, 90), (64, 33)])
def test_blending_weights_sum_to_one(tile, shape):
    field = torch.rand(2, 1, *shape, dtype=torch.float64)
    assert torch.allclose(blend_tiles(torch.clone, field, tile), field, atol=1e-14, rtol=0)
    for border in (1, 2):
        inside = field[..., border:-border, border:-border]
        found = blend_tiles(torch.clone, field, tile, border)
        assert torch.allclose(found, inside, atol=1e-14, rtol=0)
    assert float(blending_window(tile, field).max()) <= 1


def test_a_patch_without_its_border_leaves_out_the_tiles_of_the_border():
    tile, seen = Tile(32, 8), []

    def count(tiles: torch.Tensor) -> torch.Tensor:
        seen.append(len(tiles))
        return tiles

    blend_tiles(count, torch.rand(1, 1, 160, 160), tile)
    whole = sum(seen)
    seen.clear()
    blend_tiles(count, torch.rand(1, 1, 160, 160), tile, border_px=64)
    # Along each axis, the field has seven tiles of stride 24. The middle 32 px touch two or three of them.
    assert whole == 49
    assert sum(seen) <= 9


def test_an_overlap_beyond_half_a_tile_is_refused():
    with pytest.raises(InputError, match="half a tile"):
        blend_tiles(torch.clone, torch.rand(1, 1, 40, 40), Tile(32, 17))


def test_the_variants_are_those_of_paper_and_code():
    paper, authors, ours = (build_model("fno", variant) for variant in ("paper", "authors", "default"))
    for model in (paper, authors, ours):
        assert (model.config.layers, model.config.modes) == (4, (12, 12))
    assert (paper.config.width, authors.config.width, ours.config.width) == (24, 12, 24)
    assert paper.config.coordinates
    assert authors.config.coordinates
    assert not ours.config.coordinates
    # This is 9 px of 256, and the same fraction for other sizes.
    assert [round(paper.config.padding_fraction * size) for size in (256, 540)] == [9, 19]
    assert (authors.config.padding_px, authors.config.padding_fraction) == (9, 0)
    # The parameters are those of the lift, of four layers, each with two spectral blocks and one 1 x 1
    # convolution, and of the projection.
    width = 24
    spectral = 4 * 2 * width**2 * 12 * 12 * 2
    local = 4 * (width**2 + width)
    assert paper.parameter_count == (3 * width + width) + spectral + local + (128 * width + 128) + (128 + 1)


@pytest.mark.parametrize("size", [256, 540])
def test_the_published_variant_takes_other_sizes(size):
    model = build_model("fno", "paper", width=2)
    with torch.no_grad():
        height = model(torch.rand(1, 1, size, size))
    assert height.shape == (1, 1, size, size)
    assert height.isfinite().all()


@pytest.mark.parametrize(
    ("recipe", "variant"), [("fast", "default"), ("paper", "default"), ("paper", "paper"), ("fast", "paper")]
)
def test_every_recipe_trains_every_variant(recipe, variant):
    fields = SMALL if variant == "default" else {"width": 4, "modes": (4, 4), "projection_channels": 8}
    settings = {**QUICK, "variant": variant, "learning_rate": 5e-3, "model": fields}
    settings |= {"crop_px": 48} if recipe == "paper" else {}
    config = TrainingConfig.of_recipe(recipe, "fno", **settings)
    scans = make_scans(4, size_px=64)
    fitted = fit("fno", scans, config)
    errors = [entry.training_mae_nm for entry in fitted.history]
    assert errors[-1] < errors[0]
    assert np.isfinite(predict_scan(fitted.model, scans[0])).all()


def test_training_sees_whole_tiles_and_the_continued_edge(monkeypatch):
    from litho_models.models.fno import Fno

    shapes = []
    interior = Fno.interior

    def watched(self, layout_um):
        if torch.is_grad_enabled():
            shapes.append(tuple(layout_um.shape[-2:]))
        return interior(self, layout_um)

    monkeypatch.setattr(Fno, "interior", watched)
    # The scans are narrower than a tile, and the crop size differs from the tile size.
    for size_px in (28, 64):
        fit("fno", make_scans(3, size_px=size_px), TrainingConfig(**QUICK, crop_px=40, model=SMALL))
    assert set(shapes) == {(32, 32)}


def test_fno_learns_a_blur_beyond_its_start():
    scans = make_scans(4, size_px=64, noise_um=0.002, datum_um=0.0)
    config = TrainingConfig(
        **{**QUICK, "steps": 120, "learning_rate": 5e-3, "validation_scans": 0, "model": SMALL}
    )
    fitted = fit("fno", scans, config)
    start = build_model("fno", **SMALL)

    def error(model):
        return np.mean([np.abs(predict_scan(model, s) - s.height_um).mean() for s in scans])

    # The initial prediction is the layout itself, so blur and saturation must be learned.
    assert error(fitted.model) < 0.5 * error(start)


def test_pixels_that_are_not_measured_do_not_change_the_training():
    scans = make_scans(3, size_px=64)
    broken = []
    for scan in scans:
        valid = scan.valid.copy()
        valid[:, :20] = False
        height = np.where(valid, scan.height_um, np.nan).astype(np.float32)
        broken.append(replace(scan, height_um=height, valid=valid))
    also = [replace(scan, height_um=np.where(scan.valid, scan.height_um, 5.0)) for scan in broken]
    config = TrainingConfig(**QUICK, validation_scans=0, model=SMALL)
    first, second = (fit("fno", each, config) for each in (broken, also))
    assert math.isfinite(first.history[-1].training_mae_nm)
    for one, other in zip(first.model.parameters(), second.model.parameters(), strict=True):
        assert torch.equal(one, other)
