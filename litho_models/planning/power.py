"""How probably so many prints decide rightly, and what counts of a gain.

With A and B the predictions of two refitted rivals, freed of per-scan terms, D = B - A, and A true but for
the noise n and the error e of the form that both share, prints show y = A + e + n and the difference of the
two squared errors is |y - B|² - |y - A|² = |D|² - 2<D, e> - 2<D, n>. The noise averages down with prints.
The error of the form comes back with every print of a like texture and does not; how it lies to D is not
known, and |<D, e>| <= |D| |e| (Cauchy and Schwarz), so that 2 |D| |e| of a difference decide nothing.
Rivals with |D| below 2 |e| are told apart by no number of prints. How e really lies to D the new prints
show themselves: with A true and no error the gain is |D|²; by what it differs from that, beyond noise, e
has spoken. The larger one counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import f as f_distribution
from scipy.stats import norm

from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.judging import CONFIRM_P
from litho_models.planning.questions import NoiseSpectrum, Question
from litho_models.planning.rivalry import Contrast

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

    All four are sums over the same pixels, in one unit.

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
