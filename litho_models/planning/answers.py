"""What the plan makes of every open question: difference, power, reason, and what each outcome means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from litho_models.planning import power
from litho_models.planning.questions import OpenQuestions, Question
from litho_models.planning.record import PlannedPair, PlannedQuestion, Status
from litho_models.planning.rivalry import PlannedPrint, Rivalry

_COUNTS = range(1, power.MOST_PRINTS + 1)
# What the rivals' numbers could be as well: a difference that rests on one of them may not be there.
DRAWS = 8
_HOPELESS: Status = "no experiment separates"


def of_rivals(
    rivalry: Rivalry,
    tried: Mapping[str, float],
    planned: Sequence[PlannedPrint],
    random: Sequence[PlannedPrint],
    prints: int,
) -> PlannedQuestion:
    """A question whose rivals are models: judged on the planned prints, and on as many random layouts."""
    question = rivalry.question
    pairs, control = _pairs(rivalry, planned), _pairs(rivalry, random)
    hardest = min(pairs, key=lambda pair: (pair.power[prints - 1], pair.difference_nm))
    names = [rival.name for rival in question.rivals]
    ways = "; ".join(f"{what}: {z:.1f}" for what, z in tried.items())
    why = [f"the nearest two rivals differ by so many standard deviations on one random print: {ways}"]
    if question.spread:
        why.append(f"what a print says varies by {100 * question.spread:.0f} %, beyond noise")
    if question.form_nm is not None:
        why.append(
            f"the model's own error is {question.form_nm:.1f} nm at most, the two differ by "
            f"{hardest.difference_nm:.1f} nm"
        )
    if _status(hardest.power, prints) == _HOPELESS:
        why.append(f"no experiment of this plan separates them; not in it: {question.experiment}")
    return _planned(
        question,
        hardest.power,
        prints,
        "; ".join(why),
        [
            *(f"the scans are nearer to {name} than to each other rival: it is {name}" for name in names),
            "two are as near: these two stay a set, the others are excluded",
            "all leave more than the noise: none of them is the cause",
        ],
        rivals=names,
        pairs=pairs,
        difference_nm=hardest.difference_nm,
        random_difference_nm=min(pair.difference_nm for pair in control),
        noise_nm=hardest.noise_nm,
        random_power=np.min([pair.power for pair in control], axis=0).tolist(),
    )


def _pairs(rivalry: Rivalry, prints: Sequence[PlannedPrint]) -> list[PlannedPair]:
    """Unordered pairs, each in the direction with less power; a power is the mean over the draws."""
    random, first = np.random.default_rng(0), rivalry.linearised(prints)
    drawn = [rivalry.drawn(random) for _ in range(DRAWS)]
    contrasts = [one.contrasts(prints, one.refitted(prints, first=first)) for one in drawn]
    fitted = rivalry.contrasts(prints, rivalry.refitted(prints, rounds=2))
    directed = {}
    for pair, contrast, *others in zip(rivalry.pairs, fitted, *contrasts, strict=True):
        powers = [[power.of_contrast(one, rivalry.question, n) for n in _COUNTS] for one in others]
        directed[pair] = np.mean(powers, axis=0).tolist(), contrast
    found = []
    for pair in combinations(range(len(rivalry.twins)), 2):
        mean, contrast = min((directed[pair], directed[pair[::-1]]), key=lambda one: one[0])
        one, other = (rivalry.question.rivals[at].name for at in pair)
        found.append(
            PlannedPair(
                rivals=(one, other), difference_nm=contrast.rms_nm, noise_nm=contrast.noise_nm, power=mean
            )
        )
    return found


def of_others(
    question: Question, open_: OpenQuestions, prints: int, scans: int, size_px: int
) -> PlannedQuestion:
    """A question whose answer lies in how prints are scanned, not in what is printed."""
    if question.kind == "lines":
        sd_um = next(iter(question.sizes.values()), 0.0)
        return _planned(
            question,
            [power.of_lines(sd_um, open_.noise, size_px, n) for n in _COUNTS],
            prints,
            "lines of a turned scan run along the other axis of the layout than written ones",
            [
                "offsets follow the layout's rows in turned scans, too: written",
                "they follow the scan lines: scanned",
            ],
        )
    if question.kind == "per-scan":
        return _planned(
            question,
            [power.of_repeats(n, scans) for n in _COUNTS],
            prints,
            "every print is taken out and scanned again: what belongs to it comes back",
            [
                "scans of one print agree: the printer's, different in every print",
                "they agree no better than scans of different prints: the microscope's",
            ],
        )
    told = [f"once the fact is in the card, {question.name} is tested"]
    return _planned(question, [0.0 for _ in _COUNTS], prints, question.experiment, told)


def _planned(
    question: Question, powers: list[float], prints: int, why: str, outcomes: list[str], **known: Any
) -> PlannedQuestion:
    return PlannedQuestion(
        **question.model_dump(include={"name", "kind", "text", "form_nm"}),
        status="needs a fact" if question.kind == "fact" else _status(powers, prints),
        why=why,
        power=powers,
        prints_needed=power.prints_needed(powers),
        outcomes=outcomes,
        **{"random_power": powers, **known},
    )


def _status(powers: Sequence[float], prints: int) -> Status:
    reached = powers[prints - 1]
    if reached >= power.ENOUGH:
        return "decides"
    hopeful = reached > power.HOPELESS or power.prints_needed(powers) is not None
    return "may decide" if hopeful else _HOPELESS
