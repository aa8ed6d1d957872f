"""Make random layouts by the paper's equation.

The equation is in arXiv:2309.17343, supplement, "Generate randomized … layout".
"""

import numpy as np

from litho_data.foundation import Array, InputError, Shape, require_known
from litho_data.foundation.quantities import LEVELS

PASSBANDS = ("square", "round")
QUANTISERS = ("round", "floor")


def random_layout(
    shape: Shape,
    *,
    levels: int = 13,
    cutoff_per_um: float = 0.25,
    pitch_um: float = 0.1,
    seed: int | np.random.SeedSequence | np.random.Generator = 0,
    passband: str = "square",
    quantiser: str = "round",
    field_px: int | None = None,
) -> Array:
    """Make one random layout ``M = Q(norm(Re(F⁻¹(F(R)·LPF))))`` by low-pass filtering noise ``R ~ U(0, 1)``.

    ``F`` is the Fourier transform, and ``LPF`` is a low-pass filter. ``norm`` maps the smallest value to 0
    and the largest to 1, and ``Q`` rounds to the nearest of ``levels`` values (halves are rounded up). The
    result is periodic in both directions.

    The paper does not define the low-pass filter. The spectra of the layouts that its authors published show
    a sharp square pass band of ±0.25 cycles/µm (prints 1–4) or ±0.5 cycles/µm (prints 6 and 7). These layouts
    were cut from a larger field, and their levels were rounded down; ``quantiser="floor", field_px=540``
    makes similar layouts.

    Args:
        shape: shape (ny, nx) of the layout in pixels.
        levels: number of levels L; the result contains integers 0…L−1.
        cutoff_per_um: highest spatial frequency that the filter passes, cycles/µm.
        pitch_um: pixel pitch, µm.
        seed: seed of the noise, as `numpy.random.default_rng` accepts it.
        passband: ``square`` applies the cut-off to the frequencies along x and along y separately. ``round``
            applies it to the length of the frequency vector.
        quantiser: ``round`` rounds as in the paper's equation. ``floor`` rounds down, so only the pixels with
            the largest value get the highest level.
        field_px: side length, in pixels, of a larger field from whose middle the layout is cut. Such a layout
            is not periodic and may lack the lowest or the highest level. If None, the layout is the whole
            field.

    Returns:
        The level of each pixel, shape (ny, nx), as uint8, or as uint16 if there are more than 256 levels.

    Raises:
        InputError: there are fewer than 2 or more than 65536 levels, the cut-off frequency is too high for
            the pitch or so low that only the mean passes, or the field is smaller than the layout.
    """
    LEVELS.require("levels of a layout", levels)
    whole = shape if field_px is None else (field_px, field_px)
    if field_px is not None and field_px < max(shape):
        raise InputError("field_px of a random layout", got=field_px, wanted=f"at least {max(shape)}")
    if cutoff_per_um * pitch_um > 0.5 + 1e-9:
        raise InputError(
            "cutoff_per_um of a random layout",
            got=cutoff_per_um,
            wanted=f"at most {0.5 / pitch_um:g} cycles/µm, the limit for pixels of {pitch_um:g} µm",
        )
    field = low_pass(
        np.random.default_rng(seed).random(whole),
        cutoff_per_um=cutoff_per_um,
        pitch_um=pitch_um,
        passband=passband,
    )
    lowest, highest = field.min(), field.max()
    # If only the mean passes the filter, rounding errors of the transform still cause variations of about
    # 1e-17.
    if highest - lowest < 1e-12:
        raise InputError(
            "cutoff_per_um of a random layout",
            got=cutoff_per_um,
            wanted=f"at least {1 / (max(whole) * pitch_um):.4g} cycles/µm for {whole[0]} x {whole[1]} pixels",
        )
    level = quantise((field - lowest) / (highest - lowest), levels, quantiser)
    top, left = ((all_px - px) // 2 for all_px, px in zip(whole, shape, strict=True))
    return level[top : top + shape[0], left : left + shape[1]]


def low_pass(field: Array, *, cutoff_per_um: float, pitch_um: float, passband: str) -> Array:
    """Keep spatial frequencies up to and including ``cutoff_per_um``, with periodic boundaries."""
    require_known("passband", passband, PASSBANDS)
    if not cutoff_per_um > 0 or not pitch_um > 0:
        raise InputError(
            "cutoff_per_um and pitch_um", got=(cutoff_per_um, pitch_um), wanted="positive numbers"
        )
    frequency_y = np.fft.fftfreq(field.shape[0], pitch_um)[:, None]
    frequency_x = np.fft.rfftfreq(field.shape[1], pitch_um)[None, :]
    if passband == "square":
        distance = np.maximum(np.abs(frequency_y), frequency_x)
    else:
        distance = np.hypot(frequency_y, frequency_x)
    # The filter is an even function of frequency, so the filtered field is real and a real transform is
    # enough.
    return np.fft.irfft2(np.fft.rfft2(field) * (distance <= cutoff_per_um), s=field.shape)


def quantise(unit_field: Array, levels: int, quantiser: str = "round") -> Array:
    """Map values from 0 to 1 to the integers 0 to ``levels - 1``. The quantiser ``round`` rounds to the
    nearest integer (halves up), and ``floor`` rounds down.
    """
    require_known("quantiser", quantiser, QUANTISERS)
    whole = np.floor(unit_field * (levels - 1) + 0.5 * (quantiser == "round"))
    return whole.astype(np.min_scalar_type(levels - 1))
