"""Named runs: the embedded default of the demo, and the full size of the measured prints."""

from __future__ import annotations

from dataclasses import dataclass

from litho_data.foundation.errors import InputError


@dataclass(frozen=True)
class Preset:
    """Count, size and knobs of a run; what a caller states overrules them.

    Args:
        count: number of scans.
        size_px: side of the layouts, pixels.
        fields_per_print: fields of one print block.
        knobs: ``name=strength[@seed]``.
    """

    count: int
    size_px: int
    fields_per_print: int = 4
    knobs: tuple[str, ...] = ()


PRESETS = {
    "plain": Preset(count=12, size_px=256),
    "demo": Preset(
        count=12,
        size_px=192,
        knobs=("write-order-memory=0.15", "scan-line-stripes=6", "tilt-bow=15"),
    ),
    "measured-like": Preset(
        count=24,
        size_px=512,
        knobs=("slope-thinning-x=0.4", "scan-line-stripes=8", "tilt-bow=20", "min-to-zero-datum=1"),
    ),
}


def preset(name: str) -> Preset:
    """The preset of that name.

    Raises:
        InputError: no such preset.
    """
    if name not in PRESETS:
        raise InputError("preset", got=repr(name), wanted=", ".join(PRESETS))
    return PRESETS[name]
