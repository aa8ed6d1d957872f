"""Whether a named effect carries its weight: against generic terms, and against all that could be learned.

Judged on the final set: the effect is taken out, the rest fitted again, and what it gains is compared with
what others would gain in its place. So a cause is not blamed for what another named one does, and a small one
is not called the explanation of a large remainder. Nor does a name hold whose effect leaves more to be
learned than an error of its formula would: the law is another, or more than one cause is at work.
"""

from __future__ import annotations

from dataclasses import dataclass

from litho_models.loop.explainable import Learner
from litho_models.loop.probes.defects import find_defects
from litho_models.loop.probes.selection import generic_terms
from litho_models.loop.screening.directions import PROJECTIONS
from litho_models.loop.selection.rivals import freed_changes, freed_corrections, gains_nm2
from litho_models.loop.selection.search import FORM_ERROR, EffectSets, Search
from litho_models.loop.study import State, Study
from litho_models.scan_terms import Terms
from litho_models.scoring.statistics import bootstrap_interval

# Of the best generic term's gain, where that is ahead by more than chance.
RECOVERED_SHARE = 0.8
# Of what the learner regains once the effect is taken out.
ACCOUNTED_SHARE = 0.5
# Of its own gain: what a formula that is off by FORM_ERROR of its amplitude leaves.
LEFT_SHARE = FORM_ERROR**2


@dataclass(frozen=True)
class Weight:
    """What an effect of the final set gains, and what else would, nm² on scans left out.

    Attributes:
        gain_nm2: squared error without it minus with it.
        probe, probe_gain_nm2: the best generic term in its place; ``probe_ahead``: the interval over scans of
            the difference to it lies above zero.
        learner_gain_nm2: what all features of layout and place explain in its place; 0 where this is chance.
        left_nm2: what they explain, or accepted generic terms take, beside all named effects.
    """

    gain_nm2: float
    probe: str
    probe_gain_nm2: float
    probe_ahead: bool
    learner_gain_nm2: float
    left_nm2: float

    @property
    def share(self) -> float:
        """Of what the better of its rivals explains, at most 1."""
        rivals = [self.learner_gain_nm2, self.probe_gain_nm2 if self.probe_ahead else 0.0]
        return min(1.0, max(0.0, self.gain_nm2) / max(*rivals, 1e-9))

    @property
    def lacking(self) -> str:
        """Why the effect is only a part of what is missing; empty where it carries its weight."""
        reasons = []
        if self.probe_ahead and self.gain_nm2 < RECOVERED_SHARE * self.probe_gain_nm2:
            reasons.append(f"{self.probe} gains {self.probe_gain_nm2:.1f} nm² in its place")
        if self.gain_nm2 < ACCOUNTED_SHARE * self.learner_gain_nm2:
            reasons.append(
                f"without it layout and place explain {self.learner_gain_nm2:.1f} nm² of what is left"
            )
        if self.left_nm2 > LEFT_SHARE * self.gain_nm2:
            reasons.append(f"beside it layout, place or generic terms still explain {self.left_nm2:.1f} nm²")
        return f"it gains {self.gain_nm2:.1f} nm², {', '.join(reasons)}" if reasons else ""


def weigh_effects(
    found: Search, traced: State, study: Study, learner: Learner, fitted: EffectSets
) -> dict[str, Weight]:
    """The weight of every effect of a search, by name.

    Args:
        traced: the model with generic terms added to the named effects.
        fitted: the model with each set of the named effects.
    """
    weights: dict[str, Weight] = {}
    if not found.added:
        return weights
    left_nm2 = left_beside_names_nm2(found.state, traced, learner)
    for entry in found.added:
        name = entry.effect.name
        study.report(f"weighing {name}")
        terms = PROJECTIONS[found.first[name].projection]
        weights[name] = weigh(fitted.without(name), found.state, study, learner, terms, left_nm2)
    return weights


def left_beside_names_nm2(named: State, traced: State, learner: Learner) -> float:
    """What the learner explains beside the named effects, or generic terms take if that is more."""
    rest, after = learner.rest(named.predictions), learner.rest(traced.predictions)
    taken_nm2 = float((rest.squares_nm2 - after.squares_nm2).mean())
    return max(taken_nm2, rest.mean_nm2 if rest.matters else 0.0)


def weigh(
    without: State, final: State, study: Study, learner: Learner, terms: Terms, left_nm2: float = 0.0
) -> Weight:
    """The weight of what makes the difference between two states; ``terms``: what single scans may add."""
    rest = learner.rest(without.predictions, terms)
    defects = find_defects(study.scans, without.predictions)
    estimates = [
        (probe, probe.held_out(study.fold_of))
        for probe in generic_terms(study.scans, without.predictions, defects)
    ]
    probe, estimate = max(estimates, key=lambda one: one[1].mean_gain_nm2)
    added = [new - old for old, new in zip(without.predictions, final.predictions, strict=True)]
    own = gains_nm2(freed_changes(without, added, study, terms))
    # Probes are estimated free of every scan's gain and bow: what they carry of these means nothing.
    other = gains_nm2(freed_corrections(probe, estimate, without, study))
    return Weight(
        gain_nm2=float(own.mean()),
        probe=probe.name,
        probe_gain_nm2=float(other.mean()),
        probe_ahead=bool(bootstrap_interval((other - own).tolist(), seed=study.seed)[0] > 0),
        learner_gain_nm2=rest.mean_nm2 if rest.matters else 0.0,
        left_nm2=left_nm2,
    )
