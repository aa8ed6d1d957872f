"""Compare the variants `authors` and `paper` with the authors' classes and the paper's equations."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
import torch
from scipy.signal import fftconvolve
from scipy.stats import norm

from litho_data.foundation.errors import InputError
from litho_models.models import build_model
from litho_models.models.authors import model_of_authors

pytestmark = pytest.mark.numerics


def weights_of(oracle) -> dict[str, np.ndarray]:
    return {name.removeprefix("weight/"): oracle[name] for name in oracle.files if name.startswith("weight/")}


@pytest.mark.parametrize("name", ["physics", "pbl", "fno_width12", "fno_width24"])
def test_heights_are_those_of_the_authors_classes(name, oracles, measured_prints):
    oracle = np.load(oracles / "authors" / f"{name}.npz")
    model = model_of_authors(weights_of(oracle))
    for field, size, every in (("FOV11", 256, 1), ("FOV42", 512, 4)):
        level = tifffile.imread(measured_prints / "mask_ug" / f"{field}.tif")[:size, :size]
        layout_um = torch.from_numpy(level.astype(np.float32)) * 0.1
        with torch.no_grad():
            height = model(layout_um[None, None])[0, 0].numpy()
        theirs = oracle[f"height_um_{field}_{size}" + (f"_every_{every}px" if every > 1 else "")]
        # The two sum in float32 in different orders. 0.01 nm is a hundred times the rounding error at 1 µm.
        assert np.abs(height[::every, ::every] - theirs).max() < 1e-5


def layout_um(size: int = 60) -> np.ndarray:
    return 0.1 * np.random.default_rng(3).integers(0, 13, (size, size))


def blurred(field: np.ndarray, sigma_px: float, radius: int) -> np.ndarray:
    """Blur a field with a normalised two-dimensional kernel. Outside, the field is zero."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    kernel = np.exp(-(x**2 + y**2) / (2 * sigma_px**2))
    return fftconvolve(field, kernel / kernel.sum(), mode="same")


def authors_radius(sigma_px: float) -> int:
    return min(3 * int(sigma_px), 50)


def four_sigma(sigma_px: float) -> int:
    return int(np.ceil(4 * sigma_px))


def in_double(model, layout: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return model.double()(torch.from_numpy(layout)[None, None])[0, 0].numpy()


@pytest.mark.parametrize("variant", ["paper", "authors"])
def test_physics_is_the_transcribed_equations_in_micrometres(variant):
    model = build_model("physics", variant, sigma_diffusion_init_um=0.57).double()
    v = {name: float(value.detach()) for name, value in model.values.items()}
    assert set(v) == {"alpha", "eta", "kappa_min", "sigma_diffusion_um", "bias_um"}
    radius = authors_radius if variant == "authors" else four_sigma
    sigma_px = v["sigma_diffusion_um"] / 0.1
    aerial = blurred(layout_um(), 2.0, radius(2.0))
    low = np.tanh(v["alpha"] * v["eta"])
    initial = (low + np.tanh(v["alpha"] * (aerial - v["eta"]))) / (low + np.tanh(v["alpha"] * (1 - v["eta"])))
    dose = blurred(initial, sigma_px, radius(sigma_px))
    lowest = dose.min() if variant == "paper" else 0.0
    kept = v["kappa_min"] + (1 - v["kappa_min"]) * (dose - lowest) / (dose.max() - lowest)
    # A tolerance of 1e-6 nm allows only for rounding in double precision.
    assert np.abs(in_double(model, layout_um()) - (initial * kept + v["bias_um"])).max() < 1e-9


@pytest.mark.parametrize("variant", ["paper", "authors"])
@pytest.mark.parametrize(("knots", "tolerance_um"), [(0, 1e-9), (1025, 1e-6)])
def test_pbl_is_the_transcribed_equations(variant, knots, tolerance_um):
    torch.manual_seed(5)
    model = build_model("pbl", variant, sigma_diffusion_init_um=0.57, knots=knots).double()
    slope = 0.2 if variant == "authors" else 0.02
    radius = authors_radius if variant == "authors" else four_sigma
    state = {name: value.numpy() for name, value in model.state_dict().items()}

    def leaky(values: np.ndarray) -> np.ndarray:
        return np.where(values > 0, values, slope * values)

    def pointwise(part: str, field: np.ndarray) -> np.ndarray:
        features = field.reshape(-1, 1)
        for layer in (0, 2, 4):
            weight, bias = (state[f"{part}.layers.{layer}.{kind}"] for kind in ("weight", "bias"))
            features = features @ weight.T + bias
            features = features if layer == 4 else leaky(features)
        return features.reshape(field.shape)

    def areawise(field: np.ndarray) -> np.ndarray:
        features = field[None]
        for layer in ("hidden.0", "hidden.1", "hidden.2", "hidden.3", "last"):
            weight, bias = (state[f"mismatch.{layer}.{kind}"] for kind in ("weight", "bias"))
            wide = np.pad(features, ((0, 0), (1, 1), (1, 1)))
            windows = np.lib.stride_tricks.sliding_window_view(wide, (3, 3), axis=(1, 2))
            features = np.einsum("iyxab,oiab->oyx", windows, weight, optimize=True) + bias[:, None, None]
            features = features if layer == "last" else leaky(features)
        return features[0]

    sigma_px = float(model.sigma_diffusion_um.detach()) / 0.1
    initial = pointwise("thresh", blurred(layout_um(), 2.0, radius(2.0)))
    dose = blurred(initial, sigma_px, radius(sigma_px))
    dose = np.abs(dose) if variant == "authors" else dose
    wanted = areawise(initial * pointwise("shrink", dose))
    assert np.abs(in_double(model, layout_um()) - wanted).max() < tolerance_um


@pytest.mark.parametrize("variant", ["paper", "authors"])
def test_fno_is_the_transcribed_operator(variant):
    torch.manual_seed(6)
    model = build_model("fno", variant).double()
    state = {name: value.numpy() for name, value in model.state_dict().items()}

    def mapped(part: str, features: np.ndarray) -> np.ndarray:
        weight, bias = state[f"{part}.weight"][:, :, 0, 0], state[f"{part}.bias"]
        return np.tensordot(weight, features, 1) + bias[:, None, None]

    def gelu(values: np.ndarray) -> np.ndarray:
        return values * norm.cdf(values)

    layout = layout_um()
    ramp = np.linspace(0, 1, len(layout))
    features = mapped("lift", np.stack([layout, *np.meshgrid(ramp, ramp, indexing="ij")]))
    zeros = 9 if variant == "authors" else round(9 / 256 * len(layout))
    features = np.pad(features, ((0, 0), (0, zeros), (0, zeros)))
    for layer in range(4):
        matrices = state[f"spectral.{layer}.weight"] @ [1, 1j]
        spectrum = np.fft.rfft2(features)
        kept = np.zeros_like(spectrum)
        for rows, matrix in ((slice(0, 12), matrices[0]), (slice(-12, None), matrices[1])):
            kept[:, rows, :12] = np.einsum("iyx,ioyx->oyx", spectrum[:, rows, :12], matrix)
        features = np.fft.irfft2(kept, s=features.shape[1:]) + mapped(f"local.{layer}", features)
        features = features if layer == 3 else gelu(features)
    wanted = mapped("last", gelu(mapped("hidden", features[:, : len(layout), : len(layout)])))[0]
    assert np.abs(in_double(model, layout) - wanted).max() < 1e-9


def test_models_frozen_with_the_older_variants_print_as_they_did():
    y = torch.arange(60.0)
    wave = torch.sin(y[:, None] / 7) * torch.cos(y[None, :] / 11)
    field = (torch.floor(6.5 + 6 * wave) * 0.1)[None, None]
    # These are the settings in older cards, and the heights that the code at that time computed.
    shared = {
        "alpha_init": 1.0,
        "bias_init_um": 0.0,
        "reference_height_um": None,
        "kernel_support": "four-sigma",
    }
    paper = {**shared, "edge": "replicate"}
    authors = {**shared, "kernel_cap_px": None}
    for variant, card, then in (
        ("paper", paper, [0.6556832, 0.804717, 0.4297822]),
        ("authors", authors, [0.1678248, 1.071539, 0.4144308]),
    ):
        with torch.no_grad():
            height = build_model("physics", variant, **card)(field)[0, 0]
        assert [float(height[at]) for at in ((0, 0), (30, 30), (13, 50))] == pytest.approx(then, abs=2e-7)
    # A card without the new fields describes the older form of the model.
    config = build_model("physics").Config(variant="authors")
    assert (config.reference_height_um, config.kernel_support, config.gain_init) == (None, "four-sigma", None)
    assert build_model("pbl", "authors", kernel_support="four-sigma").reach_px == 8 + 50 + 5


def test_weights_of_another_class_or_a_part_are_refused():
    with pytest.raises(InputError, match="one of the authors' classes"):
        model_of_authors({"layer.weight": np.zeros(3)})
    physics = {"sigmac_param": 2.5, "thresh": 0.5, "alpha": 5.2514, "kmin": 0.5, "height_bias": -0.1374}
    assert model_of_authors(physics).values["alpha"].item() == pytest.approx(5.2514, rel=1e-6)
    for changed in ({**physics, "extra": 1.0}, {k: v for k, v in physics.items() if k != "kmin"}):
        with pytest.raises(InputError, match=r"extra|raw_kappa_min"):
            model_of_authors(changed)
    with pytest.raises(InputError, match="alpha"):
        model_of_authors({**physics, "alpha": -1.0})
