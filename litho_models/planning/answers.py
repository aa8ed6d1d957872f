"""What the plan makes of every open question: difference, power, reason, and what each outcome means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
    planned: Sequence[PlannedPrint],
    random: Sequence[PlannedPrint],
    tried: Mapping[str, float],
    prints: int,
) -> PlannedQuestion:
    """A question whose rivals are models: judged on the planned prints, and on as many random layouts."""
    question, spread = rivalry.question, rivalry.question.spread
    pairs, control = _pairs(rivalry, planned), _pairs(rivalry, random)
    hardest = min(pairs, key=lambda pair: (pair.power[prints - 1], pair.difference_nm))
    names = [rival.name for rival in question.rivals]
    status = _status(hardest.power, prints)
    ways = "; ".join(f"{what}: {z:.1f}" for what, z in tried.items())
    return PlannedQuestion(
        name=question.name,
        kind=question.kind,
        text=question.text,
        status=status,
        why=f"the nearest two rivals differ by so many standard deviations on one random print: {ways}"
        + (f"; what a print says varies by {100 * spread:.0f} %, beyond noise" if spread else "")
        + _of_form(hardest.difference_nm, question.form_nm, status)
        + (f". Not in this plan: {question.experiment}" if status == _HOPELESS else ""),
        rivals=names,
        pairs=pairs,
        difference_nm=hardest.difference_nm,
        random_difference_nm=min(pair.difference_nm for pair in control),
        noise_nm=hardest.noise_nm,
        form_nm=question.form_nm,
        power=hardest.power,
        random_power=np.min([pair.power for pair in control], axis=0).tolist(),
        prints_needed=power.prints_needed(hardest.power),
        outcomes=[
            *(f"the scans are nearer to {name} than to each other rival: it is {name}" for name in names),
            "two are as near: these two stay a set, the others are excluded",
            "all leave more than the noise: none of them is the cause",
        ],
    )


def _of_form(difference_nm: float, form_nm: float | None, status: Status) -> str:
    """The difference beside the error of the model's own form."""
    if form_nm is None:
        return ""
    told = f"the model's own error is {form_nm:.1f} nm at most, the two differ by {difference_nm:.1f} nm"
    return f"; {'no experiment of this plan separates them: ' if status == _HOPELESS else ''}{told}"


def _pairs(rivalry: Rivalry, prints: Sequence[PlannedPrint]) -> list[PlannedPair]:
    """Unordered pairs, each in the direction with less power; a power is the mean over the draws."""
    names = [rival.name for rival in rivalry.question.rivals]
    random, first = np.random.default_rng(0), rivalry.linearised(prints)
    drawn = [rivalry.drawn(random) for _ in range(DRAWS)]
    contrasts = [one.contrasts(prints, one.refitted(prints, first=first)) for one in drawn]
    directed = {}
    for pair, fitted, *others in zip(
        rivalry.pairs, rivalry.contrasts(prints, rivalry.refitted(prints, rounds=2)), *contrasts, strict=True
    ):
        powers = [[power.of_contrast(one, rivalry.question, n) for n in _COUNTS] for one in others]
        directed[pair] = fitted, np.mean(powers, axis=0).tolist()
    found = []
    for first, second in (pair for pair in directed if pair[0] < pair[1]):
        contrast, mean = min(
            (directed[first, second], directed[second, first]), key=lambda one: tuple(one[1])
        )
        found.append(
            PlannedPair(
                rivals=(names[first], names[second]),
                difference_nm=contrast.rms_nm,
                noise_nm=contrast.noise_nm,
                power=mean,
            )
        )
    return found


def of_others(
    question: Question, open_: OpenQuestions, prints: int, scans: int, size_px: int
) -> PlannedQuestion:
    """A question whose answer lies in how prints are scanned, not in what is printed."""
    difference = None
    if question.kind == "lines":
        sd_um = next(iter(question.sizes.values()), 0.0)
        difference = 1e3 * sd_um
        powers = [power.of_lines(sd_um, open_.noise, size_px, n) for n in _COUNTS]
        why = "lines of a turned scan run along the other axis of the layout than written ones"
        outcomes = [
            "offsets follow the layout's rows in turned scans, too: written",
            "they follow the scan lines: scanned",
        ]
    elif question.kind == "per-scan":
        powers = [power.of_repeats(n, scans) for n in _COUNTS]
        why = "every print is taken out and scanned again: what belongs to it comes back"
        outcomes = [
            "scans of one print agree: the printer's, different in every print",
            "they agree no better than scans of different prints: the microscope's",
        ]
    else:
        powers, outcomes = (
            [0.0 for _ in _COUNTS],
            [f"once the fact is in the card, {question.name} is tested"],
        )
        why = question.experiment
    status: Status = "needs a fact" if question.kind == "fact" else _status(powers, prints)
    return PlannedQuestion(
        name=question.name,
        kind=question.kind,
        text=question.text,
        status=status,
        why=why,
        rivals=[],
        pairs=[],
        difference_nm=difference,
        random_difference_nm=difference,
        noise_nm=None,
        form_nm=question.form_nm,
        power=powers,
        random_power=powers,
        prints_needed=power.prints_needed(powers),
        outcomes=outcomes,
    )


def _status(powers: Sequence[float], prints: int) -> Status:
    reached = powers[prints - 1]
    if reached >= power.ENOUGH:
        return "decides"
    hopeful = reached > power.HOPELESS or power.prints_needed(powers) is not None
    return "may decide" if hopeful else _HOPELESS
