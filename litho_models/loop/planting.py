"""Plant a known effect in copies of the scans (add the change that it would make), and test whether the loop
finds it there.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from litho_data.foundation import NM_PER_UM, InputError
from litho_data.store import PrintedScan
from litho_models.effects import Effect, get_effect
from litho_models.loop.closing import Closed
from litho_models.loop.record import Planted
from litho_models.scoring.statistics import rms


def parse_planted(text: str) -> tuple[Effect, float]:
    """Parse ``NAME=AMOUNT`` into an effect and the value of its first amplitude.

    Raises:
        InputError: the text is not NAME=AMOUNT, the effect is unknown or a per-scan effect, or the amount is
            not a number or lies outside the physical range of the amplitude.
    """
    name, _, number = text.partition("=")
    effect = get_effect(name.strip())
    try:
        amount = float(number)
    except ValueError as error:
        wanted = "NAME=AMOUNT, such as vignetting=0.1"
        raise InputError("--inject", got=repr(text), wanted=wanted) from error
    if effect.per_scan:
        raise InputError("--inject", got=name, wanted="an effect with the same parameters in all scans")
    effect.require_in_range({effect.amplitudes[0]: amount})
    return effect, amount


def plant(
    effect: Effect, amount: float, closed: Closed, close_again: Callable[[Sequence[PrintedScan]], Closed]
) -> Planted:
    """Plant an effect in copies of the scans, run the loop again on these copies, and return the record of
    what it finds.

    Args:
        effect, amount: the effect and the value of its first amplitude, as ``parse_planted`` returns them.
        closed: result of the loop on the original scans.
        close_again: function that runs the same loop on the scans that it receives.
    """
    amplitude = effect.amplitudes[0]
    values = {effect.name: effect.with_values({amplitude: amount})}
    twin = closed.base.twin
    changed, sizes_um = [], []
    for scan in closed.given.scans:
        here = twin.height(scan)
        added = twin.height(scan, values) - here
        changed.append(replace(scan, height_um=scan.height_um + added.astype(np.float32)))
        sizes_um.append(rms(scan.freed(scan.at_sample(added), here)))
    again = close_again(changed)
    sets = ([one.name, *one.alike] for one in again.named.causes if again.needed_by_all(one))
    return Planted(
        name=effect.name,
        amount=amount,
        unit=effect.parameters[amplitude].unit,
        rms_nm=NM_PER_UM * rms(sizes_um),
        named=next((names for names in sets if effect.name in names), []),
        found=again.final.twin.values().get(effect.name, {}).get(amplitude),
    )
