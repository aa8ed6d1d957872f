"""A network as base model: one per fold, taken as trained, corrected by what a small model found.

A network absorbs effects into its weights, so candidates are screened on a small one; here each
effect found there must also lower the network's held-out error, otherwise the network carries it.
"""

from __future__ import annotations

from dataclasses import replace

from litho_models.effects.chain import EffectChain
from litho_models.loop.folded_base import FoldedBase
from litho_models.loop.parameters import effect_slots
from litho_models.loop.selection.contest import Entrant, judged
from litho_models.loop.selection.search import Search
from litho_models.loop.study import State, Study, fit_state
from litho_models.scan_terms import Terms


def carry_over(
    found: Search,
    base: FoldedBase,
    study: Study,
    terms: Terms,
) -> tuple[State, Search]:
    """Try the effects found on the small model on the network; returns its bare state and the search."""
    guide = found.state.fits.chain
    bare = fit_state(
        EffectChain(base, {}, full_height_um=guide.full_height_um, pitch_um=guide.pitch_um), study
    )
    carried = Search(
        bare, first=found.first, last=found.last, failures=dict(found.failures), dropped=dict(found.dropped)
    )
    for entry in found.added:
        name = entry.effect.name
        study.report(f"trying {name} on the network")
        slots, common = effect_slots(guide), found.state.fits.common
        values = guide.values()[name] | {
            parameter: float(common[slot]) for (owner, parameter), slot in slots.items() if owner == name
        }
        chain = carried.state.fits.chain
        extended = fit_state(chain.with_effects({**chain.values(), name: values}), study)
        entrant = Entrant(found.first[name], extended)
        added = judged(carried.state, entrant, entry.confusable_with, study, terms)
        if added.confirmation.passed:
            carried.state = extended
            # It was screened where the small model chose it, after the effects added before it.
            carried.added.append(replace(added, p_screen=entry.p_screen))
        else:
            reason = added.confirmation.reason
            carried.absorbed[name] = f"confirmed on the small model, not on this one: {reason}"
    return bare, carried
