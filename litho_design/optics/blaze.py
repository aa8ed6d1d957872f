"""How much light a staircase of levels can send into an order: what the print's stroke costs."""

from __future__ import annotations

import math

import pandas as pd


def blaze_efficiency(steps: int, gain: float, order: int = 1) -> float:
    """Scalar efficiency of a blazed grating with ``steps`` equal steps whose stroke is ``gain`` waves.

    eta_m = sinc^2(m/N) [ sin(pi (g - m)) / (N sin(pi (g - m) / N)) ]^2.
    """
    detuning = math.pi * (gain - order)
    narrow = steps * math.sin(detuning / steps)
    array = 1.0 if abs(narrow) < 1e-15 else math.sin(detuning) / narrow
    fraction = order / steps
    element = 1.0 if order == 0 else math.sin(math.pi * fraction) / (math.pi * fraction)
    return (element * array) ** 2


def stroke_table(
    printed_height_um: list[float], wave_height_um: float, *, level_height_um: float
) -> tuple[pd.DataFrame, dict[str, float]]:
    """What a table of printed level heights can do as one period of a blaze.

    Args:
        printed_height_um: printed height of a uniform field of each level, µm.
        wave_height_um: height of one wave, µm.
        level_height_um: nominal step, µm.

    Returns:
        A table level / nominal µm / printed µm / waves, and the advice: reached stroke in waves,
        first and zero order at that stroke, and the levels (or step height) that reach one wave.
    """
    count = len(printed_height_um)
    base = printed_height_um[0]
    table = pd.DataFrame(
        {
            "level": range(count),
            "nominal_um": [level * level_height_um for level in range(count)],
            "printed_um": printed_height_um,
            "printed_waves": [(height - base) / wave_height_um for height in printed_height_um],
        }
    )
    stroke_um = printed_height_um[-1] - base
    gain = stroke_um / ((count - 1) * level_height_um) if count > 1 else 0.0
    # A period of N equal steps spans N/(N-1) of the highest step.
    period_waves = stroke_um / wave_height_um * count / max(count - 1, 1)
    advice = {
        "stroke_um": stroke_um,
        "stroke_waves": stroke_um / wave_height_um,
        "print_gain": gain,
        "blaze_order_1": blaze_efficiency(count, period_waves, 1),
        "blaze_order_0": blaze_efficiency(count, period_waves, 0),
        "levels_for_one_wave": math.ceil(wave_height_um / (gain * level_height_um)) if gain > 0 else math.inf,
        "level_height_for_one_wave_um": wave_height_um / (gain * count) if gain > 0 else math.inf,
    }
    return table, advice
