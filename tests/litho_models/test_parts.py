"""Test printers made of parts: imaging against Hopkins' sum, resists, and fixed or fitted parameters."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import fftconvolve

from litho_data.foundation.errors import InputError
from litho_data.layouts.random_layout import random_layout
from litho_models import load_frozen
from litho_models.cli.app import main
from litho_models.fitting.small_models import fit_small_model
from litho_models.models import MODELS, build_model, fixed_numbers, kernels_part
from litho_models.models.hopkins import Optics, imaged, intensity, kernel_reach_px, transfer_functions
from litho_models.models.parts import PARTS, Number, Part, contrast_curve, register_part
from litho_models.models.printers import Printer
from tests.litho_models.prints import make_scans, write_store
from tests.tensors import assert_close

pytestmark = pytest.mark.numerics
PITCH_UM, SIZE_PX = 0.05, 24
LENS = Optics(0.365, 0.6, 0.7, 0.3, 0.4, 400)
CUTOFF = LENS.na / LENS.wavelength_um


def printer(name: str, **fields: Any) -> Printer:
    model = build_model(name, **fields)
    assert isinstance(model, Printer)
    return model


def image(mask: np.ndarray, lens: Optics, pitch_um: float = PITCH_UM) -> np.ndarray:
    """Return the image intensity (y, x) of a periodic mask, using all kernels."""
    spectra = torch.from_numpy(transfer_functions(lens, pitch_um, mask.shape))
    return imaged(torch.from_numpy(mask)[None, None], spectra)[0, 0].numpy()


def hopkins_sum(mask: np.ndarray, lens: Optics) -> np.ndarray:
    """Return Hopkins' sum Σ T(f₁) T*(f₂) C(f₁, f₂) exp(2πi (f₁ - f₂) x), with C summed over the source."""
    n = len(mask)
    f = np.stack(np.meshgrid(*2 * [np.fft.fftfreq(n, PITCH_UM)], indexing="ij"), -1).reshape(-1, 2)
    spectrum = np.fft.fft2(mask).ravel() / mask.size

    def pupil(at: np.ndarray) -> np.ndarray:
        sine2 = lens.wavelength_um**2 * (at**2).sum(-1)
        passed = sine2 <= lens.na**2 * (1 + 1e-9)
        path_um = lens.defocus_um * (np.sqrt(np.where(passed, 1 - sine2, 1)) - 1)
        return passed * np.exp(2j * np.pi * path_um / lens.wavelength_um)

    # A cell has nine source points along each side, which are all moved to the centre of the cell.
    fine = np.arange(-9 * n // 2, 9 * n // 2)
    y, x = (one.ravel() / (9 * n * PITCH_UM) for one in np.meshgrid(fine, fine, indexing="ij"))
    radius = np.hypot(y, x) / CUTOFF
    ring = (radius <= lens.outer + 1e-9) & (radius >= lens.inner - 1e-9)
    points = np.rint(np.stack([y, x], -1)[ring] * n * PITCH_UM) / (n * PITCH_UM)
    source, bright = np.unique(points, axis=0, return_counts=True)
    cross = sum(w * np.outer(pupil(f + s), pupil(f + s).conj()) for w, s in zip(bright, source, strict=True))
    cross /= sum(w * np.abs(pupil(s)) ** 2 for w, s in zip(bright, source, strict=True))
    places = PITCH_UM * np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), -1).reshape(-1, 2)
    waves = np.exp(2j * np.pi * places @ f.T) * spectrum
    return np.einsum("xi,ij,xj->x", waves, cross, waves.conj()).real.reshape(n, n)


def test_the_kernels_give_the_sum_of_hopkins() -> None:
    mask = np.random.default_rng(0).random((SIZE_PX, SIZE_PX))
    assert np.abs(image(mask, LENS) - hopkins_sum(mask, LENS)).max() < 1e-6
    few = image(mask, LENS._replace(kernels=3))
    assert 1e-6 < np.abs(few - image(mask, LENS)).max() < 0.1


def test_a_source_is_as_bright_as_its_area() -> None:
    """Compare two images: that of a source on the coarse grid of the kernels, and that of a thousand
    points.
    """
    pitch_um, side = 0.06, 96
    lens = Optics(0.365, 0.5, 0.6, 0.0, 0.0, 400)
    mask = (fftconvolve(np.random.default_rng(0).random((side, side)), np.ones((9, 9)), "same") > 40).astype(
        float
    )
    spectrum, total, count = np.fft.fft2(mask), np.zeros(mask.shape), 0
    f = np.fft.fftfreq(side, pitch_um)
    for y, x in product(np.linspace(-1, 1, 41), repeat=2):
        if y * y + x * x <= 1:
            at = lens.outer * lens.na / lens.wavelength_um
            passed = np.hypot(f[:, None] + at * y, f[None, :] + at * x) <= lens.na / lens.wavelength_um
            total, count = total + np.abs(np.fft.ifft2(spectrum * passed)) ** 2, count + 1
    reach = kernel_reach_px(lens, pitch_um)
    padded = torch.from_numpy(np.pad(mask, reach, mode="wrap"))[None, None]
    seen = intensity(padded, lens, pitch_um)[0, 0].numpy()
    # If only whole grid points counted, the error would be 1.1 %.
    assert np.sqrt(np.mean((seen - total / count) ** 2)) < 0.006


@pytest.mark.parametrize("waves", [1, 3])
def test_a_point_source_images_the_amplitude_that_passes(waves: int) -> None:
    """Check images of t = (1 + cos 2πfx) / 2. In focus, the image is t². Defocus delays the diffracted waves.
    Beyond the pupil, the image is 1/4.
    """
    lens = Optics(0.365, 0.6, 0.0, 0.0, 0.3, 400)
    x = np.arange(SIZE_PX) / SIZE_PX
    f = waves / (SIZE_PX * PITCH_UM)
    assert (f < CUTOFF) == (waves == 1)
    phase = 2 * np.pi * lens.defocus_um / lens.wavelength_um * (np.sqrt(1 - min(1, (0.365 * f) ** 2)) - 1)
    passed = float(f < CUTOFF) * np.exp(1j * phase)
    wanted = np.abs(0.5 + 0.5 * passed * np.cos(2 * np.pi * waves * x)) ** 2
    mask = np.tile(0.5 + 0.5 * np.cos(2 * np.pi * waves * x), (SIZE_PX, 1))
    assert np.allclose(image(mask, lens), wanted, atol=1e-12)


def test_a_wide_source_images_the_intensity_by_the_transfer_function_of_a_circular_pupil() -> None:
    size, waves = 64, 5
    f = waves / (size * PITCH_UM)
    # The source is wider than the diffracted light of the mask, so the image is incoherent.
    lens = Optics(0.365, 0.6, 1 + f / CUTOFF, 0.0, 0.0, 10**6)
    x = np.arange(size) / size
    mask = np.tile(np.cos(np.pi * waves * x) ** 2, (size, 1))
    seen = image(mask, lens)[0]
    squared = np.abs(np.fft.fft(mask[0] ** 2))
    ν = f / (2 * CUTOFF)
    wanted = 2 / np.pi * (np.arccos(ν) - ν * np.sqrt(1 - ν**2))
    found = np.abs(np.fft.fft(seen))
    # The pupil's area is a count of frequencies. With a width of 8, it is right to 1 / 8², except at the rim.
    assert found[waves] / found[0] == pytest.approx(wanted * squared[waves] / squared[0], rel=0.03)


def test_the_gradient_of_an_image_is_its_difference_quotient() -> None:
    spectra = torch.from_numpy(transfer_functions(LENS._replace(kernels=8, inner=0.0), PITCH_UM, (12, 14)))
    mask = torch.rand(1, 1, 12, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda own: imaged(own, spectra), mask.requires_grad_())


def test_a_field_is_imaged_as_its_part_is_and_an_open_mask_is_bright() -> None:
    lens = LENS._replace(kernels=12)
    reach = kernel_reach_px(lens, PITCH_UM)
    mask = (torch.rand(1, 1, 2 * reach + 40, 2 * reach + 30) > 0.5).float()
    whole, part = (intensity(one, lens, PITCH_UM) for one in (mask, mask[..., 10:, :-4]))
    assert whole.shape[-2:] == (40, 30)
    assert torch.allclose(whole[..., 10:, :-4], part, atol=1e-5)
    assert torch.allclose(intensity(torch.ones_like(mask), lens, PITCH_UM), torch.ones(40, 30), atol=1e-5)


def test_kernels_in_a_file_image_as_the_lens_they_come_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("litho_models.models.parts.PARTS", dict(PARTS))
    lens = LENS._replace(kernels=5)
    size = 2 * kernel_reach_px(lens, PITCH_UM) + 1
    kernels = np.fft.fftshift(np.fft.ifft2(transfer_functions(lens, PITCH_UM, (size, size))), axes=(-2, -1))
    np.save(tmp_path / "kernels.npy", kernels)
    register_part(kernels_part("own-lens", tmp_path / "kernels.npy"))
    numbers = {f"lens.{name}": value for name, value in lens._asdict().items()}
    layout = (
        0.1
        * torch.from_numpy(random_layout((60, 50), cutoff_per_um=1.0, pitch_um=PITCH_UM)[None, None]).float()
    )
    own, known = (
        build_model("projection", pitch_um=PITCH_UM, **parts)(layout)
        for parts in ({"parts": ("own-lens",)}, {"parts": ("lens",), **numbers})
    )
    assert_close(own, known, rtol=0, atol=1e-5)
    np.save(tmp_path / "even.npy", kernels[:, 1:, 1:])
    for file, said in {"even.npy": "odd", "none.npy": "no such file"}.items():
        with pytest.raises(InputError, match=said):
            kernels_part("wrong", tmp_path / file)


def test_physics_is_a_printer_of_spot_threshold_shrinkage_and_transfer() -> None:
    physics = build_model("physics", sigma_diffusion_init_um=0.7, gain_init=0.9, kappa_min_init=0.3)
    values = {name: value.item() for name, value in physics.values.items()}
    assert values["bias_um"] == 0
    parts = printer(
        "laser-writer",
        parts=("spot", "tanh", "shrinkage", "transfer"),
        **{
            "spot.sigma_um": physics.config.sigma_optical_um,
            "tanh.contrast": values["alpha"],
            "tanh.threshold": values["eta"],
            "shrinkage.sigma_um": values["sigma_diffusion_um"],
            "shrinkage.kappa_min": values["kappa_min"],
            "transfer.selectivity": values["gain"],
        },
    )
    layout = 0.1 * torch.from_numpy(random_layout((64, 64))[None, None]).float()
    assert_close(parts(layout), physics(layout), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_one_batch_of_kernels_is_faster_than_one_convolution_after_the_other() -> None:
    lens = LENS._replace(kernels=12)
    size = 512
    kernels = torch.fft.ifft2(torch.from_numpy(transfer_functions(lens, PITCH_UM, (64, 64))))
    spectra = torch.fft.fft2(kernels, s=(size, size)).to(torch.complex64)
    mask = torch.rand(1, 1, size, size)

    def one_by_one() -> torch.Tensor:
        amplitudes = [
            torch.fft.ifft2(torch.fft.fft2(mask) * torch.fft.fft2(own, s=(size, size))) for own in kernels
        ]
        return sum((one.abs() ** 2 for one in amplitudes), torch.zeros(()))

    def seconds(run: object) -> float:
        started = time.process_time()
        run()  # type: ignore[operator]
        return time.process_time() - started

    assert torch.allclose(imaged(mask, spectra), one_by_one().float(), rtol=1e-3, atol=1e-4)
    assert min(seconds(lambda: imaged(mask, spectra)) for _ in range(3)) < seconds(one_by_one)


def test_a_contrast_curve_is_a_line_in_the_logarithm_between_nothing_and_all() -> None:
    dose = torch.tensor([0.05, 0.4, 0.6, 2.0])
    depth = contrast_curve(dose, torch.tensor(1.5), torch.tensor(0.9))
    # The corners of the curve are rounded over 1 / 20 of the depth.
    wanted = [0.0, 1 + 1.5 * np.log10(0.4 / 0.9), 1 + 1.5 * np.log10(0.6 / 0.9), 1.0]
    assert depth.tolist() == pytest.approx(wanted, abs=0.01)


def test_every_part_states_its_source_and_numbers_within_their_range() -> None:
    for part in PARTS.values():
        assert part.source
        for name, number in part.numbers.items():
            own = number.range_at(name, number.start)
            assert own.lower <= number.start <= own.upper


def test_a_part_of_ones_own_is_a_stage_of_a_printer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("litho_models.models.parts.PARTS", dict(PARTS))
    numbers = {"gain": Number(0.5)}
    register_part(Part("gain", numbers, lambda field, own, pitch: own["gain"] * field, "a test"))
    model = printer("laser-writer", parts=("spot", "gain"))
    assert set(model.values) == {"spot.sigma_um", "gain.gain"}
    flat = torch.full((1, 1, 40, 40), 0.8)
    assert torch.allclose(model(flat), torch.full_like(flat, 0.4))
    with pytest.raises(InputError, match="not taken"):
        register_part(PARTS["etch"])


def test_pbl_begins_as_the_image_of_any_illumination() -> None:
    layout = 0.1 * torch.from_numpy(random_layout((64, 64))[None, None]).float()
    own = {"sigma_diffusion_init_um": 0.1, "surroundings": None, "scan_axis": None}
    plain, spot = (build_model("pbl", **own, **more) for more in ({}, {"illumination": "spot"}))
    spot.load_state_dict(plain.state_dict())
    assert_close(plain(layout), spot(layout), rtol=0, atol=1e-5)
    numbers = {"na": 0.5, "wavelength_um": 0.4, "kernels": 3}
    pbl = build_model("pbl", illumination="lens", numbers=numbers, **own)
    bare = build_model(
        "projection", parts=("lens",), **{f"lens.{key}": value for key, value in numbers.items()}
    )
    assert_close(pbl(layout), bare(layout), rtol=0, atol=1e-5)
    for wrong in ({"illumination": "lamp"}, {"illumination": "lens", "numbers": {"sigma_um": 1}}):
        with pytest.raises(InputError, match=r"lamp|sigma_um"):
            build_model("pbl", **wrong)


def test_a_contrast_curve_of_256_levels_is_fitted_by_33_heights() -> None:
    geometry = {"pitch_um": 0.1, "levels": 256, "level_height_um": 1.2 / 255}
    true = printer("laser-writer", **geometry)
    scans = []
    for number, scan in enumerate(make_scans(3, 64)):
        level = random_layout((64, 64), levels=256, cutoff_per_um=0.5, seed=number)
        scan = replace(scan, mask_level=level, levels=256, level_height_um=geometry["level_height_um"])
        height = true(torch.from_numpy(scan.layout_um)[None, None])[0, 0].detach().numpy()
        scans.append(replace(scan, height_um=height))
    table = build_model("blur-table", **geometry)
    assert table.parameter_count == 1 + 33
    fit_small_model(table, scans, "none")
    held_out = torch.from_numpy(
        random_layout((64, 64), levels=256, cutoff_per_um=0.5, seed=9) * np.float32(1.2 / 255)
    )
    off = (table(held_out[None, None]) - true(held_out[None, None])).detach().abs()
    # Lines between 33 heights cut off the curve's corners, which are rounded over a twentieth of the range.
    assert float(off.mean()) < 0.004 * 1.2


def test_a_fixed_number_stays_and_a_freed_one_does_not() -> None:
    scans = make_scans(2, 64)
    geometry = {"pitch_um": 0.1, "levels": 13, "level_height_um": 0.1}
    for fixed in ((), ("spot.sigma_um",)):
        model = printer("laser-writer", **geometry, **{"spot.sigma_um": 0.4}, fixed=fixed)
        fit_small_model(model, scans, "none")
        values = {name: value.item() for name, value in model.values.items()}
        assert (values["spot.sigma_um"] == pytest.approx(0.4)) == bool(fixed)
        assert values["transfer.selectivity"] != pytest.approx(1.0)
    assert fixed_numbers("e-beam", ["etch.bias_px"], ["etch.threshold"]) == ["etch.bias_px"]
    with pytest.raises(InputError, match="to fix"):
        build_model("physics", fixed=("nonsense",))
    for name in ("fno", "pbl"):
        with pytest.raises(InputError, match="to fix"):
            build_model(
                name, fixed=(next(key for key, _ in build_model(name).named_parameters() if "." in key),)
            )
    with pytest.raises(InputError, match="fixed parameter"):
        fixed_numbers("physics", free=["eta"])


def test_numbers_of_a_model_are_set_and_fixed_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = write_store(tmp_path / "made.zarr", make_scans(3, 64))
    words = ["train", store, "--model", "laser-writer", "--out", tmp_path / "run"]
    words += ["--set", "spot.sigma_um=0.35", "--fix", "spot.sigma_um"]
    monkeypatch.setattr("sys.argv", ["litho-models", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    settings = json.loads((tmp_path / "run" / "run.json").read_text())["config"]["model"]
    assert settings == {"spot.sigma_um": 0.35, "fixed": ["spot.sigma_um"]}
    model = load_frozen(tmp_path / "run" / "model").simulator
    assert isinstance(model, Printer)
    assert float(model.values["spot.sigma_um"].detach()) == pytest.approx(0.35)


@pytest.mark.parametrize("name", [name for name, one in MODELS.items() if issubclass(one, Printer)])
def test_a_preset_is_built_for_its_own_pitch_and_says_what_it_does_not_know(name: str) -> None:
    with pytest.raises(InputError, match="not a parameter of these parts"):
        printer(name, **{"spot.width_um": 1.0})
    with pytest.raises(InputError, match="part of a printer"):
        build_model(name, parts=("lamp",))
