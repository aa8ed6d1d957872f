"""Plant a known effect in copies of the scans (add the change that it would make), and test whether the loop
finds it there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.store import PrintedScan
from litho_models.effects import Effect, get_effect
from litho_models.loop.closing import Closed
from litho_models.loop.record import Planted


def parse_planted(text: str) -> tuple[Effect, float]:
    """Parse ``NAME=AMOUNT`` into an effect and the value of its first amplitude.

    Raises:
        InputError: the text is not NAME=AMOUNT, the effect is unknown or a per-scan effect, or the amount is
            not a number or lies outside the physical range of the amplitude.
    """
    name, separator, number = text.partition("=")
    effect = get_effect(name.strip())
    try:
        amount = float(number)
    except ValueError:
        amount = float("nan")
    if not separator or not np.isfinite(amount):
        raise InputError("--inject", got=repr(text), wanted="NAME=AMOUNT, such as vignetting=0.1")
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
    changed, squares = [], []
    for scan in closed.given.scans:
        here = twin.height(scan)
        added = twin.height(scan, values) - here
        changed.append(replace(scan.stored, height_um=scan.stored.height_um + added.astype(np.float32)))
        squares.append(float(np.mean(scan.freed(scan.at_sample(added), here) ** 2)))
    again = close_again(changed)
    causes = filter(again.needed_by_all, again.named.causes)
    cause = next((one for one in causes if effect.name in (one.name, *one.alike)), None)
    named = [] if cause is None else [cause.name, *cause.alike]
    found = again.final.twin.values().get(effect.name, {}).get(amplitude)
    return Planted(
        name=effect.name,
        amount=amount,
        unit=effect.parameters[amplitude].unit,
        rms_nm=NM_PER_UM * float(np.sqrt(np.mean(squares))),
        named=named,
        found=found,
    )
