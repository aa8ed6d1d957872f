"""What each thing that was added gains: in the order added, and left out of the final set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from litho_models.loop.choice import Choice, passed
from litho_models.loop.probes.selection import with_generic_terms
from litho_models.loop.selection.search import EffectSets
from litho_models.loop.study import DATUM_FREE, State, names_to_terms
from litho_models.scan_terms import Terms


@dataclass(frozen=True)
class GainStep:
    """What one effect, generic term or term of single scans does to the held-out error, MAE in nm.

    Attributes:
        k: effective number of terms per scan once it is in.
        in_order_nm: fall when it is added, beside the terms of single scans accepted so far; they sum to the
            whole, from the base with one term per scan to the final model with all accepted terms.
        in_order_k1_nm: the same with the zero of each scan free throughout; they sum to the gain at k = 1.
        left_out_nm: rise when it is left out of the final set and the rest refitted, with the accepted terms.
        left_out_k1_nm: the same with the zero of each scan free.
    """

    name: str
    k: float
    in_order_nm: float
    in_order_k1_nm: float
    left_out_nm: float
    left_out_k1_nm: float


def split_gain(choice: Choice, fitted: EffectSets) -> list[GainStep]:
    """The steps from the base to the final model, and what the final model is without each.

    Effects that came first are fitted without those that came later, and the final set without each; generic
    terms are then estimated anew. A term of single scans is freed or not: fits go without it in any case.

    Args:
        choice: what was added; ``fitted``: the model with each set of its named effects.
    """
    study, search, final = choice.study, choice.search, choice.final
    early = [name for name in passed(choice.first_tests) if name in choice.accepted]
    late = [name for name in choice.accepted if name not in early]
    probes = [entry.probe.name for entry in choice.probed.added]
    # After each step the model and its terms; and the final set without it, model and terms.
    steps: list[tuple[str, State, Terms, State, Terms]] = []
    model, freed = choice.base, DATUM_FREE

    def free(names: Sequence[str]) -> None:
        nonlocal freed
        for name in names:
            if names_to_terms([name]) <= freed:
                continue
            freed |= names_to_terms([name])
            others = names_to_terms([other for other in choice.accepted if other != name])
            steps.append((name, model, freed, final, DATUM_FREE | others))

    free(early)
    for at, name in enumerate(search.names):
        study.report(f"what {name} gains")
        model = fitted.state(search.names[: at + 1])
        rest = fitted.without(name)
        steps.append((name, model, freed, with_generic_terms(rest, study, probes), choice.terms))
    corrected = search.state
    for name, correct in zip(probes, final.corrections, strict=True):
        study.report(f"what {name} gains")
        model = corrected = corrected.with_correction(correct, study)
        others = [other for other in probes if other != name]
        steps.append((name, model, freed, with_generic_terms(search.state, study, others), choice.terms))
    free(late)
    return _measured(choice, steps)


def _measured(choice: Choice, steps: Sequence[tuple[str, State, Terms, State, Terms]]) -> list[GainStep]:
    study = choice.study

    def mae_nm(state: State, terms: Terms) -> float:
        return state.score(study, terms).mean_mae_nm

    final, found = choice.final, []
    before = at_k1 = mae_nm(choice.base, DATUM_FREE)
    for name, model, terms, without, others in steps:
        after, after_k1 = mae_nm(model, terms), mae_nm(model, DATUM_FREE)
        found.append(
            GainStep(
                name=name,
                k=model.score(study, terms).degrees_of_freedom,
                in_order_nm=before - after,
                in_order_k1_nm=at_k1 - after_k1,
                left_out_nm=mae_nm(without, others) - mae_nm(final, choice.terms),
                left_out_k1_nm=mae_nm(without, DATUM_FREE) - mae_nm(final, DATUM_FREE),
            )
        )
        before, at_k1 = after, after_k1
    return found
