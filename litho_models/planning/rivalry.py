"""Compute the separation of rivals (competing explanations) on planned scans. One rival is refitted to the
prediction of the other. The separation is the remaining difference between the two predictions, relative to
the noise.

The criterion is T-optimality (Atkinson and Fedorov 1975): the distance from the prediction of one model to
the nearest prediction that the other model can make. It is not known which of the two models is true, so the
distance is computed in both directions, and the smaller distance counts (a simple form of the symmetric
criterion of Harman and Müller, arXiv:1709.10320). Datum, tilt, bow, gain and affine registration are fitted
to every scan, so differences of these kinds do not count. The refitted model must stay consistent with
earlier prints and within the ranges of its parameters.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import FieldContext
from litho_models.effects.chain import EffectChain, Fields
from litho_models.fitting.least_squares import Linearised, eliminated_sum, orthonormal, solve_damped
from litho_models.loop.fits import RULES
from litho_models.loop.model import Twin
from litho_models.loop.prepared import ALL_FREE, sample_border_px
from litho_models.planning.questions import NoiseSpectrum, Question
from litho_models.scan_terms import TermPixels, term_maps
from litho_models.simulator import Simulator

Place = Literal["centre", "edge"]
_DAMPING = 1e-6
_SMALLEST = 1e-12


@dataclass(frozen=True)
class Way:
    """The way in which one scan is made. The fields of this class are also columns in the table of planned
    scans.

    ``turned_deg`` is the angle by which the print is rotated under the microscope. ``direction`` is 1 for the
    trace and -1 for the retrace. ``tip`` is 1 for the tip of earlier scans and 2 for a new, sharp tip.
    ``pixel_size`` is the size of a pixel relative to the pixel size of earlier scans; the time per pixel
    stays the same.
    """

    turned_deg: int = 0
    direction: int = 1
    tip: int = 1
    pixel_size: float = 1.0


@dataclass(frozen=True)
class PlannedPrint:
    """One planned print (a printed field) and its scans.

    ``level`` contains the levels of the layout and has shape (ny, nx). The levels need not be whole
    numbers.
    ``ways`` lists the ways in which the print is scanned, one per scan. ``place`` is the position in the
    write field. ``order`` is the position in the writing order, from -0.5 (first) to 0.5 (last). ``dose`` is
    relative to earlier prints.
    """

    level: Tensor
    ways: tuple[Way, ...]
    place: Place = "centre"
    order: float = 0.0
    dose: float = 1.0


@dataclass(frozen=True)
class Printing:
    """The settings that all planned prints share: the lateral pitch, the height of a level, the highest
    level, the width of the write field (None if it is unknown), and the axis perpendicular to the written
    lines. Lengths are in µm.
    """

    pitch_um: float
    level_height_um: float
    highest: int
    write_field_um: float | None = None
    slow_axis: Literal["y", "x"] = "y"

    def reach_um(self, printed: PlannedPrint) -> float:
        """Return the coordinate of the centre of a print relative to the centre of the write field, µm. It is
        the same along x and y, because a print whose place is the edge lies in a corner of the write field.
        It is 0 for a print at the centre, or if the width of the write field is unknown.
        """
        if printed.place == "centre" or self.write_field_um is None:
            return 0.0
        return (self.write_field_um - max(printed.level.shape) * self.pitch_um) / 2

    def context(self, layout_um: Tensor, printed: PlannedPrint, way: Way) -> FieldContext:
        """Return the facts about a planned scan that effects need, such as its orientation and its dose."""
        reach_um = self.reach_um(printed)
        return FieldContext(
            layout_um,
            self.pitch_um,
            self.highest * self.level_height_um,
            self.level_height_um,
            (reach_um, reach_um),
            None if self.write_field_um is None else self.write_field_um / 2,
            self.slow_axis,
            order=printed.order,
            quarter_turns=way.turned_deg // 90,
            backward=way.direction < 0,
            new_tip=way.tip > 1,
            pixel_size=way.pixel_size,
            dose=printed.dose,
        )

    def predict(
        self,
        chain: EffectChain,
        printed: PlannedPrint,
        way: Way,
        known: Fields | None = None,
        base_key: object = None,
    ) -> Tensor:
        """Predict the height that a planned scan would show, µm, of shape (ny, nx). ``known`` and
        ``base_key`` are passed to ``EffectChain.forward``.
        """
        layout_um = (printed.dose * self.level_height_um * printed.level)[None, None]
        return chain(layout_um, self.context(layout_um, printed, way), known, base_key)[0, 0]


@dataclass(frozen=True)
class Contrast:
    """The difference between the predictions of two rivals on some prints. One rival is assumed to be true,
    and the other is refitted to its prediction. Each attribute has shape (prints,), with one value for each
    print.

    ``squares_um2`` is the squared distance between the two predictions, summed over all pixels and scans of a
    print. ``sd_um2`` is the standard deviation that noise causes in the difference of the squared errors of
    the two rivals. ``pixels`` is the number of pixels in all scans of a print.
    """

    squares_um2: Tensor
    sd_um2: Tensor
    pixels: Tensor

    @property
    def rms_nm(self) -> float:
        """Return the rms difference between the two predictions over all pixels, nm."""
        return NM_PER_UM * float((self.squares_um2.sum() / self.pixels.sum()).sqrt())

    @property
    def noise_nm(self) -> float:
        """Return the standard deviation per pixel of the noise after projection onto the difference of the
        predictions, nm.
        """
        return NM_PER_UM * float((self.sd_um2 / (2 * self.squares_um2.sqrt() + _SMALLEST)).mean())

    def separation(self, spread: float) -> Tensor:
        """Return the squared distance between the two predictions in units of its standard deviation. The
        result is differentiable. ``spread`` is the relative standard deviation, over prints, of the squared
        distance (the field ``spread`` of the question).
        """
        variance = (self.sd_um2**2 + (spread * self.squares_um2) ** 2).sum()
        return self.squares_um2.sum() / torch.sqrt(variance + _SMALLEST**2)


class Rivalry:
    """The rivals of one question, and their predictions for planned prints.

    Args:
        question: a question with at least two rivals.
        base: the base model of all rivals. Its parameters come first in the field ``vector`` of a rival.
        printing: settings that all planned prints share.
        noise: spectrum of the noise, measured on the residuals of earlier prints.
    """

    def __init__(self, question: Question, base: Simulator, printing: Printing, noise: NoiseSpectrum):
        self.question = question
        self.printing = printing
        self.noise = noise
        self.twins = [rival.twin(Twin.bare(base)) for rival in question.rivals]
        # Each of the models in ``true`` is in turn assumed to be the true one. Refits of a model start from
        # its entry in ``twins``.
        self.true = self.chains = [*map(_chain, self.twins)]

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Return all ordered pairs of rivals. The first index of a pair is the model that is assumed to be
        true, and the second is the model that is refitted to its prediction.
        """
        return list(permutations(range(len(self.twins)), 2))

    def drawn(self, random: np.random.Generator) -> Rivalry:
        """Return a copy in which the models that are assumed to be true have random parameters. The
        parameters are drawn from the normal distribution that describes their uncertainty after earlier
        prints.
        """
        other = copy.copy(self)
        other.true = []
        for twin, rival in zip(self.twins, self.question.rivals, strict=True):
            moved = random.multivariate_normal(np.zeros(len(twin.vector)), np.array(rival.covariance))
            other.true.append(_chain(twin.at(twin.vector + np.clip(moved, *twin.room()))))
        return other

    def refitted(
        self,
        prints: Sequence[PlannedPrint],
        *,
        rounds: int = 1,
        first: Sequence[list[Linearised]] | None = None,
    ) -> list[EffectChain]:
        """For each ordered pair of rivals, refit the second model to the prediction of the first model.
        Return the refitted models, one per pair, in the order of ``pairs``.

        Args:
            prints: planned prints. The refit is not differentiable with respect to the levels of these
                prints.
            rounds: number of Gauss-Newton steps. With a single step, the refit is linear.
            first: the result of ``linearised`` for these prints, if it has already been computed.
        """
        predicted = [self._predict(chain, prints) for chain in self.true]
        first = first or self.linearised(prints)
        found = []
        for true, other in self.pairs:
            start = twin = self.twins[other]
            prior = np.array(self.question.rivals[other].information)
            for number in range(rounds):
                here = self._linearise(twin, prints) if number else first[other]
                linear = [
                    replace(part, residual=part.residual + _flat(wanted))
                    for part, wanted in zip(here, predicted[true], strict=True)
                ]
                normal, right, _ = eliminated_sum(linear, RULES.term_weight)
                right = right - prior @ (twin.vector - start.vector)
                twin = twin.at(twin.vector + solve_damped(normal + prior, right, _DAMPING, twin.room()))
            found.append(_chain(twin))
        return found

    def linearised(self, prints: Sequence[PlannedPrint]) -> list[list[Linearised]]:
        """Linearise the models of all rivals at the parameters from which a refit starts. Return one list per
        model, with one linear problem per scan.
        """
        # Rivals with the same base model share its predictions.
        known: list[Fields] = [{} for one in prints for _ in one.ways]
        return [self._linearise(twin, prints, known) for twin in self.twins]

    def contrasts(self, prints: Sequence[PlannedPrint], refitted: Sequence[EffectChain]) -> list[Contrast]:
        """Return the contrast of every ordered pair of rivals on the given prints. The argument ``refitted``
        is the result of the method ``refitted`` for these prints. The contrasts are differentiable with
        respect to the levels of the prints.
        """
        true = [self._predict(chain, prints) for chain in self.true]
        return [
            self._contrast(true[first], self._predict(partner, prints), prints)
            for (first, _), partner in zip(self.pairs, refitted, strict=True)
        ]

    def separations(self, prints: Sequence[PlannedPrint], refitted: Sequence[EffectChain]) -> Tensor:
        """Return the separation of each ordered pair of rivals, in standard deviations. The result has shape
        (pairs,) and is differentiable with respect to the levels of the prints.
        """
        return torch.stack([one.separation(self.question.spread) for one in self.contrasts(prints, refitted)])

    def _contrast(
        self, true: Sequence[Tensor], other: Sequence[Tensor], prints: Sequence[PlannedPrint]
    ) -> Contrast:
        """Compare the predictions of two models for the given prints. All scans of a print show the same
        roughness. The difference maps of these scans are therefore added before the noise is computed.
        """
        found, scans = [], iter(zip(true, other, strict=True))
        for printed in prints:
            squares, together, pixels = torch.zeros(()), torch.zeros(()), 0
            for _ in printed.ways:
                right, refitted = next(scans)
                # The scan terms are computed from the refitted prediction. If the gain term were computed
                # from the true prediction, the refitted prediction could shrink to zero.
                basis = torch.from_numpy(_free_basis(refitted.detach())).to(right)
                inner = _inner(right - refitted)
                flat = inner.reshape(-1)
                freed = (flat - basis @ (basis.T @ flat)).reshape(inner.shape)
                squares, together = squares + (freed**2).sum(), together + freed
                pixels += flat.numel()
            power = torch.from_numpy(self.noise.on_grid(together.shape)).to(together) / NM_PER_UM**2
            variance = 4 * (torch.fft.fft2(together).abs() ** 2 * power).sum() / together.numel()
            found.append((squares, torch.sqrt(variance + _SMALLEST**2), torch.tensor(float(pixels))))
        return Contrast(*map(torch.stack, zip(*found, strict=True)))

    def _predict(self, chain: EffectChain, prints: Sequence[PlannedPrint]) -> list[Tensor]:
        return [self.printing.predict(chain, one, way) for one in prints for way in one.ways]

    def _linearise(
        self, twin: Twin, prints: Sequence[PlannedPrint], known: Sequence[Fields] | None = None
    ) -> list[Linearised]:
        """Linearise the predictions of a model for each scan of the prints. The residual in the result is the
        negative of the predicted height. The caller must add the heights to which the model is fitted.
        ``known`` is a cache of intermediate fields of each scan.
        """
        scans = [(one, way) for one in prints for way in one.ways]
        known = known or [{} for _ in scans]

        def predicted(own: Twin) -> list[Tensor]:
            chain, key = _chain(own), own.numbers.tobytes()
            pairs = zip(scans, known, strict=True)
            return [self.printing.predict(chain, *scan, fields, key) for scan, fields in pairs]

        steps = twin.steps()
        here = predicted(twin)
        aside = [predicted(twin.at(twin.vector + one)) for one in np.diag(steps)]
        return [
            Linearised(
                -_flat(height),
                np.stack([_flat(own[at] - height) for own in aside]) / steps[:, None],
                _free_basis(height).T,
            )
            for at, height in enumerate(here)
        ]


def _chain(twin: Twin) -> EffectChain:
    return twin.chain().requires_grad_(False)


def _inner(field: Tensor) -> Tensor:
    """Crop the border of a field, where the prediction depends on surroundings that are not part of the
    field.
    """
    border = sample_border_px(min(field.shape))
    return field[border:-border, border:-border]


def _flat(field: Tensor) -> np.ndarray:
    return _inner(field).reshape(-1).numpy().astype(np.float64)


def _free_basis(prediction_um: Tensor) -> np.ndarray:
    """Return an orthonormal basis of the k terms that are fitted to each scan, at the n interior pixels of
    the scan. The result has shape (n, k).
    """
    return orthonormal(term_maps(TermPixels(_inner(prediction_um).numpy()), ALL_FREE).T)
