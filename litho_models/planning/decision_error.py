"""By how much one of two rivals is better, beyond what noise and the model's own form can do.

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

import numpy as np
from scipy.stats import norm

from litho_models.twin.judging import CONFIRM_P

# A wrong name is given with this probability at most.
Z_DECIDED = float(norm.isf(CONFIRM_P))


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
