"""Does the name of a cause stand, with everything else in place?

A cause that is missing beside a named one leaves a residual that has nothing to do with the named change. A
name that only resembles the cause leaves one that is the named change in another shape: scaled with the
height or the place, blurred, displaced, squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect, get_effect
from litho_models.loop.fits import State, Study, fit_state, without_terms
from litho_models.loop.judging import judge
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.screening import WORTH_FITTING, Screened, Screening
from litho_models.loop.search import Cause, describe, with_table
from litho_models.loop.trials import Secants
from litho_models.scan_terms.grouped import ALL, Block, Products

# Of a cause's gain: what its change in other shapes may take beside it. On trials of the virtual fab the
# formulas of true causes leave less than 1 % (layer-stacking 10 %), of causes that only resemble one 20 % and
# more.
FORM_SHARE = 0.15


@dataclass(frozen=True)
class Check:
    """What the causes of a model are checked against.

    Attributes:
        state: the model; ``others``: its causes and laws; ``laws``, ``tables``: all that might stand in a
            cause's place.
        left_nm2: what all features of layout and place still explain beside it.
        secants: of the laws.
    """

    state: State
    others: Sequence[Cause]
    laws: Sequence[Effect]
    tables: Sequence[Effect]
    left_nm2: float
    secants: Secants

    @property
    def laws_in(self) -> list[str]:
        """The laws of the model."""
        return [one.name for one in self.others if get_effect(one.name).knowledge == "law"]

    @property
    def study(self) -> Study:
        """What the model is fitted to."""
        return self.state.study

    def of(self, cause: Cause) -> Cause:
        """One of the causes, judged with everything else in the model."""
        without, alone_nm2 = self.state.without(cause.name), cause.judgement.gain_nm2
        cause = replace(cause, judgement=judge(without.freed_nm2, self.state.freed_nm2, self.study))
        reshaped_nm2 = reshaped_gain(without, self.state)
        share = reshaped_nm2 / max(cause.judgement.gain_nm2, 1e-9)
        unneeded, reason = cause.judgement.reason(grouped=cause.by != ALL), ""
        larger = "" if unneeded else self._larger(cause, without)
        if unneeded:
            reason = f"not needed beside the others: {unneeded}"
        elif larger:
            reason = f"may only correct the formula of {larger}"
        elif self.laws_in and cause.judgement.gain_nm2 < 0.5 * alone_nm2:
            reason = f"beside {', '.join(self.laws_in)} it takes less than half of what it took without"
        elif share > FORM_SHARE and (exhausted := self.state.twin.exhausts(cause.name)):
            reason = f"the scans ask for more of it than there can be: {', '.join(exhausted)}"
        # A small part of what is left is the little that any columns take of causes that are still missing.
        elif share > FORM_SHARE and reshaped_nm2 > 0.3 * self.left_nm2:
            taken = f"its change in another shape takes {100 * share:.0f} % of its gain more"
            reason = f"only resembles the cause: {taken}"
        return replace(cause, reshaped_share=share, reason=reason, corrects=bool(larger))

    def _larger(self, cause: Cause, without: State) -> str:
        """A much larger law, or cause whose change in another shape takes half of what this one does.

        A cause that gains a tenth of another or less may be an error of the other's formula, and a law only
        comes close. Empty if there is none.
        """
        gain_nm2 = cause.judgement.gain_nm2
        for other in self.others:
            if gain_nm2 < 0.1 * other.judgement.gain_nm2:
                if get_effect(other.name).knowledge == "law":
                    return other.name
                neither = without.without(other.name)
                if reshaped_gain(neither, without) >= 0.5 * gain_nm2:
                    return other.name
        return ""

    def beside_laws(self, cause: Cause) -> Cause:
        """Compare a cause that passed all other checks with laws: it loses its name if short laws fit better.

        Two laws at most, with no more numbers than the cause has.
        """
        numbers = sum(slot.effect == cause.name for slot in self.state.twin.slots)
        state = self.state.without(cause.name)
        laws: list[str] = []
        while len(laws) < 2 and (law := self._best_law(state, numbers)):
            state = fit_state(state.twin.with_effect(law.name, law.by, law.start()), self.study)
            numbers -= law.numbers
            laws.append(law.name)
            if judge(self.state.freed_nm2, state.freed_nm2, self.study).passed():
                return replace(cause, reason=f"short laws do better in its place: {', '.join(laws)}")
        return cause

    def beside_table(self, cause: Cause) -> Cause:
        """Compare a cause that passed all other checks with the best table in its place.

        If the table gains over twice as much, and the cause gains nothing beside it, the cause is only a part
        of something larger that has no name.
        """
        least_nm2 = 2 * cause.judgement.gain_nm2
        for table in describe(self.state.without(cause.name), self.tables, 1, self.secants):
            if table.judgement.gain_nm2 > least_nm2:
                both = with_table(self.state, table)
                judged = judge(both.without(cause.name).freed_nm2, both.freed_nm2, self.study)
                if reason := judged.reason(grouped=cause.by != ALL):
                    return replace(cause, reason=f"{table.name} takes its place, and more: {reason}")
        return cause

    def _best_law(self, state: State, numbers: int) -> Screened | None:
        """The law that promises the largest gain, if it is a fair part of what the cause gains."""
        laws = [law for law in self.laws if law.name not in state.twin.names]
        least = WORTH_FITTING * (state.mse_nm2 - self.state.mse_nm2)
        promising = (
            one
            for own in Screening(state, laws, self.secants).candidates.values()
            for one in own.values()
            if one.allowed and one.numbers <= numbers and one.gain_nm2 > least
        )
        return max(promising, key=lambda one: one.gain_nm2, default=None)


def reshaped_gain(without: State, state: State) -> float:
    """Gain (nm²) on held-out scans of a cause's change in other shapes, beside the change itself.

    Args:
        without, state: the model without and with the cause.
    """
    grams, study = [], state.study
    before, after = (one.maps_um(study.windows) for one in (without, state))
    for window, left, own, other in zip(study.windows, state.held_out_um, after, before, strict=True):
        maps = _shapes(own - other, own, window)
        freed = without_terms(np.column_stack([left, *map(window.at_sample, maps)]), window, own)
        grams.append(freed.T @ freed / len(freed))
    # Evidence for no reshaping, in scans: as many numbers would else fit the noise of a few scans.
    products = Products.ungrouped(np.stack(grams))
    count = products.grams.shape[1]
    left = products.held_out([], study.fold_of)
    taken = left - products.held_out([Block(tuple(range(1, count)), ALL, 0.02)], study.fold_of)
    return float(taken.mean()) * NM_PER_UM**2


def _shapes(change: np.ndarray, prediction: np.ndarray, window: PreparedScan) -> list[np.ndarray]:
    """A change of the prediction (y, x), µm, and the same in other shapes."""
    pitch = window.context.pitch_um
    layout = np.asarray(window.stored.layout_um, np.float64)
    # Widths in pixels: small beside what the process resolves, on films of nanometres too.
    near, far = gaussian_filter(layout, 6), gaussian_filter(layout, 20)
    relative, slopes = prediction - prediction.mean(), np.gradient(change, pitch)
    soft = [gaussian_filter(change, sigma_px) for sigma_px in (2, 6, 16)]
    y, x = (np.linspace(-1, 1, size) for size in change.shape)
    place = y[:, None], x, y[:, None] ** 2 + x**2
    factors = (1.0, relative, relative**2, np.abs(change), near, far, near - layout, *place)
    return [
        *(change * one for one in factors),
        *soft,
        *(one * relative for one in soft),
        *slopes,
        *map(np.abs, slopes),
    ]
