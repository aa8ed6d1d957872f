"""Photographs as judges: of a hologram's image, or of a known object through a printed lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Record
from litho_design.images.photograph import CameraRecord, photographed_image
from litho_design.images.similarity import matched_scale, si_psnr_db, similarity, ssim
from litho_design.images.targets import ImagedObject
from litho_design.judging.loaded import LoadedDesign
from litho_design.lenses.bench import reconstruct, sensor_psf
from litho_design.lenses.objects import object_name, object_stack, read_object
from litho_design.optics.imaging import Blur


class PhotoScore(Record):
    """Figures of intensity alone: a photograph does not know the incident power."""

    si_psnr_db: float
    ssim: float
    speckle_contrast: float
    uniformity: float
    background_ratio: float


class LensPhotoScore(Record):
    """Error, PSNR and SSIM of one photographed object, each image at the scale of least error.

    ``direct`` is the photograph itself, ``design`` its deconvolution with the PSF that the design
    expected, ``calibrated`` that with the PSF of the measured print (None where none was measured).
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


def score_hologram_photo(
    loaded: LoadedDesign, photo_file: str | Path, pitch_um: float, *, dark_level: float | None = None
) -> tuple[PhotoScore, CameraRecord, np.ndarray]:
    """Score a photograph of a printed hologram's image.

    Args:
        loaded: a hologram's design.
        photo_file: grey image of any bit depth.
        pitch_um: camera pixel in the image plane, µm.
        dark_level: counts; the 1st percentile where None.

    Returns:
        Score, the record of the photograph, and the registered photograph (m, m), counts.

    Raises:
        InputError: no image, or a photograph that does not resemble the expected image.
    """
    assert loaded.target is not None
    wanted, wanted_pitch_um = loaded.image(loaded.expected_um), loaded.record.layout.pitch_um
    image, record = photographed_image(wanted, wanted_pitch_um, photo_file, pitch_um, dark_level=dark_level)
    return photo_score(image, loaded.target), record, image


def photo_score(image: np.ndarray, target: Tensor) -> PhotoScore:
    """Figures of a registered photograph (m, m) of a hologram against its target (m, m)."""
    share, wanted = torch.from_numpy(image).double(), target.cpu().double()
    lit, dark = share[wanted > 0.5], share[wanted <= 0.5]
    low, high = (float(torch.quantile(lit, q)) for q in (0.05, 0.95))
    scale = (share * wanted).sum() / share.square().sum()
    return PhotoScore(
        si_psnr_db=si_psnr_db(share, wanted),
        ssim=ssim((scale * share).clamp(0, 1), wanted),
        speckle_contrast=float(lit.std(correction=0) / lit.mean()),
        uniformity=1 - (high - low) / (high + low),
        background_ratio=float(lit.mean() / dark.mean().clamp(min=1e-12)),
    )


@torch.no_grad()
def score_lens_photo(
    loaded: LoadedDesign,
    photo_file: str | Path,
    pitch_um: float,
    imaged: str | None,
    *,
    dark_level: float | None = None,
    printed_um: Tensor | None = None,
) -> tuple[LensPhotoScore, CameraRecord, dict[str, np.ndarray]]:
    """Score a photograph of a known object taken through a printed lens.

    The photograph is cleaned and registered by ``photographed_image`` on the image that the design
    expects of the object, on the sensor pixels of the design, and deconvolved by Richardson-Lucy with
    its number of iterations. The registration takes any scale for one of the camera: the image of the
    object must have the size of the design's, or its PSFs do not fit.

    Args:
        loaded: a lens's design.
        photo_file: grey image of any bit depth, upright (a lens turns its image by half a turn).
        pitch_um: camera pixel in the focal plane of the lens, µm.
        imaged: name of one of the design's objects, or path of a picture.
        dark_level: counts; the 1st percentile where None.
        printed_um: measured height (size, size) of the print, µm, for the calibrated PSF.

    Returns:
        Figures, the record of the photograph, and pictures (n, n) by name: object, photograph and
        estimates.

    Raises:
        InputError: no object, an unknown one or a name that two have, no image, or a photograph that does
            not resemble it.
    """
    wanted, which = _object(loaded, imaged)
    settings = loaded.lens.imaging
    heights = {"design": loaded.expected_um} | ({} if printed_um is None else {"calibrated": printed_um})
    kernels = {name: sensor_psf(loaded.bench(um), settings.pixel_px) for name, um in heights.items()}
    expected = Blur(kernels["design"], (settings.object_px, settings.object_px)).forward(wanted)
    pixel_um = settings.pixel_px * loaded.record.layout.pitch_um
    image, record = photographed_image(
        expected.cpu().numpy(), pixel_um, photo_file, pitch_um, dark_level=dark_level
    )
    seen = torch.from_numpy(image).to(expected)
    seen = seen * matched_scale(seen, expected)
    estimates = {name: reconstruct(seen, kernel, settings.iterations) for name, kernel in kernels.items()}
    figures: dict[str, float] = {}
    pictures = {f"object {object_name(which)}": wanted}
    for name, estimate in {"direct": seen, **estimates}.items():
        scaled = estimate * matched_scale(estimate, wanted)
        found = similarity(scaled, wanted)
        figures |= {f"mae_{name}": found.mae, f"psnr_{name}_db": found.psnr_db, f"ssim_{name}": found.ssim}
        pictures["photograph" if name == "direct" else f"deconvolved, {name} PSF"] = scaled
    shown = {name: picture.cpu().numpy() for name, picture in pictures.items()}
    score = LensPhotoScore.model_validate(figures)
    return score, record.model_copy(update={"imaged": which}), shown


def _object(loaded: LoadedDesign, imaged: str | None) -> tuple[Tensor, ImagedObject]:
    """The object of a photograph, (n, n) in [0, 1], and its name or record."""
    settings = loaded.lens.imaging
    items = (*settings.objects, *settings.test_objects)
    own = {object_name(item): item for item in items}
    if imaged is None or (imaged not in own and not Path(imaged).is_file()):
        raise InputError(
            "photographed object",
            got="no --camera-object" if imaged is None else repr(imaged),
            wanted=f"a picture's path, or one of {', '.join(own)}",
        )
    if imaged in own:
        if [object_name(item) for item in items].count(imaged) > 1:
            raise InputError(
                "photographed object",
                got=f"{imaged!r}, the name of two objects of the design",
                wanted="the path of its picture, with a folder in front",
            )
        stack = object_stack([own[imaged]], settings.object_px, loaded.pictures)
        return stack[0].to(loaded.device), own[imaged]
    pixels, record = read_object(Path(imaged), settings.object_px)
    return torch.from_numpy(pixels).to(loaded.device), record
