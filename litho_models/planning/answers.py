"""What the plan makes of every open question: difference, power, reason, and what each outcome means."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import f as f_distribution
from scipy.stats import norm

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.judging import CONFIRM_P
from litho_models.planning.questions import NoiseSpectrum, OpenQuestions, Question
from litho_models.planning.record import PlannedPair, PlannedQuestion, Status
from litho_models.planning.rivalry import Contrast, PlannedPrint, Rivalry

# A wrong name is given with this probability at most.
Z_DECIDED = float(norm.isf(CONFIRM_P))
# Of the variance of a term of single scans, that of the print if the printer is its cause.
PRINT_SHARE = 0.9
ENOUGH = 0.95
# Beside this power no allowed experiment separates the rivals.
HOPELESS = 0.2
MOST_PRINTS = 12


def of_contrast(contrast: Contrast, question: Question, prints: int) -> float:
    """Power with so many prints like those of the contrast.

    The difference of two squared errors has the mean of the squared distance; its variance is that of the
    noise along the distance, and that of the distance itself, which varies between prints by the question's
    ``spread``. What its ``form_nm`` may have made of it does not count, as in the decision.
    """
    squares = prints * float(contrast.squares_um2.mean())
    noise = prints * float((contrast.sd_um2**2).mean())
    form = prints * float(contrast.pixels.mean()) * ((question.form_nm or 0.0) / NM_PER_UM) ** 2
    sd = math.sqrt(noise + (question.spread * squares) ** 2 / prints)
    return float(norm.cdf(surely_better(squares, squares, sd, form) - Z_DECIDED))


def of_repeats(prints: int, scans: int) -> float:
    """Power of prints that are taken out and scanned again, to say whose a term of single scans is.

    With the F of an analysis of variance: the printer's if scans of one print agree as they never would by
    chance (p <= 0.005), the microscope's if they agree as little as they never would (p <= 0.005) were it the
    printer's. The power is the smaller one of both answers.
    """
    if prints < 2 or scans < 2:
        return 0.0
    between, within = prints - 1, prints * (scans - 1)
    ratio = 1 + scans * PRINT_SHARE / (1 - PRINT_SHARE)
    printer = f_distribution.sf(f_distribution.isf(CONFIRM_P, between, within) / ratio, between, within)
    scanned = f_distribution.cdf(ratio * f_distribution.ppf(CONFIRM_P, between, within), between, within)
    return float(min(printer, scanned))


def of_lines(sd_um: float, noise: NoiseSpectrum, size_px: int, prints: int) -> float:
    """Power to tell written from scanned lines where the scan is turned: one of the two axes has them."""
    grid = noise.on_grid((size_px, size_px))
    # The mean over a line has the power at frequency 0 along it.
    own_um2 = float(grid[1:, 0].mean()) / size_px * 1e-6
    variance = sd_um**2
    z = variance / ((variance + own_um2) * math.sqrt(2 / (size_px * prints)))
    return float(norm.cdf(z - Z_DECIDED))


def prints_needed(powers: Sequence[float]) -> int | None:
    """Fewest prints with enough power; None where none of the numbers looked at has it."""
    found = np.flatnonzero(np.array(powers) >= ENOUGH)
    return int(found[0]) + 1 if len(found) else None


def surely_better(gain: float, difference: float, sd: float, form: float) -> float:
    """Standard deviations of noise by which a gain exceeds what the form of the model may have made of it.

    With A and B the predictions of two refitted rivals, freed of per-scan terms, D = B - A, and A true but
    for the noise n and the error e of the form that both share, prints show y = A + e + n and the difference
    of the two squared errors is |y - B|² - |y - A|² = |D|² - 2<D, e> - 2<D, n>. The noise averages down with
    prints. The error of the form comes back with every print of a like texture and does not; how it lies to D
    is not known, and |<D, e>| <= |D| |e| (Cauchy and Schwarz), so that 2 |D| |e| of a difference decide
    nothing. Rivals with |D| below 2 |e| are told apart by no number of prints. How e really lies to D the new
    prints show themselves: with A true and no error the gain is |D|²; by what it differs from that, beyond
    noise, e has spoken. The larger one counts. All four are sums over the same pixels, in one unit.

    Args:
        gain: squared error of one rival less that of the other; a negative one counts for the other.
        difference: |D|², squared difference of their predictions.
        sd: standard deviation of the gain by noise.
        form: |e|², squared error of the form; 0: not known, or none.
    """
    if sd <= 0:
        return 0.0
    unknown = 2 * math.sqrt(difference * form)
    seen = abs(abs(gain) - difference) - Z_DECIDED * sd
    # More than expected is no doubt about which is nearer; less than half of it is.
    against = max(unknown, seen if abs(gain) < difference else 0.0)
    return float(np.copysign(max(abs(gain) - against, 0.0) / sd, gain))


_COUNTS = range(1, MOST_PRINTS + 1)
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
    powers = []
    for _ in range(DRAWS):
        drawn = rivalry.drawn(random)
        shown = drawn.contrasts(prints, drawn.refitted(prints, first=first))
        powers.append([[of_contrast(one, rivalry.question, n) for n in _COUNTS] for one in shown])
    fitted = rivalry.contrasts(prints, rivalry.refitted(prints, rounds=2))
    directed = dict(
        zip(rivalry.pairs, zip(np.mean(powers, axis=0).tolist(), fitted, strict=True), strict=True)
    )
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
            [of_lines(sd_um, open_.noise, size_px, n) for n in _COUNTS],
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
            [of_repeats(n, scans) for n in _COUNTS],
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
        prints_needed=prints_needed(powers),
        outcomes=outcomes,
        **{"random_power": powers, **known},
    )


def _status(powers: Sequence[float], prints: int) -> Status:
    reached = powers[prints - 1]
    if reached >= ENOUGH:
        return "decides"
    hopeful = reached > HOPELESS or prints_needed(powers) is not None
    return "may decide" if hopeful else _HOPELESS
