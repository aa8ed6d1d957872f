"""How far rivals differ on planned scans, each refitted to the other, against the noise.

T-optimal discrimination (Atkinson and Fedorov 1975): of two models the distance between what one predicts and
the nearest that the other can predict. Both directions count, and the smaller one is kept, as neither is
known to be true (a simple form of the symmetric criterion of Harman and Müller, arXiv:1709.10320). Every scan
may add its own datum, tilt, bow, gain and affine registration. The refitted model keeps to what the prints so
far say about it, and to the ranges of its parameters.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import FieldContext
from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import gram, orthonormal, solve_damped
from litho_models.loop.fold_fits import TERM_WEIGHT
from litho_models.loop.linear import ALL_FREE
from litho_models.loop.parameters import chain_at, difference_steps, get_vector, room
from litho_models.loop.residual_spectrum import NoiseSpectrum
from litho_models.loop.result.questions import Question, Rival
from litho_models.scan_terms import TermPixels, term_maps
from litho_models.simulator import Simulator

Place = Literal["centre", "edge"]
# Of each scan: prediction (y, x), derivatives (n, p) on the inner pixels, free basis (n, k).
Linear = list[tuple[Tensor, np.ndarray, np.ndarray]]
_DAMPING = 1e-6
_BORDER_PX = 8
_SMALLEST = 1e-12


@dataclass(frozen=True)
class Way:
    """How one scan is made.

    ``turned_deg``: by how much the print lies turned under the microscope; ``backward``: lines recorded on
    the way back; ``new_tip``: with another, sharp tip; ``fine``: with pixels of half the size, and as much
    time for each.
    """

    turned_deg: int = 0
    backward: bool = False
    new_tip: bool = False
    fine: bool = False

    @property
    def pixel_size(self) -> float:
        """Of the scan, relative to the scans so far."""
        return 0.5 if self.fine else 1.0


@dataclass(frozen=True)
class PlannedPrint:
    """One printed field and its scans.

    ``level``: (y, x), whole or soft levels; ``place``: in the write field; ``order``: -0.5 first, 0.5 last;
    ``dose``: relative to the prints so far.
    """

    level: Tensor
    ways: tuple[Way, ...]
    place: Place = "centre"
    order: float = 0.0
    dose: float = 1.0


@dataclass(frozen=True)
class Printing:
    """What all prints share: pitch, level height, highest level, write field (µm, or None)."""

    pitch_um: float
    level_height_um: float
    highest: int
    write_field_um: float | None = None

    def context(self, layout_um: Tensor, printed: PlannedPrint, way: Way) -> FieldContext:
        """What effects know of a planned scan."""
        reach_um = 0.0
        if printed.place == "edge" and self.write_field_um is not None:
            reach_um = (self.write_field_um - max(layout_um.shape) * self.pitch_um) / 2
        return FieldContext(
            layout_um=layout_um,
            pitch_um=self.pitch_um,
            full_height_um=self.highest * self.level_height_um,
            slice_um=self.level_height_um,
            field_centre_um=(reach_um, reach_um),
            field_radius_um=None if self.write_field_um is None else self.write_field_um / 2,
            order=printed.order,
            quarter_turns=way.turned_deg // 90,
            backward=way.backward,
            new_tip=way.new_tip,
            pixel_size=way.pixel_size,
            dose=printed.dose,
        )

    def predict(self, chain: EffectChain, printed: PlannedPrint, way: Way) -> Tensor:
        """Height (y, x), µm, as this scan would show it."""
        layout_um = (printed.dose * self.level_height_um * printed.level)[None, None]
        return chain(layout_um, self.context(layout_um, printed, way))[0, 0]


@dataclass(frozen=True)
class Contrast:
    """A directed pair on some prints: one figure per print.

    ``squares_um2``: squared distance over all pixels and scans; ``sd_um2``: standard deviation by which noise
    moves the difference of the two squared errors; ``pixels``: of all its scans.
    """

    squares_um2: np.ndarray
    sd_um2: np.ndarray
    pixels: np.ndarray

    @property
    def rms_nm(self) -> float:
        """Root of the mean squared distance over pixels."""
        return NM_PER_UM * float(np.sqrt(self.squares_um2.sum() / self.pixels.sum()))

    @property
    def noise_nm(self) -> float:
        """Standard deviation of the noise along the difference, per pixel."""
        rms = np.sqrt(np.maximum(self.squares_um2, _SMALLEST**2))
        return NM_PER_UM * float(np.mean(self.sd_um2 / (2 * rms)))


class Rivalry:
    """The rivals of one question, and what they predict of planned prints.

    Args:
        question: with at least two rivals.
        base: the simulator whose numbers come first in their vectors.
        printing: pitch and levels.
        noise: what is left of the prints so far.
    """

    def __init__(self, question: Question, base: Simulator, printing: Printing, noise: NoiseSpectrum):
        self.question = question
        self.printing = printing
        self.noise = noise
        self.chains = [self._chain(rival, base) for rival in question.rivals]
        # What is true, if a rival is; refits start from ``chains``.
        self.true = self.chains
        self._power: dict[tuple[int, int], Tensor] = {}
        self.prior = [np.array(rival.information) for rival in question.rivals]

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Directed pairs: (the true one, the one refitted to it)."""
        every = range(len(self.chains))
        return [(a, b) for a in every for b in every if a != b]

    def drawn(self, random: np.random.Generator) -> Rivalry:
        """The same rivals, each as true with numbers that the prints so far allow as well.

        Without a covariance the fitted numbers stay.
        """
        other = copy.copy(self)
        other.true = []
        for chain, rival in zip(self.chains, self.question.rivals, strict=True):
            vector = get_vector(chain)
            if rival.covariance:
                spread = random.multivariate_normal(np.zeros(len(vector)), np.array(rival.covariance))
                vector = vector + np.clip(spread, *room(chain, vector))
            other.true.append(chain_at(chain, vector))
        return other

    def refitted(
        self, prints: Sequence[PlannedPrint], *, rounds: int = 1, first: Sequence[Linear] | None = None
    ) -> list[EffectChain]:
        """For each directed pair the second model, fitted to what the first predicts.

        Args:
            prints: levels are taken as they are, without derivatives.
            rounds: Gauss-Newton steps; one is the linearised refit.
            first: the models on these prints, ``linearised``, if they are known.
        """
        with torch.no_grad():
            predicted = [self._predict(chain, prints) for chain in self.true]
            first = self.linearised(prints) if first is None else first
            found = []
            for true, other in self.pairs:
                chain = self.chains[other]
                start = vector = get_vector(chain)
                for number in range(rounds):
                    here = chain_at(chain, vector)
                    linear = first[other] if number == 0 else self._linearise(here, prints)
                    vector = vector + self._step(
                        here, linear, predicted[true], self.prior[other], vector - start
                    )
                found.append(chain_at(chain, vector))
            return found

    def linearised(self, prints: Sequence[PlannedPrint]) -> list[Linear]:
        """The models where a refit starts, whatever it is fitted to."""
        with torch.no_grad():
            return [self._linearise(chain, prints) for chain in self.chains]

    def contrasts(
        self, prints: Sequence[PlannedPrint], refitted: Sequence[EffectChain] | None = None
    ) -> list[Contrast]:
        """Every directed pair on these prints, each print by itself."""
        partners = refitted or self.refitted(prints, rounds=2)
        with torch.no_grad():
            parts = self._of_pairs(prints, partners)
        return [Contrast(*np.array([[float(x) for x in one] for one in part]).T) for part in parts]

    def separations(
        self,
        prints: Sequence[PlannedPrint],
        refitted: Sequence[EffectChain],
        only: Sequence[int] | None = None,
    ) -> Tensor:
        """Distance of each directed pair, or ``only`` of these, in standard deviations, (pairs,).

        Differentiable in the levels.
        """
        spread = self.question.spread
        scores = []
        for part in self._of_pairs(prints, refitted, only):
            squares, sd, _ = zip(*part, strict=True)
            total = torch.stack(squares).sum()
            variance = (torch.stack(sd) ** 2 + (spread * torch.stack(squares)) ** 2).sum()
            scores.append(total / torch.sqrt(variance + _SMALLEST**2))
        return torch.stack(scores)

    def _of_pairs(
        self,
        prints: Sequence[PlannedPrint],
        partners: Sequence[EffectChain],
        only: Sequence[int] | None = None,
    ) -> list[list[tuple[Tensor, Tensor, int]]]:
        """Per directed pair and print: squared distance, deviation by noise, pixels."""
        wanted = range(len(self.pairs)) if only is None else only
        firsts = {self.pairs[i][0] for i in wanted}
        true = {first: self._predict(self.true[first], prints) for first in firsts}
        return [
            self._of_pair(true[self.pairs[i][0]], self._predict(partners[i], prints), prints) for i in wanted
        ]

    def _of_pair(
        self, true: Sequence[Tensor], other: Sequence[Tensor], prints: Sequence[PlannedPrint]
    ) -> list[tuple[Tensor, Tensor, int]]:
        """Scans of one print share its roughness: their differences add up before the noise meets them."""
        found, scans = [], iter(zip(true, other, strict=True))
        for printed in prints:
            squares, together, pixels = torch.zeros(()), torch.zeros(()), 0
            for _ in printed.ways:
                right, refitted = next(scans)
                # The refitted model's own maps: a gain of the true one would let the other fade to nothing.
                basis = torch.from_numpy(_free_basis(refitted.detach().numpy())).to(right)
                inner = _inner(right - refitted)
                flat = inner.reshape(-1)
                freed = (flat - basis @ (basis.T @ flat)).reshape(inner.shape)
                squares, together = squares + (freed**2).sum(), together + freed
                pixels += flat.numel()
            spectrum = torch.fft.fft2(together).abs() ** 2
            variance = 4 * (spectrum * self._power_um2(together)).sum() / together.numel()
            found.append((squares, torch.sqrt(variance + _SMALLEST**2), pixels))
        return found

    def _power_um2(self, like: Tensor) -> Tensor:
        """The noise at the frequencies of this map."""
        shape = like.shape[0], like.shape[1]
        if shape not in self._power:
            self._power[shape] = torch.from_numpy(self.noise.on_grid(shape)).to(like) / NM_PER_UM**2
        return self._power[shape]

    def _predict(self, chain: EffectChain, prints: Sequence[PlannedPrint]) -> list[Tensor]:
        return [self.printing.predict(chain, one, way) for one in prints for way in one.ways]

    def _linearise(self, chain: EffectChain, prints: Sequence[PlannedPrint]) -> Linear:
        vector = get_vector(chain)
        steps = difference_steps(chain, vector)
        here = self._predict(chain, prints)
        aside = [
            self._predict(chain_at(chain, vector + step * (np.arange(len(vector)) == i)), prints)
            for i, step in enumerate(steps)
        ]
        return [
            (
                height,
                np.column_stack(
                    [_flat(own[at] - height) / step for own, step in zip(aside, steps, strict=True)]
                ),
                _free_basis(height.numpy()),
            )
            for at, height in enumerate(here)
        ]

    def _step(
        self,
        chain: EffectChain,
        linear: Linear,
        target: Sequence[Tensor],
        prior: np.ndarray,
        moved: np.ndarray,
    ) -> np.ndarray:
        """One Gauss-Newton step of the chain towards the target, within its room."""
        normal, right = prior.copy(), -prior @ moved
        for (height, jacobian, basis), wanted in zip(linear, target, strict=True):
            stacked = np.column_stack([_flat(wanted - height), jacobian])
            # As in a fit of the loop: a little weight fixes what only the scans' own terms carry.
            products = gram(stacked, basis, TERM_WEIGHT)
            normal, right = normal + products[1:, 1:], right + products[1:, 0]
        return solve_damped(normal, right, _DAMPING, room(chain, get_vector(chain)))

    def _chain(self, rival: Rival, base: Simulator) -> EffectChain:
        chain = EffectChain(
            base,
            rival.effects,
            full_height_um=self.printing.highest * self.printing.level_height_um,
            pitch_um=self.printing.pitch_um,
            scan_frame=rival.scan_frame,
            print_frame=rival.print_frame,
        )
        return chain_at(chain, np.array(rival.vector))


def _inner(field: Tensor) -> Tensor:
    """Without the edge, where a model does not know what lies beyond."""
    border = min(_BORDER_PX, min(field.shape) // 8)
    return field[border:-border, border:-border]


def _flat(field: Tensor) -> np.ndarray:
    return _inner(field).reshape(-1).numpy().astype(np.float64)


def _free_basis(prediction_um: np.ndarray) -> np.ndarray:
    """Orthonormal basis (n, k) of what a scan may add by itself, on the inner pixels."""
    inner = _inner(torch.from_numpy(prediction_um)).numpy()
    return orthonormal(term_maps(TermPixels(inner), ALL_FREE).T)
