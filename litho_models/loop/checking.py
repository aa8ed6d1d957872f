"""Check whether an effect that was found is the true cause of a part of the residual. The check uses a model
that also contains all other effects that were found.

If the effect is the true cause, the residual of this model no longer depends on the change that the effect
makes to the prediction. If the effect only resembles the true cause, the residual still contains variants of
this change: the change multiplied by functions of height or position, or the change blurred, displaced or
squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from litho_data.foundation.units import NM_PER_UM
from litho_models.effects import Effect, get_effect
from litho_models.loop.fits import State
from litho_models.loop.judging import judge_states
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.screening import WORTH_FITTING, Screening, Secants
from litho_models.loop.search import Cause, describe, with_effect
from litho_models.scan_terms.grouped import ALL, Block, Products

# An effect is rejected as the cause if variants of the change that it makes would add more than this fraction
# to its gain (its reduction of the squared error on held-out scans). In trials on the virtual fab, variants
# of true causes add less than 1 % (layer-stacking: 10 %). Variants of effects that only resemble the true
# cause add 20 % or more.
FORM_SHARE = 0.15


@dataclass(frozen=True)
class Check:
    """Check the causes in a model against all laws and tables that could replace them.

    Attributes:
        state: the model, with all its effects.
        others: the causes and laws in the model; the laws among them are compared with the cause that is
            checked.
        laws, tables: all laws and tables that could replace a cause.
        left_nm2: the part of the model's mean squared residual that features of layout and position can
            still explain, nm².
        secants: for each window, the changes that the laws and tables would make to the prediction.
    """

    state: State
    others: Sequence[Cause]
    laws: Sequence[Effect]
    tables: Sequence[Effect]
    left_nm2: float
    secants: Sequence[Secants]

    def of(self, cause: Cause) -> Cause:
        """Check one cause in the model that contains all other effects. Return the cause with its new
        judgement and, if it is rejected, the reason.
        """
        without = self.state.without(cause.name)
        cause = replace(cause, judgement=judge_states(without, self.state))
        reshaped_nm2 = reshaped_gain(without, self.state)
        share = reshaped_nm2 / max(cause.judgement.gain_nm2, 1e-9)
        unneeded, reason = cause.judgement.reason(cause.by), ""
        larger = "" if unneeded else self._larger(cause)
        if unneeded:
            reason = f"it is not needed when the other effects are in the model: {unneeded}"
        elif larger:
            reason = f"it may merely correct an error in the formula of {larger}"
        elif outgrown := self.state.twin.lengths_at_limits(cause.name):
            reason = f"its best-fitting length is outside the range of this effect: {outgrown}"
        # If the model still lacks a cause, variants of the change that any effect makes can explain part of
        # the missing cause. A gain of the variants that is small relative to the unexplained error is
        # therefore no evidence against the effect.
        elif share > FORM_SHARE and reshaped_nm2 > 0.3 * self.left_nm2:
            reason = (
                "it only resembles the true cause: variants of its change (scaled, blurred or displaced) "
                f"would add {100 * share:.0f} % to its gain"
            )
        return replace(cause, reason=reason, corrects=bool(larger))

    def _larger(self, cause: Cause) -> str:
        """Return the name of a law whose gain is more than ten times the gain of this cause, or an empty
        text. Every law is approximate, so the cause may merely correct an error in the formula of such a law.
        """
        for one in self.others:
            is_law = get_effect(one.name).knowledge == "law"
            if is_law and cause.judgement.gain_nm2 < 0.1 * one.judgement.gain_nm2:
                return one.name
        return ""

    def beside_laws(self, cause: Cause) -> Cause:
        """Test whether short laws could replace a cause that has passed the checks of ``of``. Reject the
        cause if the model with the laws instead of the cause fits better.

        At most two laws are used. Together, they have no more parameters than the cause. The law with the
        largest predicted gain is added first.
        """
        numbers = sum(slot.effect == cause.name for slot in self.state.twin.slots)
        state = self.state.without(cause.name)
        names: list[str] = []
        for _ in range(2):
            laws = [law for law in self.laws if law.name not in state.twin.names]
            # The gain that the model with the cause still has over the model without it.
            lost_nm2 = state.mse_nm2 - self.state.mse_nm2
            promising = [
                one
                for one in Screening(state, laws, self.secants).candidates
                if one.allowed and one.numbers <= numbers and one.gain_nm2 > WORTH_FITTING * lost_nm2
            ]
            if not promising:
                break
            law = max(promising, key=lambda one: one.gain_nm2)
            state = with_effect(state, law)
            numbers -= law.numbers
            names.append(law.name)
            if not judge_states(self.state, state).reason():
                return replace(cause, reason=f"short laws fit better than this cause: {', '.join(names)}")
        return cause

    def beside_table(self, cause: Cause) -> Cause:
        """Test whether a table could replace a cause that has passed the checks of ``of``. If it could,
        reject the cause.

        The cause is rejected if two conditions hold: in the model without the cause, the gain of the table is
        more than twice the gain of the cause, and held-out scans do not confirm the cause when it is added to
        the model with this table.
        """
        for table in describe(self.state.without(cause.name), self.tables, 1, self.secants):
            if table.gain_nm2 > 2 * cause.judgement.gain_nm2:
                both = with_effect(self.state, table, from_here=True)
                if unneeded := judge_states(both.without(cause.name), both).reason(cause.by):
                    reason = f"it is not needed when {table.name} is in the model: {unneeded}"
                    return replace(cause, reason=reason)
        return cause


def reshaped_gain(without: State, state: State) -> float:
    """Return by how much the squared error on held-out scans decreases, nm², if variants of the change that a
    cause makes to the prediction are added to the model.

    Args:
        without: model without the cause.
        state: model with the cause.
    """
    grams, study = [], state.study
    maps_um = (one.maps_um(study.windows) for one in (state, without))
    for window, left, own, other in zip(study.windows, state.held_out_um, *maps_um, strict=True):
        maps = _shapes(own - other, own, window)
        freed = window.freed(np.column_stack([left, *map(window.at_sample, maps)]), own)
        grams.append(freed.T @ freed / len(freed))
    products = Products.ungrouped(np.stack(grams))
    # The last argument of ``Block`` is the weight of the prior that no variant is present, stated as a number
    # of scans. Without this prior, the many parameters would fit the noise of the few scans.
    block = Block(tuple(range(1, products.grams.shape[1])), ALL, 0.02)
    taken = products.grams[:, 0, 0] - products.held_out([block], study.fold_of)
    return float(taken.mean()) * NM_PER_UM**2


def _shapes(change: np.ndarray, prediction: np.ndarray, window: PreparedScan) -> list[np.ndarray]:
    """Return a change of the prediction and its variants, as maps of shape (ny, nx), µm.

    Args:
        change: the change that a cause makes to the prediction, µm, of shape (ny, nx).
        prediction: the prediction of the model with this cause, µm, of shape (ny, nx).
        window: the scan.
    """
    layout = np.asarray(window.layout_um, np.float64)
    # The widths of these blurs are in pixels, so that they suit the resolution of any process, including
    # films.
    near, far = gaussian_filter(layout, 6), gaussian_filter(layout, 20)
    relative, slopes = prediction - prediction.mean(), np.gradient(change, window.context.pitch_um)
    soft = [gaussian_filter(change, sigma_px) for sigma_px in (2, 6, 16)]
    y, x = (np.linspace(-1, 1, size) for size in change.shape)
    y = y[:, None]
    factors = (1.0, relative, relative**2, np.abs(change), near, far, near - layout, y, x, y**2 + x**2)
    return [
        *(change * one for one in factors),
        *soft,
        *(one * relative for one in soft),
        *slopes,
        *map(np.abs, slopes),
    ]
