"""The stroke of a print (the height range of its levels), and the share of the light that a staircase grating
of these levels sends into a diffraction order.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

from litho_data.foundation.results import Record


class Stroke(Record):
    """Printed heights of the levels, and the efficiencies of a blazed grating whose periods consist of these
    levels.

    ``print_gain`` is the printed height range divided by the nominal height range. If this gain is not
    positive, ``levels_for_one_wave`` and ``level_height_for_one_wave_um`` are None.
    """

    printed_height_um: list[float]
    stroke_um: float
    stroke_waves: float
    print_gain: float
    blaze_order_1: float
    blaze_order_0: float
    levels_for_one_wave: float | None
    level_height_for_one_wave_um: float | None


def blaze_efficiency(steps: int, gain: float, order: int = 1) -> float:
    """Return the efficiency, according to scalar theory, of a blazed grating whose periods consist of
    ``steps`` equal steps. The height of step k is k ``gain`` / ``steps`` waves, where k runs from 0 to
    ``steps`` - 1.
    """
    return staircase_efficiency([gain * step / steps for step in range(steps)], order)


def staircase_efficiency(waves: Sequence[float], order: int) -> float:
    """Return the efficiency, according to scalar theory, of a grating whose periods consist of N steps of
    equal width. ``waves`` contains the heights of the steps, expressed as phase delays in waves.

    eta_m = sinc^2(m/N) |mean over k of exp(2 pi j (w_k - m k/N))|^2, where m is the order and w_k is the
    height of step k.
    """
    steps = len(waves)
    turns = [2j * math.pi * (wave - order * step / steps) for step, wave in enumerate(waves)]
    fraction = math.pi * order / steps
    element = math.sin(fraction) / fraction if order else 1.0
    return float(abs(element * sum(map(cmath.exp, turns)) / steps) ** 2)


def measure_stroke(
    printed_height_um: Sequence[float], wave_height_um: float, *, level_height_um: float
) -> Stroke:
    """Return the stroke of the printed levels, and the efficiency of a blazed grating with these levels.

    Args:
        printed_height_um: printed height of a wide uniform area of each level, µm.
        wave_height_um: height that delays the wave by one period, µm.
        level_height_um: nominal height of one level, µm.

    Returns:
        The stroke, and the efficiency of a blazed grating with these levels in the first and the zero order.
        The record also states what would make the stroke one wave: another number of levels of the same
        height, or the same number of levels of another height.
    """
    count = len(printed_height_um)
    stroke_um = printed_height_um[-1] - printed_height_um[0]
    gain = stroke_um / ((count - 1) * level_height_um) if count > 1 else 0.0
    waves = [height / wave_height_um for height in printed_height_um]
    return Stroke(
        printed_height_um=list(printed_height_um),
        stroke_um=stroke_um,
        stroke_waves=stroke_um / wave_height_um,
        print_gain=gain,
        blaze_order_1=staircase_efficiency(waves, 1),
        blaze_order_0=staircase_efficiency(waves, 0),
        levels_for_one_wave=math.ceil(wave_height_um / (gain * level_height_um)) if gain > 0 else None,
        level_height_for_one_wave_um=wave_height_um / (gain * count) if gain > 0 else None,
    )
