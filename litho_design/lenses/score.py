"""Scores of a lens: of its PSF against that of a perfect lens, and of its images."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from litho_data.foundation.results import Record
from litho_design.images.similarity import similarity
from litho_design.lenses.bench import (
    LensBench,
    RadialLensBench,
    record,
    sensor_psf,
)
from litho_design.lenses.objects import object_stack
from litho_design.lenses.settings import ImagingSettings, LensSettings
from litho_design.optics.imaging import richardson_lucy

# Figures of a lens that make sense even if nothing focuses.
_OF_POWER = ("focusing_efficiency", "strehl", "cbr", "eff_window")
_TEST_SEEDS = range(1000, 1003)


class LensScore(Record):
    """Powers are shares of the power on the aperture; lengths are in µm."""

    focusing_efficiency: float = Field(
        description="power within the focusing radius, share of the aperture's"
    )
    focusing_radius_um: float = Field(description="focusing radius: 3 x ideal FWHM, µm")
    strehl: float = Field(description="peak over the peak of a perfect lens")
    mtf_volume_ratio: float = Field(description="volume of the MTF over that of a perfect lens")
    mtf_half_cutoff: float = Field(description="MTF at half the cut-off NA / wavelength")
    fwhm_um: float = Field(description="full width at half maximum, µm")
    fwhm_ideal_um: float = Field(description="the same of a perfect lens, µm")
    cbr: float = Field(description="centre-to-background ratio")
    cbr_ceiling: float = Field(description="the same of a perfect lens: the ceiling")
    eff_window: float = Field(description="power in the PSF window, share of the aperture's")


class ImagingScore(Record):
    """Means and standard deviations over test objects and noise seeds that the design never used.

    ``design`` deconvolves with the PSF that the design expected, ``calibrated`` with the PSF of the print
    itself; ``direct`` is the sensor image without deconvolution, scaled to minimise its error.
    """

    mae_direct: float = Field(description="test objects: MAE of the sensor image, best scale")
    mae_design: float = Field(description="test objects: MAE, deconvolved with the designed PSF")
    mae_calibrated: float = Field(description="test objects: MAE, deconvolved with the print's own PSF")
    mae_calibrated_sd: float = Field(description="its standard deviation over objects and noise seeds")
    psnr_design_db: float = Field(description="PSNR with the designed PSF, dB")
    psnr_calibrated_db: float = Field(description="PSNR with the print's own PSF, dB")
    ssim_direct: float = Field(description="SSIM of the sensor image")
    ssim_design: float = Field(description="SSIM with the designed PSF")
    ssim_calibrated: float = Field(description="SSIM with the print's own PSF")
    ssim_calibrated_sd: float = Field(description="its standard deviation over objects and noise seeds")


@torch.no_grad()
def lens_score(bench: LensBench | RadialLensBench, height_um: Tensor) -> LensScore:
    """Score the PSF of printed heights, µm: a plane (size, size), or rings (rings,)."""
    psf, ideal = (bench(height).double() for height in (height_um, bench.ideal_height_um()))
    pitch = bench.layout.pitch_um
    fwhm_ideal = half_maximum_width_um(ideal, pitch)
    radius_um = 3 * fwhm_ideal
    y, x = torch.from_numpy(bench.window.y_um), torch.from_numpy(bench.window.x_um)
    near = (torch.hypot(y[:, None], x[None, :]) <= radius_um).to(psf.device)
    cutoff = 2 * bench.numerical_aperture / bench.optics.wavelength_um
    return LensScore(
        focusing_efficiency=float(psf[near].sum()),
        focusing_radius_um=radius_um,
        strehl=float(psf.max() / ideal.max()),
        mtf_volume_ratio=float(mtf(psf).sum() / mtf(ideal).sum()),
        mtf_half_cutoff=mtf_at(psf, cutoff / 2, pitch),
        fwhm_um=half_maximum_width_um(psf, pitch),
        fwhm_ideal_um=fwhm_ideal,
        cbr=float(bench.ratio(psf)),
        cbr_ceiling=float(bench.ratio(ideal)),
        eff_window=float(psf.sum()),
    )


def half_maximum_width_um(psf: Tensor, pitch_um: float) -> float:
    """Diameter of the circle whose area lies above half the maximum, µm.

    The PSF is interpolated fourfold (zero-padded spectrum) so that pixels do not limit it.
    """
    fine = 4
    spectrum = torch.fft.fftshift(torch.fft.fft2(psf))
    pad = (fine - 1) * psf.shape[-1] // 2
    image = torch.fft.ifft2(torch.fft.ifftshift(torch.nn.functional.pad(spectrum, (pad,) * 4))).real
    # An odd side cannot be padded to exactly four times its length.
    sample_um = pitch_um * psf.shape[-1] / image.shape[-1]
    area = float((image > image.max() / 2).sum()) * sample_um**2
    return 2 * math.sqrt(area / math.pi)


def mtf(psf: Tensor) -> Tensor:
    """|FFT(psf)| / DC, (n, n), zero frequency first."""
    transfer = torch.fft.fft2(psf).abs()
    return transfer / transfer[0, 0]


def mtf_at(psf: Tensor, frequency_per_um: float, pitch_um: float) -> float:
    """MTF at one frequency, cycles/µm: mean of both axes, linear between samples."""
    curve = mtf(psf)
    position = frequency_per_um * psf.shape[-1] * pitch_um
    index = int(position)
    part = position - index
    axes = (curve[0, : index + 2], curve[: index + 2, 0])
    return float(sum(axis[index] * (1 - part) + axis[index + 1] * part for axis in axes) / 2)


@torch.no_grad()
def imaging_score(
    psf: Tensor,
    design_psf: Tensor,
    settings: ImagingSettings,
    pictures: Mapping[str, np.ndarray] | None = None,
) -> ImagingScore:
    """Image the test objects through ``psf`` and reconstruct with both PSFs.

    Args:
        psf, design_psf: (window, window), share of the incident power per window pixel.
        pictures: pixels of the test objects that are pictures, see ``object_stack``.
    """
    real, expected = (sensor_psf(p, settings.pixel_px).float() for p in (psf, design_psf))
    objects = object_stack(settings.test_objects, settings.object_px, pictures).to(psf.device)
    rows: dict[str, list[float]] = {}

    def add(name: str, estimates: Tensor) -> None:
        for estimate, wanted in zip(estimates, objects, strict=True):
            for figure, value in similarity(estimate, wanted, name).items():
                rows.setdefault(figure, []).append(value)

    for seed in _TEST_SEEDS:
        seen = record(objects, real, settings, seed)
        scale = (seen * objects).sum((-2, -1)) / seen.square().sum((-2, -1))
        add("direct", seen * scale[:, None, None])
        add("design", richardson_lucy(seen, expected, settings.iterations))
        add("calibrated", richardson_lucy(seen, real, settings.iterations))
    figures = {name: sum(values) / len(values) for name, values in rows.items()}
    figures |= {f"{name}_sd": float(torch.tensor(values).std()) for name, values in rows.items()}
    return ImagingScore(**{name: figures[name] for name in ImagingScore.model_fields})


class ImagingLensScore(LensScore, ImagingScore):
    """PSF and imaging figures of a computational lens."""


@torch.no_grad()
def score_lens(
    settings: LensSettings,
    bench: LensBench,
    height_um: Tensor,
    design_height_um: Tensor,
    pictures: Mapping[str, np.ndarray] | None = None,
) -> LensScore | ImagingLensScore:
    """Figures of a printed lens whose design expected ``design_height_um``."""
    score = lens_score(bench, height_um)
    if settings.task == "direct":
        return score
    imaging = imaging_score(bench(height_um), bench(design_height_um), settings.imaging, pictures)
    return ImagingLensScore(**score.model_dump(), **imaging.model_dump())


@torch.no_grad()
def lens_baselines(
    settings: LensSettings, bench: LensBench, pictures: Mapping[str, np.ndarray] | None = None
) -> dict[str, dict[str, float]]:
    """Scores of a perfect lens, a flat plate and, for a computational lens, black images, by name."""
    ideal = bench.ideal_height_um()
    flat = lens_score(bench, torch.zeros_like(ideal))
    found = {
        "perfect lens": score_lens(settings, bench, ideal, ideal, pictures).model_dump(),
        "no lens": {name: getattr(flat, name) for name in _OF_POWER},
    }
    if settings.task == "computational":
        imaging = settings.imaging
        objects = object_stack(imaging.test_objects, imaging.object_px, pictures)
        black: dict[str, float] = {}
        for by in ("direct", "design", "calibrated"):
            rows = [similarity(torch.zeros_like(wanted), wanted, by) for wanted in objects]
            black |= {name: sum(one[name] for one in rows) / len(rows) for name in rows[0]}
        found["black image"] = {name: black[name] for name in black if name in ImagingScore.model_fields}
    return found
