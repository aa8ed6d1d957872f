"""Score photographs of a hologram's image, or of a known object through a printed lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from litho_data.foundation.errors import InputError, unknown_name
from litho_data.foundation.results import Record
from litho_design.images.measurements import PhotoSource
from litho_design.images.noise import corrected_scores
from litho_design.images.photo_registration import photographed_image
from litho_design.images.photograph import CameraRecord, Photograph
from litho_design.images.similarity import light_figures, likeness, matched_scale, similarity
from litho_design.images.targets import ImagedObject, object_name
from litho_design.judging.loaded import LoadedDesign
from litho_design.lenses.bench import sensor_psf
from litho_design.lenses.objects import read_object
from litho_design.lenses.task import LensTask
from litho_design.optics.imaging import Blur, richardson_lucy

# Largest accepted σ of the SI-PSNR, in dB. With a larger σ, a score cannot decide between designs.
_LARGEST_SD_DB = 0.5


class PhotoScore(Record):
    """The scores of a photographed image. Efficiencies are included only if the incident power is known."""

    si_psnr_db: float
    ssim: float
    si_psnr_resolved_db: float
    ssim_resolved: float
    speckle_contrast: float
    uniformity: float
    background_ratio: float
    eff_signal: float | None = None
    eff_window: float | None = None


class LensPhotoScore(Record):
    """Error, PSNR and SSIM of images of one photographed object. Each image is scaled to minimise its error.

    ``direct`` is the photograph itself. ``design`` is the photograph deconvolved with the PSF of the expected
    print. ``calibrated`` is the photograph deconvolved with the PSF of the measured print, or None if the
    print was not measured.
    """

    mae_direct: float
    psnr_direct_db: float = Field(description="PSNR of the sensor image, best scale, dB")
    ssim_direct: float
    mae_design: float
    psnr_design_db: float
    ssim_design: float
    mae_calibrated: float | None = None
    psnr_calibrated_db: float | None = None
    ssim_calibrated: float | None = None


@dataclass(frozen=True)
class PhotoVerdict:
    """The scores of a photograph and their uncertainties, the record of the photograph, and its images, keyed
    by title.
    """

    figures: Record
    uncertainty: dict[str, float]
    record: CameraRecord
    pictures: dict[str, np.ndarray]


def score_hologram_photo(
    loaded: LoadedDesign, source: PhotoSource, others: Sequence[np.ndarray] = ()
) -> PhotoVerdict:
    """Score a photograph of a printed hologram's image. For ``others``, see ``photographed_image``.

    Raises:
        InputError: ``photographed_image`` rejects the photograph, the incident power is not positive, an
            object is given for a hologram, or noise makes the score too uncertain.
    """
    assert loaded.target is not None
    if source.imaged is not None:
        raise InputError(
            "photographed object",
            got="an object, although the design is a hologram",
            wanted="an object only if the design is a lens",
            hint="leave out --camera-object",
        )
    power = source.power_counts
    if power is not None and not power > 0:
        raise InputError("incident power of the photograph", got=power, wanted="a positive sum of counts")
    wanted = loaded.image(loaded.expected_um)
    photo = _registered(loaded, wanted, loaded.record.layout.pitch_um, source, others=others)
    target = loaded.target.cpu().double()
    resolved = loaded.bench.resolved(target)

    def figures(image: np.ndarray) -> PhotoScore:
        share = image if power is None else photo.power_share(image, power)
        return photo_score(share, target, resolved, has_power=power is not None)

    image = photo.image()
    noisy, variants = photo.with_more_noise(), photo.with_other_cameras()
    corrected, sigma = corrected_scores(figures, figures(image), noisy, variants)
    if not sigma["si_psnr_db"] <= _LARGEST_SD_DB:
        raise InputError(
            f"photograph {source.path}",
            got=f"an uncertainty of {sigma['si_psnr_db']:.2f} dB in SI-PSNR",
            wanted=f"at most {_LARGEST_SD_DB} dB",
            hint="use a longer exposure or the mean of several exposures, and give --camera-dark-level",
        )
    pictures = {f"photograph {photo.record.name}": image.clip(0)}
    return PhotoVerdict(PhotoScore(**corrected), sigma, photo.record, pictures)


def _registered(
    loaded: LoadedDesign,
    wanted: np.ndarray,
    pitch_um: float,
    source: PhotoSource,
    averaged_um: float = 0.0,
    others: Sequence[np.ndarray] = (),
) -> Photograph:
    optics, half_um = loaded.record.optics, loaded.record.layout.size_um / 2
    # The finest fringes in the image are formed by rays from two opposite sides of the element.
    finest_per_um = 2 * optics.edge_sine(half_um) / optics.wavelength_um
    return photographed_image(wanted, pitch_um, source, finest_per_um, averaged_um, others)


def photo_score(image: np.ndarray, target: Tensor, resolved: Tensor, *, has_power: bool) -> PhotoScore:
    """Compare a registered photograph with its target and with the target blurred to the resolution of the
    element, and return the scores. All three images have shape (m, m).
    """
    share = torch.from_numpy(image).double()
    found = likeness(share, target, resolved) | light_figures(share, target)
    known = {name: value for name, value in found.items() if has_power or not name.startswith("eff_")}
    return PhotoScore.model_validate(known)


@torch.no_grad()
def score_lens_photo(
    loaded: LoadedDesign, source: PhotoSource, printed_um: Tensor | None = None
) -> PhotoVerdict:
    """Score a photograph of a known object taken through a printed lens.

    ``photographed_image`` cleans the photograph and registers it to the expected image. The expected image is
    the image that the expected print would form of this object, sampled on sensor pixels. Then the photograph
    is deconvolved by the Richardson-Lucy algorithm with the number of iterations of the design. The image of
    the object must be as large as in the design; otherwise, the PSFs do not apply.

    Args:
        loaded: the design of a lens.
        source: an upright photograph, or a photograph whose ``orientation`` says how to make it upright. A
            lens rotates its image by 180°.
        printed_um: measured height of the print, µm, shape (size, size), from which the calibrated PSF is
            computed.

    Raises:
        InputError: ``source`` names no object, an unknown object or a name that two objects share, or
            ``photographed_image`` rejects the photograph.
    """
    assert isinstance(loaded.task, LensTask)
    wanted, which = _object(loaded.task, source.imaged)
    settings = loaded.task.settings.imaging
    heights = {"design": loaded.expected_um} | ({} if printed_um is None else {"calibrated": printed_um})
    kernels = {name: sensor_psf(loaded.bench(um), settings.pixel_px) for name, um in heights.items()}
    expected = Blur(kernels["design"], (settings.object_px, settings.object_px)).forward(wanted)
    pixel_um = settings.pixel_px * loaded.record.layout.pitch_um
    # The PSFs are summed over sensor pixels, so the photograph has to be averaged over such pixels.
    photo = _registered(loaded, expected.cpu().numpy(), pixel_um, source, averaged_um=pixel_um)

    def estimates(image: np.ndarray) -> dict[str, Tensor]:
        seen = torch.from_numpy(image).to(expected).clamp(min=0)
        seen = seen * matched_scale(seen, expected)
        found = {name: richardson_lucy(seen, kernel, settings.iterations) for name, kernel in kernels.items()}
        return {name: one * matched_scale(one, wanted) for name, one in ({"direct": seen} | found).items()}

    def figures(image: np.ndarray) -> LensPhotoScore:
        values: dict[str, float] = {}
        for name, estimate in estimates(image).items():
            values |= similarity(estimate, wanted, name)
        return LensPhotoScore.model_validate(values)

    image = photo.image()
    pictures = {f"object {object_name(which)}": wanted}
    for name, estimate in estimates(image).items():
        pictures["photograph" if name == "direct" else f"deconvolved, {name} PSF"] = estimate
    noisy, variants = photo.with_more_noise(), photo.with_other_cameras()
    corrected, sigma = corrected_scores(figures, figures(image), noisy, variants)
    return PhotoVerdict(
        LensPhotoScore(**corrected),
        sigma,
        photo.record.model_copy(update={"imaged": which}),
        {name: picture.cpu().numpy() for name, picture in pictures.items()},
    )


def _object(task: LensTask, imaged: str | None) -> tuple[Tensor, ImagedObject]:
    """Return the object that a photograph shows, shape (n, n) with values in [0, 1], and its name or
    record.
    """
    settings = task.settings.imaging
    items = (*settings.objects, *settings.test_objects)
    names = [object_name(item) for item in items]
    if imaged in names:
        if names.count(imaged) > 1:
            raise InputError(
                "photographed object",
                got=f"{imaged!r}, which names two objects of the design",
                wanted="the path of its picture, including a folder",
            )
        place = names.index(imaged)
        return (*task.objects, *task.tested)[place], items[place]
    if imaged is None or not Path(imaged).is_file():
        given = imaged or "no --camera-object"
        raise unknown_name("photographed object", given, names, also="a picture's path")
    pixels, record = read_object(Path(imaged), settings.object_px)
    return torch.from_numpy(pixels).to(task.printer.device), record
