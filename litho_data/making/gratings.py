"""Measure the scales, the nonlinearity and the tip of a microscope in scans of a grating of known period."""

from typing import Any

from litho_data.cards.card import KnownGrating
from litho_data.foundation import YX, Array, InputError
from litho_data.foundation.results import Record
from litho_data.roughness import axis_scales, find_wave, line_bow
from litho_data.store.read import Store
from litho_data.tip.radius import peak_radius

_BOUND_SIGMA = 2.0


class GratingScan(Record):
    """The values that were measured in one scan of a grating. A value that could not be measured is None. If
    the grating could not be evaluated, ``problem`` gives the reason.

    Args:
        period_um: known period of the grating.
        line_um: length of a scan line.
        scale_x, scale_y: factors that convert lengths in the scan, along x and y, to true lengths.
            ``scale_x_sd`` and ``scale_y_sd`` are their standard uncertainties.
        bow_um: displacement along x of the middle of a scan line relative to its ends. ``bow_sd_um`` is its
            standard uncertainty.
        tip_at_most_um: upper bound on the radius of the tip. The bound does not hold for a tip that is too
            blunt to enter the gaps between bars, because such a tip seems sharper than it is.
    """

    id: str
    period_um: float
    line_um: float
    scale_x: float | None = None
    scale_x_sd: float | None = None
    scale_y: float | None = None
    scale_y_sd: float | None = None
    bow_um: float | None = None
    bow_sd_um: float | None = None
    tip_at_most_um: float | None = None
    problem: str = ""


def grating_scans(store: Store) -> list[GratingScan]:
    """Measure all scans of gratings among the reference scans of a store.

    The scans are used as they were read, without levelling, and x is taken as the fast axis.
    """
    known = store.manifest.get("card", {}).get("grating")
    if known is None:
        return []
    pitches = store.recorded_pitches_um()
    return [
        grating_scan(
            scan_id, store.scan_frame(scan_id, "raw_height_um"), pitches[scan_id], KnownGrating(**known)
        )
        for scan_id, use in store.references().items()
        if use == "grating"
    ]


def grating_scan(scan_id: str, height_um: Array, pitch_um: YX, known: KnownGrating) -> GratingScan:
    """Measure one scan of a grating.

    Args:
        scan_id: id of the scan.
        height_um: heights in µm, shape (ny, nx).
        pitch_um: pitch (y, x) of the scan in µm, as stated.
        known: known period of the grating and its uncertainty.
    """
    height_um = height_um.astype(float)
    found = GratingScan(id=scan_id, period_um=known.period_um, line_um=height_um.shape[1] * pitch_um[1])
    tip = peak_radius(height_um, pitch_um)
    figures: dict[str, Any] = {}
    if tip.radius_um is not None:
        # If the estimate is itself only an upper bound, it already includes the uncertainty.
        figures["tip_at_most_um"] = tip.radius_um + (0.0 if tip.reason else _BOUND_SIGMA * tip.sd_um)
    try:
        waves = [find_wave(height_um, pitch_um, known.period_um, axis) for axis in ("x", "y")]
        scales = axis_scales([(one, known.period_um, known.uncertainty_um) for one in waves], ["x", "y"])
        bow_um, bow_sd_um = line_bow(height_um, pitch_um, waves[0])
        figures |= {"bow_um": bow_um, "bow_sd_um": bow_sd_um}
        for axis, scale in scales.items():
            figures |= {f"scale_{axis}": scale.factor, f"scale_{axis}_sd": scale.uncertainty}
    except InputError as error:
        figures["problem"] = str(error)
    return found.model_copy(update=figures)
