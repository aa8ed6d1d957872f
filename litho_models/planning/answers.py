"""For each open question of a plan, compute how much the predictions of the rivals (competing explanations)
differ. Also compute the power, i.e. the probability that the planned prints decide the question correctly,
and list all possible outcomes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import f, norm

from litho_data.reports.page import filled
from litho_models.loop.judging import CONFIRM_P
from litho_models.planning.questions import NoiseSpectrum, OpenQuestions, Question
from litho_models.planning.record import PlannedPair, PlannedQuestion, Status
from litho_models.planning.rivalry import Contrast, Print, Rivalry, linearised

# A difference of this many standard deviations decides between two rivals. It corresponds to ``CONFIRM_P``,
# the largest allowed probability of naming a wrong cause.
Z_DECIDED = float(norm.isf(CONFIRM_P))
# If the printer causes a per-scan term, this fraction of the variance of the term is assumed to be variance
# between prints. The rest is variance between scans of one print.
PRINT_SHARE = 0.9
# Power at which the prints count as enough to decide a question.
ENOUGH = 0.95
# If the power does not exceed this value, the planned prints count as unable to separate the rivals, unless a
# larger number of prints is enough.
HOPELESS = 0.2
# Templates of the reasons for a status and of the possible outcomes, one per line.
_WHY, _OUTCOMES = (Path(__file__).with_name(f"{name}.jinja") for name in ("why", "outcomes"))


def of_contrast(contrast: Contrast, question: Question, prints: int) -> float:
    """Return the power of an experiment with the given number of prints to decide between two rivals. These
    prints are assumed to be like the prints for which the contrast was computed.

    The decision compares the squared errors of the two rivals (see ``surely_better``). If one rival is true,
    the expected difference of the squared errors is the squared distance between the two predictions. The
    noise in this difference is the noise of the scans, projected onto the difference of the predictions.
    """
    squares = prints * float(contrast.squares_nm2.mean())
    noise = prints * float((contrast.sd_nm2**2).mean())
    z = surely_better(question, squares, squares, noise, prints, prints * contrast.pixels)
    return float(norm.cdf(z - Z_DECIDED))


def of_repeats(prints: int, scans: int) -> float:
    """Return the power of an experiment that attributes a per-scan term to the printer or to the microscope.
    In this experiment, every print is remounted and scanned several times.

    The test is the F test of an analysis of variance. The term is attributed to the printer if the scans of
    one print agree better than expected by chance (p <= 0.005). It is attributed to the microscope if these
    scans agree less well than they would for a term that the printer causes (p <= 0.005). The two
    attributions have different powers, and the smaller power is returned.
    """
    if prints < 2 or scans < 2:
        return 0.0
    law, factor = variance_ratio(prints, prints * scans)
    return float(min(law.sf(law.isf(CONFIRM_P) / factor), law.cdf(factor * law.ppf(CONFIRM_P))))


def variance_ratio(prints: int, scans: int) -> tuple[Any, float]:
    """Return the law of the ratio F of two variances of a per-scan term: that between prints, and that
    between the scans of one print. ``scans`` is the number of scans of all prints together. The result has
    two items: the distribution of F if the microscope causes the term, and the factor by which F is larger if
    the printer causes it.
    """
    return f(prints - 1, scans - prints), 1 + scans / prints * PRINT_SHARE / (1 - PRINT_SHARE)


def of_lines(sd_um: float, noise: NoiseSpectrum, size_px: int, prints: int) -> float:
    """Return the power to decide whether line offsets with standard deviation ``sd_um`` come from the printer
    or from the microscope.

    The experiment uses rotated scans, in which the lines of the printer and the lines of the microscope run
    along different axes. ``size_px`` is the side length of a print in pixels.
    """
    grid = noise.on_grid((size_px, size_px))
    # The mean over a line has the noise power at frequency 0 along the line.
    own_um2 = float(grid[1:, 0].mean()) / size_px * 1e-6
    variance = sd_um**2
    z = variance / ((variance + own_um2) * math.sqrt(2 / (size_px * prints)))
    return float(norm.cdf(z - Z_DECIDED))


def surely_better(
    question: Question, gain: float, difference: float, noise: float, prints: int, pixels: int
) -> float:
    """Reduce a gain (difference of two squared errors) by an allowance for the error of the model itself.
    Return the reduced gain in units of its standard deviation, which has two parts: the noise, and the
    variation between prints, with the relative spread ``question.spread``. The result is 0 if the gain does
    not exceed the allowance.

    Let A and B be the predictions of two refitted rivals after projection onto the complement of the per-scan
    terms, and D = B - A. Suppose that A is true except for noise n and an error e in the formulas of the
    model, which both rivals share. Prints then show y = A + e + n, and the difference of the two squared
    errors is |y - B|² - |y - A|² = |D|² - 2<D, e> - 2<D, n>. The noise averages out over prints, but e recurs
    in every print of similar texture. The angle between e and D is unknown. As |<D, e>| <= |D| |e| (Cauchy
    and Schwarz), a difference of up to 2 |D| |e| is inconclusive, and no number of prints separates rivals
    with |D| below 2 |e|. A second allowance is derived from the new prints. Without e and without noise, the
    gain would be |D|². If the gain is smaller, the part of the shortfall that noise does not explain also
    counts as an error of the model. The larger of the two allowances is used.

    Args:
        question: the question among whose answers the rivals are. Its field ``form_nm`` is the largest
            possible rms of e.
        gain: |y - B|² - |y - A|², where A is the rival that fits better, summed over all pixels, nm².
        difference: |D|², the squared norm of the difference of the two predictions, nm².
        noise: variance of the gain that noise causes, nm⁴.
        prints: number of prints.
        pixels: number of pixels in all scans of these prints.
    """
    sd = math.sqrt(noise + (question.spread * gain) ** 2 / prints)
    if sd <= 0:
        return 0.0
    unknown = 2 * math.sqrt(difference * pixels) * (question.form_nm or 0.0)
    # A gain that exceeds the expected gain |D|² raises no doubt about the form of the model, so it adds no
    # allowance.
    seen = difference - gain - Z_DECIDED * sd
    return max(gain - max(unknown, seen), 0.0) / sd


# Numbers of prints that can be planned. The power is computed for each of them.
COUNTS = range(1, 13)
# Number of times that the parameters of the rivals are drawn at random within their uncertainty. The power is
# averaged over these draws, because the difference between two rivals may depend on the parameters.
DRAWS = 8


def of_rivals(
    rivalry: Rivalry,
    tried: Mapping[str, float],
    planned: Sequence[Print],
    random: Sequence[Print],
    prints: int,
) -> PlannedQuestion:
    """Plan how to answer a question whose rivals (competing explanations) are models. The power to decide the
    question is computed for the planned prints and, as a control, for the same number of prints with random
    layouts.

    Args:
        rivalry: the rivals of the question.
        tried: separation of the two most similar rivals, in standard deviations, for each tried way to print
            and scan, keyed by a description of the way.
        planned: planned prints on which the rivals are compared.
        random: the same prints with random layouts.
        prints: number of prints in the plan.
    """
    question = rivalry.question
    pairs, control = _pairs(rivalry, planned), _pairs(rivalry, random)
    hardest = min(pairs, key=lambda pair: (pair.power[prints - 1], pair.difference_nm))
    return _planned(
        question,
        hardest.power,
        prints,
        tried,
        rivals=[rival.name for rival in question.rivals],
        pairs=pairs,
        difference_nm=hardest.difference_nm,
        random_difference_nm=min(pair.difference_nm for pair in control),
        noise_nm=hardest.noise_nm,
        random_power=np.min([pair.power for pair in control], axis=0).tolist(),
    )


def _pairs(rivalry: Rivalry, prints: Sequence[Print]) -> list[PlannedPair]:
    """Compare all pairs of rivals on the given prints. Either rival of a pair may be true. The power is
    computed for both cases, and the smaller power is returned. In each case, the power is averaged over
    random draws of the parameters of the rivals.
    """
    random = np.random.default_rng(0)
    first = [linearised(rivalry.twins, scan) for scans in prints for scan in scans]
    powers = []
    for _ in range(DRAWS):
        drawn = rivalry.drawn(random)
        shown = drawn.contrasts(prints, drawn.refitted(prints, first=first)).values()
        powers.append([[of_contrast(one, rivalry.question, n) for n in COUNTS] for one in shown])
    fitted = rivalry.contrasts(prints, rivalry.refitted(prints, rounds=2, first=first))
    mean = dict(zip(fitted, np.mean(powers, axis=0).tolist(), strict=True))
    found = []
    for pair in combinations(rivalry.twins, 2):
        harder = min(pair, pair[::-1], key=mean.__getitem__)
        found.append(
            PlannedPair(
                rivals=pair,
                difference_nm=fitted[harder].rms_nm,
                noise_nm=fitted[harder].noise_nm,
                power=mean[harder],
            )
        )
    return found


def of_others(
    question: Question, open_: OpenQuestions, prints: int, scans: int, size_px: int
) -> PlannedQuestion:
    """Plan how to answer a question for which the layouts do not matter. Such a question is answered by
    scanning prints in a certain way, or by adding a missing fact to the dataset card.

    Args:
        question: the question.
        open_: the open questions, together with the noise of the scans.
        prints: number of prints in the plan.
        scans: number of scans of each print.
        size_px: side length of a print in pixels.
    """
    power = [0.0 for _ in COUNTS]
    if question.kind == "lines":
        sd_um = next(iter(question.sizes.values()), 0.0)
        power = [of_lines(sd_um, open_.noise, size_px, n) for n in COUNTS]
    elif question.kind == "per-scan":
        power = [of_repeats(n, scans) for n in COUNTS]
    return _planned(question, power, prints)


def _planned(
    question: Question, power: list[float], prints: int, tried: Mapping[str, float] = {}, **known: Any
) -> PlannedQuestion:
    """Make the record of a question with its status, the reason for it, and all possible outcomes. ``known``
    contains the fields that only questions with rivals have.
    """
    needed = next((n for n, own in zip(COUNTS, power, strict=True) if own >= ENOUGH), None)
    status: Status = "may decide"
    if question.kind == "fact":
        status = "needs a fact"
    elif power[prints - 1] >= ENOUGH:
        status = "decides"
    elif power[prints - 1] <= HOPELESS and not needed:
        status = "no experiment separates"
    facts = {"question": question, "status": status, "tried": tried, **known}
    why, outcomes = (filled(one, **facts).splitlines() for one in (_WHY, _OUTCOMES))
    return PlannedQuestion(
        **question.model_dump(include={"name", "kind", "text", "form_nm"}),
        status=status,
        why="; ".join(why),
        power=power,
        prints_needed=needed,
        outcomes=outcomes,
        **{"random_power": power, **known},
    )
