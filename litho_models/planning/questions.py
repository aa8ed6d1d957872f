"""The record ``open_questions.json`` with the open questions of a closed loop, from which experiments are
planned.

The possible answers to a question are called rivals (competing explanations). The fits of all rivals start
from the same values of the base parameters, because the fit of the base model has more than one optimum. For
example, one optimum may have an almost linear relation between dose and height, and another optimum a steep
one. If the fits of two equivalent effects ended in different optima, their predictions on new layouts could
differ by several nm² (mean square) for this reason alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field
from scipy.ndimage import map_coordinates
from torch import Tensor

from litho_data.foundation import Array
from litho_data.foundation.results import Record, Result
from litho_data.foundation.units import NM_PER_UM
from litho_data.roughness.spectrum import hann
from litho_data.store.schema import DatasetId, Instrument, Surround
from litho_models.effects.chain import Frame
from litho_models.fitting.least_squares import LeastSquaresFit, eliminated_sum, fit_least_squares
from litho_models.loop.fits import RULES, TwinProblem
from litho_models.loop.model import Twin
from litho_models.loop.prepared import ALL_FREE, PreparedScan, sample_border_px
from litho_models.loop.record import Decided
from litho_models.loop.run import QUESTIONS_FILE
from litho_models.scan_terms import freed_um

# The answer that none of the rivals is right.
NONE: Decided = "none of them"
_TILE_PX = 64


class NoiseSpectrum(Record):
    """The power spectrum of the noise, nm². It is estimated from residuals, as the average over square tiles.

    ``power_nm2`` has shape (n, n), for tiles with a side of n pixels. Its frequencies are in the order of
    ``np.fft.fft2``, and its mean is the variance of a pixel.
    """

    power_nm2: list[list[float]]

    def on_grid(self, shape: tuple[int, ...]) -> Array:
        """Interpolate the power spectrum, nm², at the frequencies that ``np.fft.fft2`` uses for a map of the
        given shape. The result has the given shape.
        """
        power = np.array(self.power_nm2)
        at = np.meshgrid(*[np.fft.fftfreq(n) * len(power) for n in shape], indexing="ij")
        return map_coordinates(power, at, order=1, mode="grid-wrap")

    def variance(self, change: Tensor) -> Tensor:
        """Return the variance, nm⁴, that the noise causes in the sum over pixels of noise times change.
        ``change`` is a change of the height, nm, of shape (…, ny, nx). The result has shape (…) and is
        differentiable.
        """
        power = torch.from_numpy(self.on_grid(change.shape[-2:])).to(change)
        return (torch.fft.fft2(change).abs() ** 2 * power).sum((-2, -1)) / power.numel()


def inner(shape: Sequence[int]) -> tuple[slice, slice]:
    """Return the index of a map of the given shape (ny, nx) without its border, where the prediction depends
    on surroundings that are not part of the map.
    """
    border = sample_border_px(min(shape))
    return (slice(border, -border),) * 2


def left_nm(scan: PreparedScan, prediction_um: Array) -> Array:
    """Fit the free per-scan terms to the residual of a scan (measured minus predicted height), and subtract
    them. Return the remaining residual, nm. The result is a two-dimensional map without the pixels at the
    edge of the scan.

    Pixels that were not measured are NaN.
    """
    at = inner(scan.shape)
    used = scan.usable[at]
    freed = freed_um(scan.height_um[at], prediction_um[at], used, ALL_FREE)
    return np.where(used, NM_PER_UM * freed, np.nan)


def noise_spectrum(residuals_nm: Sequence[Array]) -> NoiseSpectrum:
    """Compute the noise spectrum from the residual maps that ``left_nm`` returns. Only tiles without missing
    pixels are used. If there is no such tile, the spectrum of white noise with the variance of the residuals
    is returned.
    """
    size = min(_TILE_PX, *(min(one.shape) for one in residuals_nm))
    window = hann((size, size))
    powers = []
    for residual in residuals_nm:
        every = sliding_window_view(residual, window.shape)[:: size // 2, :: size // 2]
        tiles = every[np.isfinite(every).all(axis=(2, 3))]
        about_mean = tiles - tiles.mean(axis=(1, 2), keepdims=True)
        powers += [*np.abs(np.fft.fft2(about_mean * window)) ** 2 / (window**2).sum()]
    powers = powers or [np.full(window.shape, np.mean([*map(np.nanvar, residuals_nm)]))]
    return NoiseSpectrum(power_nm2=np.mean(powers, axis=0).round(3).tolist())


Kind = Literal["set", "suspects", "role", "per-scan", "lines", "fact"]
Owner = Literal["printer", "microscope"]


class Rival(Record):
    """One possible answer to a question (a competing explanation). It is a model that was fitted to earlier
    prints and that consists of the base model and effects. The strength of each effect is the same in all
    scans.

    Attributes:
        effect: name of the effect that this answer assumes.
        owner: source of the effect (printer or microscope) that this answer assumes, if the question is about
            the source.
        effects: parameter values of all effects in the model, keyed by the name of the effect.
        vector: the p fitted parameters. The parameters of the base come first.
        information: normal matrix of the fit, µm², of shape (p, p). The fit uses only some pixels of each
            scan's window, so the matrix is scaled to the number of all measured pixels of the windows.
        covariance: cluster-robust covariance of the parameters, of shape (p, p). The clusters are prints or
            scans.
    """

    effect: str
    owner: Owner | None = None
    effects: dict[str, dict[str, float]]
    vector: list[float]
    information: list[list[float]]
    covariance: list[list[float]] = Field(default_factory=list)

    @property
    def name(self) -> str:
        """Return the answer in words."""
        return self.effect if self.owner is None else f"{self.effect} as the {self.owner}'s"

    def twin(self, base: Twin) -> Twin:
        """Return the model of this answer. It has the base model of ``base`` and the effects of this answer.
        If this answer assumes that the printer causes the effect, the effect rotates with the print. If it
        assumes the microscope, the effect rotates with the scan.
        """
        frame: Frame = "print" if self.owner == "printer" else "scan"
        frames = {self.effect: frame} if self.owner else {}
        return replace(base.with_effects(self.effects), frames=frames).at(np.array(self.vector))


class Question(Record):
    """A question that a run of the closed loop left open.

    Attributes:
        kind: what the question asks. ``set``: which effect of an indistinguishable set is present;
            ``suspects``: which of several unconfirmed effects is present; ``role``: whether the printer or
            the microscope causes an effect; ``per-scan``: whether the printer or the microscope causes a
            per-scan term; ``lines``: whether the printer or the microscope causes line offsets; ``fact``: a
            fact that is missing in the dataset card (the TOML file that describes a campaign).
        text: the question in words.
        experiment: experiments that would answer the question, in words.
        rivals: the possible answers.
        spread: relative standard deviation, over scans, of the evidence for the effect, i.e. of the decrease
            of the squared error. The part that noise causes is not included.
        form_nm: upper bound, nm, on the rms error that inexact formulas of the model cause; None if it is
            unknown. It is derived from the residual of a model that assumes one of the answers, namely from
            the part of this residual that could still be learned.
        sizes: standard deviations of the parameters of a per-scan term over scans, keyed by the name of the
            parameter.
    """

    name: str
    kind: Kind
    text: str
    experiment: str
    rivals: list[Rival] = Field(default_factory=list)
    spread: float = 0.0
    form_nm: float | None = None
    sizes: dict[str, float] = Field(default_factory=dict)


class OpenQuestions(Result):
    """The record ``open_questions.json``. It contains the open questions, and the spectrum of the noise,
    which limits how well these questions can be decided.

    ``level_share`` contains, for each level, the fraction of earlier layouts that it covers.
    ``cutoff_per_um`` is the spatial frequency of the finest structures in these layouts, cycles/µm, or 0 if
    every layout has only one level.
    ``write_field_um`` is the width of the write field, or None if it is unknown. ``slow_axis`` is the axis
    perpendicular to the written lines, ``surround`` is what the dataset card says about the surroundings of a
    print, and ``instrument`` is the kind of instrument that made the scans.
    """

    SCHEMA: ClassVar[str] = "litho-models/open-questions/3"
    FILE_NAME: ClassVar[str] = QUESTIONS_FILE

    dataset: DatasetId
    noise: NoiseSpectrum
    level_share: list[float]
    cutoff_per_um: float
    write_field_um: float | None
    slow_axis: Literal["y", "x"] = "y"
    surround: Surround | None = None
    instrument: Instrument = "afm"
    questions: list[Question]


def fit_rivals(twins: Mapping[str, Twin], windows: Sequence[PreparedScan]) -> dict[str, LeastSquaresFit]:
    """Fit each model twice. The first fit starts from the current parameter values of the model. In the
    second fit, the base parameters start from those of the model that fitted best, and the other parameters
    start from the result of the first fit. For each model, keep the better of the two fits. Models and fits
    are keyed by the name of the answer.
    """

    def fitted(twin: Twin) -> LeastSquaresFit:
        return fit_least_squares(TwinProblem(twin, windows), twin.vector, RULES)

    def squares(fit: LeastSquaresFit) -> float:
        return eliminated_sum(fit.linear, RULES.term_weight)[2]

    fits = {name: fitted(twin) for name, twin in twins.items()}
    best = min(fits.values(), key=squares)
    for name, fit in fits.items():
        own = twins[name].own
        if own and fit is not best:
            start = np.concatenate([best.vector[:own], fit.vector[own:]])
            fits[name] = min(fit, fitted(twins[name].at(start)), key=squares)
    return fits
