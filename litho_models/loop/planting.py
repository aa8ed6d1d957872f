"""Plant a known effect in copies of the scans (add the change that it would make), and test whether the loop
finds it there.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

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
    wanted: Sequence[tuple[Effect, float]],
    closed: Closed,
    close_again: Callable[[Sequence[PrintedScan]], Closed],
) -> list[Planted]:
    """Plant each effect in copies of the scans, run the loop again on these copies, and return the records of
    what it finds.

    Args:
        wanted: the effects, and the value of each effect's first amplitude (see ``parse_planted``).
        closed: result of the loop on the original scans.
        close_again: function that runs the same loop on the scans that it receives.
    """
    # Effects cannot be sent to other processes, so the jobs contain their names.
    jobs = [
        partial(_found, effect.name, amount, *_planted(effect, amount, closed), close_again)
        for effect, amount in wanted
    ]
    return closed.given.run(jobs, "running the loop on copies of the scans")


def _planted(effect: Effect, amount: float, closed: Closed) -> tuple[Sequence[PrintedScan], float]:
    """Plant an effect in copies of the scans. Return the copies and the rms change of the height, nm."""
    twin, values = closed.base.twin, {effect.name: effect.with_values({effect.amplitudes[0]: amount})}
    changed, sizes_um = [], []
    for scan in closed.given.scans:
        here = twin.height(scan)
        added = twin.height(scan, values) - here
        changed.append(replace(scan, height_um=scan.height_um + added.astype(np.float32)))
        sizes_um.append(rms(scan.freed(scan.at_sample(added), here)))
    return changed, NM_PER_UM * rms(sizes_um)


def _found(
    name: str,
    amount: float,
    changed: Sequence[PrintedScan],
    rms_nm: float,
    close_again: Callable[[Sequence[PrintedScan]], Closed],
) -> Planted:
    effect, again = get_effect(name), close_again(changed)
    amplitude = effect.amplitudes[0]
    sets = ([one.name, *one.alike] for one in again.named.causes if again.needed_by_all(one))
    return Planted(
        name=name,
        amount=amount,
        unit=effect.parameters[amplitude].unit,
        rms_nm=rms_nm,
        named=next((names for names in sets if name in names), []),
        found=again.final.twin.values().get(name, {}).get(amplitude),
    )
