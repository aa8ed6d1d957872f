"""Score the PSF of a lens against the PSF of a perfect lens, and score the images that the lens forms."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import torch
from pydantic import Field
from torch import Tensor

from litho_data.foundation.results import Record
from litho_design.images.similarity import similarity
from litho_design.lenses.bench import LensBench, RadialLensBench, record, sensor_psf
from litho_design.lenses.settings import ImagingSettings
from litho_design.optics.imaging import richardson_lucy

_TEST_SEEDS = range(1000, 1003)


class LensScore(Record):
    """The score of a PSF. Powers are relative to the power on the aperture, and lengths are in µm."""

    focusing_efficiency: float = Field(description="share of the aperture's power within the focusing radius")
    focusing_radius_um: float = Field(description="focusing radius: 3 x ideal FWHM, µm")
    strehl: float = Field(description="peak of the PSF divided by that of a perfect lens")
    mtf_volume_ratio: float = Field(description="volume of the MTF divided by that of a perfect lens")
    mtf_half_cutoff: float = Field(description="MTF at half the cut-off NA / wavelength")
    fwhm_um: float = Field(description="full width at half maximum, µm")
    fwhm_ideal_um: float = Field(description="full width at half maximum of a perfect lens, µm")
    cbr: float = Field(description="centre-to-background ratio")
    cbr_ceiling: float = Field(description="centre-to-background ratio of a perfect lens, the upper limit")
    eff_window: float = Field(description="share of the aperture's power in the PSF window")


class ImagingScore(Record):
    """The score of the images of a lens: means and standard deviations over test objects and noise seeds that
    the search never used.

    The name of each score states the image to which it belongs. ``design`` is the sensor image deconvolved
    with the PSF that was predicted for the design, and ``calibrated`` is the sensor image deconvolved with
    the PSF of the print itself. ``direct`` is the sensor image without deconvolution, scaled to minimise its
    error.
    """

    mae_direct: float = Field(description="MAE of the sensor image of test objects, at the best scale")
    mae_design: float = Field(
        description="MAE of the images of test objects after deconvolution with the designed PSF"
    )
    mae_calibrated: float = Field(
        description="MAE of the images of test objects after deconvolution with the print's own PSF"
    )
    mae_calibrated_sd: float = Field(
        description="standard deviation of mae_calibrated over objects and noise seeds"
    )
    psnr_design_db: float = Field(description="PSNR with the designed PSF, dB")
    psnr_calibrated_db: float = Field(description="PSNR with the print's own PSF, dB")
    ssim_direct: float = Field(description="SSIM of the sensor image")
    ssim_design: float = Field(description="SSIM with the designed PSF")
    ssim_calibrated: float = Field(description="SSIM with the print's own PSF")
    ssim_calibrated_sd: float = Field(
        description="standard deviation of ssim_calibrated over objects and noise seeds"
    )


@torch.no_grad()
def lens_score(bench: LensBench | RadialLensBench, height_um: Tensor) -> LensScore:
    """Score the PSF of printed heights, µm, on a plane, shape (size, size), or on rings, shape (rings,)."""
    psf, ideal = bench(height_um).double(), bench.ideal_psf().double()
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
    """Return the full width at half maximum of a PSF, µm. It is the diameter of a circle with the same area
    as the region above half the maximum.

    The PSF is interpolated to four times as many pixels per side by zero-padding its spectrum, so that the
    size of its pixels does not limit the result.
    """
    fine = 4
    spectrum = torch.fft.fftshift(torch.fft.fft2(psf))
    pad = (fine - 1) * psf.shape[-1] // 2
    image = torch.fft.ifft2(torch.fft.ifftshift(torch.nn.functional.pad(spectrum, (pad,) * 4))).real
    # A spectrum with an odd number of samples cannot be padded to exactly four times this number, so the
    # sample spacing is computed from the actual numbers.
    sample_um = pitch_um * psf.shape[-1] / image.shape[-1]
    area = float((image > image.max() / 2).sum()) * sample_um**2
    return 2 * math.sqrt(area / math.pi)


def mtf(psf: Tensor) -> Tensor:
    """Return the MTF of a PSF, |FFT(psf)| divided by its value at zero frequency. The result has shape (n, n)
    and begins with the zero frequency.
    """
    transfer = torch.fft.fft2(psf).abs()
    return transfer / transfer[0, 0]


def mtf_at(psf: Tensor, frequency_per_um: float, pitch_um: float) -> float:
    """Return the MTF at one frequency, given in cycles/µm, as the mean of its values along both axes. The MTF
    is interpolated linearly between its samples.
    """
    curve = mtf(psf)
    position = frequency_per_um * psf.shape[-1] * pitch_um
    index = int(position)
    part = position - index
    axes = (curve[0, : index + 2], curve[: index + 2, 0])
    return float(sum(axis[index] * (1 - part) + axis[index + 1] * part for axis in axes) / 2)


@torch.no_grad()
def imaging_score(
    psf: Tensor, design_psf: Tensor, objects: Tensor, settings: ImagingSettings
) -> dict[str, float]:
    """Form sensor images of objects through ``psf``, reconstruct the objects once with ``psf`` and once with
    ``design_psf``, and return the scores (see ``ImagingScore``). The objects have shape (n, size, size).

    Args:
        psf: PSF of the print: the share of the incident power on each pixel of the window, shape (window,
            window).
        design_psf: PSF that was predicted for the design, in the same form as ``psf``.
    """
    real, expected = (sensor_psf(one, settings.pixel_px).float() for one in (psf, design_psf))
    draws = []
    for seed in _TEST_SEEDS:
        seen = record(objects, real, settings, seed)
        scale = (seen * objects).sum((-2, -1)) / seen.square().sum((-2, -1))
        direct = seen * scale[:, None, None]
        design, calibrated = (richardson_lucy(seen, one, settings.iterations) for one in (expected, real))
        draws.append({"direct": direct, "design": design, "calibrated": calibrated})
    values = _similarities(draws, objects)
    spread = {f"{name}_sd": float(torch.tensor(found).std()) for name, found in values.items()}
    return _of_images(_means(values) | spread)


def black_images(objects: Tensor) -> dict[str, float]:
    """Return the imaging scores of reconstructions that are black everywhere."""
    black = dict.fromkeys(("direct", "design", "calibrated"), torch.zeros_like(objects))
    return _of_images(_means(_similarities([black], objects)))


def _similarities(draws: Iterable[Mapping[str, Tensor]], objects: Tensor) -> dict[str, list[float]]:
    """Return the values of every score, one for each draw of the noise and each object. The dict is keyed by
    the name of the score.
    """
    rows: dict[str, list[float]] = {}
    for name, images in (one for draw in draws for one in draw.items()):
        for image, wanted in zip(images, objects, strict=True):
            for figure, value in similarity(image, wanted, name).items():
                rows.setdefault(figure, []).append(value)
    return rows


def _means(values: Mapping[str, list[float]]) -> dict[str, float]:
    return {name: sum(found) / len(found) for name, found in values.items()}


def _of_images(figures: Mapping[str, float]) -> dict[str, float]:
    return {name: figures[name] for name in ImagingScore.model_fields if name in figures}


class ImagingLensScore(LensScore, ImagingScore):
    """The score of the PSF and of the images of a computational lens."""
