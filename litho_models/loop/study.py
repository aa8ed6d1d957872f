"""A study: the scans, who holds each out, and how predictions of them are judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from litho_data.foundation.units import NM_PER_UM
from litho_data.foundation.workers import HERE, Workers
from litho_models.effects.chain import EffectChain
from litho_models.fitting.least_squares import Loss
from litho_models.fitting.pixel_weights import Weights
from litho_models.loop.fold_fits import FoldFits, fit_folds, predict
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.selection.confirming import Confirmation, confirm
from litho_models.scan_terms import BackgroundUse, Blocks, Terms, cross_fit, terms_of_effect
from litho_models.scan_terms.background import learn_background
from litho_models.scoring.records import Prediction
from litho_models.scoring.statistics import bootstrap_interval
from litho_models.splits.folds import grouped_folds

DATUM_FREE: Terms = frozenset({"offset"})


@dataclass(frozen=True)
class Score:
    """Errors of one set of predictions, one entry per scan, nm, and the residual maps, µm."""

    mae_nm: np.ndarray
    mse_nm2: np.ndarray
    degrees_of_freedom: float
    residual_um: list[np.ndarray]

    @property
    def mean_mae_nm(self) -> float:
        return float(self.mae_nm.mean())

    @property
    def rmse_nm(self) -> float:
        return float(np.sqrt(self.mse_nm2.mean()))

    def interval_nm(self, seed: int = 0) -> tuple[float, float]:
        """Bootstrap interval over scans of the mean absolute error."""
        low, high = bootstrap_interval(self.mae_nm.tolist(), seed=seed)
        return low, high


def _silent(message: str) -> None:
    pass


@dataclass(frozen=True)
class Study:
    """What every step of the loop works on; a step returns what it found and changes nothing here.

    Attributes:
        scans: development scans.
        fold_of: (scans,) number of the fold that holds each out.
        seed: of blocks, bootstrap and permutations.
        loss: what fits minimise; ``weights``: what pixels count for there, and nowhere else.
        floor_nm2: squared noise floor or its lower bound, nm².
        background: ``training``: to each prediction is added what the training scans of its fold have in
            common beside their prints, as in a benchmark. The search goes without.
        workers: where steps with independent parts have them done.
        report: told in a sentence what happens.
    """

    scans: Sequence[PreparedScan]
    fold_of: np.ndarray
    seed: int = 0
    loss: Loss = "squares"
    weights: Weights = "uniform"
    floor_nm2: float = 0.0
    background: BackgroundUse = "none"
    workers: Workers = HERE
    report: Callable[[str], None] = _silent

    def __getstate__(self) -> dict[str, Any]:
        """In another process a study has no workers of its own, and nobody to tell."""
        return {**vars(self), "workers": HERE, "report": _silent}

    @property
    def folds(self) -> int:
        return int(self.fold_of.max()) + 1

    @property
    def windows(self) -> list[PreparedScan]:
        """What fits and screening see of the scans."""
        return [scan.window for scan in self.scans]

    @property
    def tip_radius_um(self) -> float | None:
        """Radius of the tip, or the most that it can be, if the store knows: that of the first scan."""
        known = (scan.stored.tip_radius_um for scan in self.scans)
        return next((radius for radius in known if radius is not None), None)

    @property
    def blocks(self) -> Blocks:
        """Pixels that terms are fitted on and pixels that are scored: those of the benchmark."""
        return Blocks(seed=self.seed)

    def score(self, predictions: Sequence[np.ndarray], terms: Terms) -> Score:
        """Held-out errors of predictions (y, x) µm, freed of terms that were fitted on other pixels."""
        return score(self.scans, predictions, terms, self.blocks)

    def confirm(
        self,
        before: Score,
        after: Score,
        amplitudes: Mapping[str, np.ndarray] | None = None,
        *,
        counted: bool = True,
    ) -> Confirmation:
        """Whether a change is confirmed on scans that it was not fitted on, see ``confirm``."""
        return confirm(
            before.mse_nm2,
            after.mse_nm2,
            before.mae_nm,
            after.mae_nm,
            floor_nm2=self.floor_nm2,
            amplitudes=amplitudes,
            counted=counted,
            seed=self.seed,
        )


# (fold, scan, prediction) to the prediction with a generic term, as estimated without that fold.
Correction = Callable[[int, PreparedScan, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class State:
    """A fitted model and its held-out predictions (y, x) µm, one per scan; generic terms that were added."""

    fits: FoldFits
    predictions: list[np.ndarray]
    corrections: tuple[Correction, ...] = ()
    # Scoring takes seconds, and every verdict asks for it.
    _scores: dict[tuple[str, Terms], Score] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _maps: list[np.ndarray] = field(default_factory=list, init=False, repr=False, compare=False)

    def of_fold(self, fold: int, scan: PreparedScan) -> np.ndarray:
        """What the fit without this fold predicts of any scan, (y, x) µm."""
        prediction = predict(self.fits.chain, self.fits.per_fold[fold], scan, fold)
        for correction in self.corrections:
            prediction = correction(fold, scan, prediction)
        return prediction

    def with_correction(self, correct: Correction, study: Study) -> State:
        """The state with one more correction, its held-out predictions corrected each by its own fold."""
        held_out = zip(study.fold_of, study.scans, self.predictions, strict=True)
        corrected = [correct(int(fold), scan, prediction) for fold, scan, prediction in held_out]
        return State(self.fits, corrected, (*self.corrections, correct))

    def score(self, study: Study, terms: Terms) -> Score:
        """Held-out errors over the scans of the study that the state belongs to."""
        key = study.background, terms
        if key not in self._scores:
            maps = self.predictions if study.background == "none" else self._with_background(study)
            self._scores[key] = study.score(maps, terms)
        return self._scores[key]

    def _with_background(self, study: Study) -> list[np.ndarray]:
        if self._maps:
            return self._maps
        maps = list(self.predictions)
        for fold in range(study.folds):
            training = [scan for scan, own in zip(study.scans, study.fold_of, strict=True) if own != fold]
            learned = learn_background(
                [scan.stored for scan in training], [self.of_fold(fold, scan) for scan in training]
            )
            for i in np.flatnonzero(study.fold_of == fold):
                maps[i] = Prediction.beside(learned, maps[i]).map_um
        self._maps.extend(maps)
        return maps


def fit_state(chain: EffectChain, study: Study) -> State:
    """Fit the chain per fold and predict every scan with the fit that has not seen it."""
    fits = fit_folds(chain, study.scans, study.fold_of, study.loss, study.weights)
    held_out = zip(study.scans, study.fold_of, strict=True)
    return State(fits, [predict(fits.chain, fits.per_fold[fold], scan) for scan, fold in held_out])


def held_out_residuals(state: State, study: Study) -> list[np.ndarray]:
    """Measured minus predicted (n,) µm at the sampled pixels, each scan by the fit that has not seen it."""
    fits = state.fits
    return [
        window.height - window.at_sample(predict(fits.chain, fits.per_fold[fold], window))
        for window, fold in zip(study.windows, study.fold_of, strict=True)
    ]


def score(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray], terms: Terms, blocks: Blocks
) -> Score:
    """Errors of predictions (y, x) µm of any prepared scans."""
    fits = [
        cross_fit(scan.stored.height_um, prediction, scan.usable, terms, blocks, scan_line=scan.line)
        for scan, prediction in zip(scans, predictions, strict=True)
    ]
    values = [fit.residual_um[np.isfinite(fit.residual_um)] * NM_PER_UM for fit in fits]
    return Score(
        mae_nm=np.array([np.abs(v).mean() for v in values]),
        mse_nm2=np.array([(v**2).mean() for v in values]),
        degrees_of_freedom=float(np.mean([fit.degrees_of_freedom for fit in fits])),
        residual_um=[fit.residual_um for fit in fits],
    )


def deal(scans: Sequence[PreparedScan], folds: int, seed: int) -> np.ndarray:
    """Number of the fold that holds out each scan, (scans,); at most one fold per scan."""
    ids = [scan.id for scan in scans]
    fold = {
        scan_id: number
        for number, members in enumerate(grouped_folds(ids, min(folds, len(ids)), seed))
        for scan_id in members
    }
    return np.array([fold[scan_id] for scan_id in ids])


def noise_lower_bound_nm(
    scans: Sequence[PreparedScan], predictions: Sequence[np.ndarray]
) -> tuple[float, float]:
    """Pixel noise from second differences along x, (rms, mean absolute) in nm: blind to correlated noise.

    For white noise of variance s², x[i-1] - 2 x[i] + x[i+1] has variance 6 s². The median over pixels
    keeps edges of the print out; a Gaussian shape is assumed for the conversion.
    """
    variances = []
    for scan, prediction in zip(scans, predictions, strict=True):
        residual = np.where(scan.usable, scan.stored.height_um - prediction, np.nan)
        second = residual[:, 2:] - 2 * residual[:, 1:-1] + residual[:, :-2]
        spread = float(np.nanmedian(np.abs(second))) / 0.6745
        variances.append(spread**2 / 6)
    rms = float(np.sqrt(np.mean(variances))) * NM_PER_UM
    return rms, rms * float(np.sqrt(2 / np.pi))


def names_to_terms(effects: Sequence[str]) -> Terms:
    """Terms of single scans that the accepted measurement effects stand for."""
    return frozenset().union(*(terms_of_effect(name) for name in effects))
