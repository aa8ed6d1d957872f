"""Compute the separation of rivals on planned scans: their difference after a refit, relative to the noise.

The criterion is T-optimality (Atkinson and Fedorov 1975): the distance from the prediction of one model to
the nearest prediction of the other. Neither model is known to be true, so the smaller distance of the two
directions counts (a simple form of the symmetric criterion of Harman and Müller, arXiv:1709.10320). Every
scan has its own datum, tilt, bow, gain and affine registration. The refitted model must stay consistent with
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
from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import Linearised, eliminated_sum, orthonormal, solve_damped
from litho_models.loop.fits import ALL_FREE, RULES
from litho_models.loop.model import Twin
from litho_models.loop.prepared import sample_border_px
from litho_models.planning.questions import NoiseSpectrum, Question
from litho_models.scan_terms import TermPixels, term_maps
from litho_models.simulator import Simulator

Place = Literal["centre", "edge"]
_DAMPING = 1e-6
_SMALLEST = 1e-12


@dataclass(frozen=True)
class Way:
    """How one scan is made. The fields of this class are columns in the table of the plan.

    ``turned_deg`` is the angle of the print under the microscope. ``direction`` is -1 for the retrace, and
    ``tip`` is 2 for a second, sharp tip. ``pixel_size`` is the size of a pixel relative to earlier scans,
    with the same time per pixel.
    """

    turned_deg: int = 0
    direction: int = 1
    tip: int = 1
    pixel_size: float = 1.0


@dataclass(frozen=True)
class PlannedPrint:
    """One printed field and its scans.

    ``level`` contains whole or soft levels (y, x). ``place`` is the position in the write field, ``order``
    runs from -0.5 (first) to 0.5 (last), and ``dose`` is relative to earlier prints.
    """

    level: Tensor
    ways: tuple[Way, ...]
    place: Place = "centre"
    order: float = 0.0
    dose: float = 1.0


@dataclass(frozen=True)
class Printing:
    """The settings that all prints share: pitch, level height, highest level, and width of the write field
    (µm, or None).
    """

    pitch_um: float
    level_height_um: float
    highest: int
    write_field_um: float | None = None

    def reach_um(self, printed: PlannedPrint) -> float:
        """Return the largest distance from the centre of a print to the centre of the write field, along both
        axes.
        """
        if printed.place == "centre" or self.write_field_um is None:
            return 0.0
        return (self.write_field_um - max(printed.level.shape) * self.pitch_um) / 2

    def context(self, layout_um: Tensor, printed: PlannedPrint, way: Way) -> FieldContext:
        """Return the context of a planned scan, for effects."""
        reach_um = self.reach_um(printed)
        return FieldContext(
            layout_um,
            self.pitch_um,
            self.highest * self.level_height_um,
            self.level_height_um,
            (reach_um, reach_um),
            None if self.write_field_um is None else self.write_field_um / 2,
            order=printed.order,
            quarter_turns=way.turned_deg // 90,
            backward=way.direction < 0,
            new_tip=way.tip > 1,
            pixel_size=way.pixel_size,
            dose=printed.dose,
        )

    def predict(self, chain: EffectChain, printed: PlannedPrint, way: Way) -> Tensor:
        """Predict the height (y, x), µm, that this scan would show."""
        layout_um = (printed.dose * self.level_height_um * printed.level)[None, None]
        return chain(layout_um, self.context(layout_um, printed, way))[0, 0]


@dataclass(frozen=True)
class Contrast:
    """A directed pair of rivals on some prints; each quantity has shape (prints,).

    ``squares_um2`` is the squared distance, summed over all pixels and scans. ``sd_um2`` is the standard
    deviation that noise causes in the difference of the two squared errors. ``pixels`` is the number of
    pixels of all scans.
    """

    squares_um2: Tensor
    sd_um2: Tensor
    pixels: Tensor

    @property
    def rms_nm(self) -> float:
        """Return the rms distance over pixels, nm."""
        return NM_PER_UM * float((self.squares_um2.sum() / self.pixels.sum()).sqrt())

    @property
    def noise_nm(self) -> float:
        """Return the standard deviation of the noise along the difference, per pixel."""
        return NM_PER_UM * float((self.sd_um2 / (2 * self.squares_um2.sqrt() + _SMALLEST)).mean())

    def separation(self, spread: float) -> Tensor:
        """Return the distance in standard deviations, which is differentiable. ``spread`` is the spread that
        the question states.
        """
        variance = (self.sd_um2**2 + (spread * self.squares_um2) ** 2).sum()
        return self.squares_um2.sum() / torch.sqrt(variance + _SMALLEST**2)


class Rivalry:
    """The rivals of one question, and what they predict for planned prints.

    Args:
        question: a question with at least two rivals.
        base: the simulator whose parameters come first in the rivals' vectors.
        printing: pitch and levels.
        noise: spectrum of the residual of earlier prints.
    """

    def __init__(self, question: Question, base: Simulator, printing: Printing, noise: NoiseSpectrum):
        self.question = question
        self.printing = printing
        self.noise = noise
        self.twins = [rival.twin(Twin.bare(base)) for rival in question.rivals]
        # Each of these models is assumed to be true in turn; refits start from ``twins``.
        self.true = self.chains = [*map(_chain, self.twins)]

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Return the directed pairs: the model assumed to be true, and the model refitted to it."""
        return list(permutations(range(len(self.twins)), 2))

    def drawn(self, random: np.random.Generator) -> Rivalry:
        """Draw the rivals' true parameters within the uncertainty that remains after earlier prints."""
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
        """For each directed pair, fit the second model to the prediction of the first.

        Args:
            prints: planned prints. The fit is not differentiable in the levels of these prints.
            rounds: number of Gauss-Newton steps. With one step, the refit is linearised.
            first: the result of ``linearised`` on these prints, if known.
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
        """Linearise all models at the start of a refit."""
        return [self._linearise(twin, prints) for twin in self.twins]

    def contrasts(self, prints: Sequence[PlannedPrint], refitted: Sequence[EffectChain]) -> list[Contrast]:
        """Return the contrast of every directed pair on these prints, differentiable in the levels."""
        true = [self._predict(chain, prints) for chain in self.true]
        return [
            self._contrast(true[first], self._predict(partner, prints), prints)
            for (first, _), partner in zip(self.pairs, refitted, strict=True)
        ]

    def separations(self, prints: Sequence[PlannedPrint], refitted: Sequence[EffectChain]) -> Tensor:
        """Return the separation of each directed pair, (pairs,), in standard deviations. It is differentiable
        in the levels.
        """
        return torch.stack([one.separation(self.question.spread) for one in self.contrasts(prints, refitted)])

    def _contrast(
        self, true: Sequence[Tensor], other: Sequence[Tensor], prints: Sequence[PlannedPrint]
    ) -> Contrast:
        """Compare two models. The differences are added over the scans of a print, because all of these scans
        show the same roughness.
        """
        found, scans = [], iter(zip(true, other, strict=True))
        for printed in prints:
            squares, together, pixels = torch.zeros(()), torch.zeros(()), 0
            for _ in printed.ways:
                right, refitted = next(scans)
                # The scan terms are those of the refitted model. With the gain term of the true model, the
                # refitted prediction could shrink to zero.
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

    def _linearise(self, twin: Twin, prints: Sequence[PlannedPrint]) -> list[Linearised]:
        """Linearise a twin on each scan of the prints. The residual is zero minus the predicted height."""
        steps = twin.steps()
        here = self._predict(_chain(twin), prints)
        moved = [twin.at(twin.vector + one) for one in np.diag(steps)]
        aside = [self._predict(_chain(one), prints) for one in moved]
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
    """Cut off the edge, where part of the neighbourhood that a model uses is missing."""
    border = sample_border_px(min(field.shape))
    return field[border:-border, border:-border]


def _flat(field: Tensor) -> np.ndarray:
    return _inner(field).reshape(-1).numpy().astype(np.float64)


def _free_basis(prediction_um: Tensor) -> np.ndarray:
    """Return the orthonormal basis (n, k) of a scan's free terms on the inner pixels."""
    return orthonormal(term_maps(TermPixels(_inner(prediction_um).numpy()), ALL_FREE).T)
