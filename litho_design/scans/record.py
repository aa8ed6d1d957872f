"""The record of a scan whose print is scored."""

from __future__ import annotations

from typing import Literal

from litho_data.foundation.results import Record
from litho_design.images.measurements import Levelling


class MeasuredRecord(Record):
    """The scan, its agreement with the expected print, and its processing.

    ``orientation`` is the operation that brings the scan into the orientation of the layout.
    ``tilt_um_per_um`` (x, y) is the removed tilt, and ``bow_um`` is the height range of the removed bow over
    the element. They were measured on the bare substrate around the print (``levelled_on`` is ``substrate``),
    or together with the gain of the expected print (``print``), which also removes tilt and bow of the print
    itself. ``removed_sd_um`` contains the standard deviation of each of these terms (x, y, x², xy, y²).
    ``noise_um`` is the standard deviation of the noise, estimated from spatial frequencies at which prints
    have no structure. ``warp_errors_um`` contains independent errors of the registration, each as large as
    its standard deviation: the six of ``warp_errors_px``, and two shifts of the whole print, along x and
    along y, because a registration cannot tell whether the print or the scan is shifted. It is empty for an
    aligned scan. ``scale_sd`` is the relative standard deviation of the height scale. ``defect_share`` is the
    share of the element that shows dust or scars instead of the print.
    """

    name: str
    sha256: str
    coverage: float
    registration_ncc: float
    aligned: bool
    height_offset_um: float
    orientation: str
    warning: str
    levelling: Levelling
    levelled_on: Literal["substrate", "print"]
    tilt_um_per_um: tuple[float, float]
    bow_um: float
    removed_sd_um: list[float]
    noise_um: float
    warp_errors_um: list[list[float]]
    scale_sd: float
    defect_share: float
    tip_um: float
    tip_change_um: float

    def remarks(self) -> list[str]:
        """Return remarks on the tilt and other effects that were removed from the scan, and on its
        orientation, one phrase each.
        """
        found = [] if not self.warning else [self.warning]
        found += ["the scan was used without registration"] if self.aligned else []
        if self.orientation != "identity":
            found.append(f"the orientation of the scan was corrected by {self.orientation}")
        if self.levelling == "none":
            found.append("no tilt or bow was removed")
        else:
            x, y = self.tilt_um_per_um
            found.append(
                f"a tilt of {x:+.4f}, {y:+.4f} µm/µm and a bow of {1000 * self.bow_um:.0f} nm were removed, "
                + (
                    "as measured on the bare substrate around the print"
                    if self.levelled_on == "substrate"
                    else "which may hide tilt and bow of the print itself"
                )
            )
        if self.defect_share:
            found.append(
                f"dust or scars cover {100 * self.defect_share:.2g} % of the element and were excluded"
            )
        if self.tip_um:
            change = f"{1000 * self.tip_change_um:.0f} nm rms"
            found.append(
                f"the widening caused by a tip with a radius of {1000 * self.tip_um:.0f} nm was removed, "
                f"which changed the heights by {change}"
            )
        return found
