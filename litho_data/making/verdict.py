"""Judge a dataset: compare the numbers in its card with the measured heights, and list what to fix."""

from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum

import numpy as np

from litho_data.cards.card import Card
from litho_data.foundation import Facts, InputError
from litho_data.foundation.results import Record
from litho_data.making.right_layout import Print

ALL = "all scans"
# Limits of the height per level. If the height per level of the prints differs from the level height in the
# card by more than the first factor, this is reported. If it differs by more than the second factor, nothing
# is built. A scan is left out if its height per level differs from the median over the scans by more than the
# third factor.
_TIMES, _IMPOSSIBLE, _ODD_SCAN = 3.0, 100.0, 30.0
# Limits of the scale factor from a scan to its layout. If the factors differ from 1 by more than the first
# value, but from each other by less than the second value, the pitch in the card is probably wrong. If the
# factor of a single scan differs from the median over the scans by more than the third value, the size of
# this scan is probably wrong.
_OFF, _ALIKE, _ODD_SCALE = 0.02, 0.01, 0.04
_LEAST_VALID = 0.5
# Largest accepted value of ``Print.edge_times``. Measured prints have values of 1.1 to 1.5. Simulated prints
# have the value 2 if the layout has a rim of substrate around the field, and 6 to 8 if it has no rim.
_EDGE_TIMES = 2.5
_MOST_TRE_PX = 1.0
# Largest accepted uncertainty that levelling causes in the heights of a scan, as a share of their standard
# deviation.
_LEFT = 0.3
_SHOWN = 12


class Weight(IntEnum):
    """The rank of a finding. Findings with a lower number are worse and are listed first."""

    LAYOUT = 0
    PITCH = 1
    HEIGHT = 2
    SKIPPED = 3
    NOTE = 4
    LEVEL = 5
    PLACE = 6


class Finding(Record):
    """One thing to fix. ``scan`` is the id of the scan that it concerns, or "all scans"."""

    scan: str
    text: str
    weight: int

    def __str__(self) -> str:
        return f"{self.scan}: {self.text}"


def odd_heights(prints: Sequence[Print]) -> dict[str, str]:
    """Find scans whose height per level differs greatly from the median over all scans. The result maps the
    ids of these scans to the reason for leaving them out.
    """
    gains = {one.id: abs(one.response[0]) for one in prints}
    if len(gains) < 3:
        return {}
    usual = float(np.median(list(gains.values())))
    times = {name: gain / usual for name, gain in gains.items() if usual > 0}
    return {
        name: f"its height per level is {_shown(one)} that of the others: is its unit right?"
        for name, one in times.items()
        if not 1 / _ODD_SCAN < one < _ODD_SCAN
    }


def require_heights(prints: Sequence[Print], card: Card) -> None:
    """Reject a card whose level height is far from the measured height per level. For example, the card may
    state the level height in nm instead of µm.

    Raises:
        InputError: the height per level of the prints is more than 100 times the level height in the card, or
            less than a hundredth of it.
    """
    times = _height_times(prints, card)
    if times and not 1 / _IMPOSSIBLE < times < _IMPOSSIBLE:
        height_um = card.layout.level_height_um
        raise InputError(
            "layout.level_height_um",
            got=f"{height_um:g} µm, but the prints rise by {times * height_um:.3g} µm per level",
            wanted="the height of one level in µm",
            hint="or is scan.unit wrong?",
        )


def findings(
    records: Sequence[Facts],
    prints: Sequence[Print],
    doubts: Mapping[str, str],
    left_out: Mapping[str, str],
    card: Card,
) -> list[Finding]:
    """Return the list of things to fix, worst first. The list is empty for a good dataset.

    Args:
        records: the records of the dataset's scans.
        prints: the registered scans, sampled at a few points (see ``prints_of``).
        doubts: reasons to suspect that a scan does not show its own layout, keyed by the id of the scan.
        left_out: reasons why ids are not in the store, keyed by the id.
        card: the dataset card whose numbers are compared with the heights.
    """
    named = [(name, text, Weight.LAYOUT) for name, text in doubts.items()]
    named += [(name, f"skipped: {reason}", Weight.SKIPPED) for name, reason in left_out.items()]
    spread_nm = {one.id: 1e3 * float(np.nanstd(one.height)) for one in prints}
    for record in records:
        named += [(record["id"], text, weight) for text, weight in _of_a_scan(record, spread_nm)]
    found = [
        Finding(scan=name, text=text, weight=weight)
        for name, text, weight in (*named, *_of_the_card(records, prints, card))
    ]
    return sorted(found, key=lambda one: (one.weight, one.scan != ALL, one.scan))


def _of_a_scan(record: Facts, spread_nm: Mapping[str, float]) -> Iterator[tuple[str, Weight]]:
    """Yield the problems of one scan, each as a text and a weight.

    ``spread_nm`` maps the ids of the scans to the standard deviations of their heights, in nm.
    """
    quality = record["quality"]
    for note in record.get("notes", ()):
        yield note, Weight.NOTE
    if quality.get("polarity") == -1:
        yield "its heights fall where the levels rise: is the layout or the scan inverted?", Weight.LAYOUT
    if (off := quality.get("tre_median_px", 0.0)) > _MOST_TRE_PX:
        text = f"details lie {off:.1f} px away from their places in the layout: are layout and pitch right?"
        yield text, Weight.PLACE
    if (valid := quality.get("valid_fraction", 1.0)) < _LEAST_VALID:
        yield f"heights are valid in only {valid:.0%} of its layout: is process.tip too large?", Weight.PLACE
    left = quality.get("sigma_levelling_nm", 0.0)
    if left > _LEFT * spread_nm.get(record["id"], np.inf):
        text = (
            f"a tilt or bow of {left:.0f} nm may remain in its heights: compare recipes with build --suggest"
        )
        yield text, Weight.LEVEL


def _of_the_card(
    records: Sequence[Facts], prints: Sequence[Print], card: Card
) -> Iterator[tuple[str, str, Weight]]:
    """Find where the measured scans contradict the numbers in the card.

    For each contradiction, yield the id of the scan that it concerns (or "all scans"), a text and a weight.
    """
    layout = card.layout
    times = _height_times(prints, card)
    if times and not 1 / _TIMES < times < _TIMES:
        text = (
            f"the prints rise by {times * layout.level_height_um:.3g} µm per level, {_shown(times)} "
            f"layout.level_height_um = {layout.level_height_um:g}: is this value or scan.unit wrong?"
        )
        yield ALL, text, Weight.HEIGHT
    scales = np.array([scale for one in records if (scale := _scale(one))])
    usual = float(np.median(scales)) if len(scales) else 1.0
    for one in records:
        if (scale := _scale(one)) and abs(scale / usual - 1) > _ODD_SCALE:
            percent = 100 * (scale / usual - 1)
            text = f"its scale differs by {percent:+.1f} % from that of the others: is its size right?"
            yield one["id"], text, Weight.PITCH
    if abs(usual - 1) > _OFF and float(np.median(np.abs(scales - usual))) < _ALIKE:
        text = (
            f"the scale of the scans is {100 * (usual - 1):+.1f} % off: "
            f"layout.pitch_um = {layout.pitch_um:g} should be {layout.pitch_um / usual:.4g}, "
            "or the sizes of the scans are wrong"
        )
        yield ALL, text, Weight.PITCH
    edge_times = float(np.median([one.edge_times for one in prints])) if prints else 0.0
    if edge_times > _EDGE_TIMES:
        text = (
            f"their outermost pixels deviate {edge_times:.0f} times as much from the layouts as the inner "
            "ones: if level 0 continues around a field, set write.surround to substrate; otherwise, set "
            "it to unknown, which excludes these pixels"
        )
        yield ALL, text, Weight.LEVEL
    highest = max((float(one.highest_level) for one in prints), default=layout.levels)
    if 2 * highest < layout.levels - 1:
        text = f"the layouts use no level above {highest:g}, but layout.levels = {layout.levels}"
        yield ALL, text, Weight.HEIGHT


def _scale(record: Facts) -> float:
    """Return the scale factor from a scan to its layout, or 0 if the scan was not registered."""
    low, high = (record["quality"].get(f"singular_{end}", np.nan) for end in ("min", "max"))
    return float(low * high) ** 0.5 if low * high > 0 else 0.0


def _height_times(prints: Sequence[Print], card: Card) -> float:
    """Return the median height per level of the prints, divided by the level height in the card. The result
    is 0 if there are no prints.
    """
    gains = [abs(one.response[0]) for one in prints]
    return float(np.median(gains)) / card.layout.level_height_um if gains else 0.0


def _shown(times: float) -> str:
    return f"{times:.3g} times" if times >= 1 else f"1/{1 / max(times, 1e-12):.3g} of"


def verdict_of(found: Sequence[Finding], n_scans: int) -> str:
    """Return the verdict at the top of the report. It says that the dataset is good, or lists what to fix,
    worst first.
    """
    if not found:
        return f"Good: all {n_scans} scans are in the store, and no problem was found."
    shown = " · ".join(str(one) for one in found[:_SHOWN])
    more = f" · and {len(found) - _SHOWN} more in the table" if len(found) > _SHOWN else ""
    return f"{n_scans} scans are in the store. To do, worst first — {shown}{more}"
