"""Estimate the radius of the microscope's tip from all scans of a dataset card, before the dataset is
built.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace

from litho_data.foundation import InputError
from litho_data.making.jobs import FieldJob
from litho_data.sharing.workers import Workers, run_jobs
from litho_data.tip.radius import PeakRadius, of_one_tip, peak_radius


def with_tip_found(jobs: Sequence[FieldJob], workers: Workers) -> list[FieldJob]:
    """Estimate the radius of the tip if the card of the jobs states ``tip = "blind"``. Return the jobs with
    this radius in place of "blind". Otherwise, return the jobs unchanged.

    If the scans set no upper limit on the radius, the returned jobs have no tip radius. The estimate is also
    printed on stderr. Scans that cannot be read are not used for the estimate. The build reports later why
    they cannot be read.
    """
    if not jobs or jobs[0].card.process.tip != "blind":
        return list(jobs)
    bounds = run_jobs(tip_of, jobs, workers, name=lambda job: job.id)
    found = [one for _, one in bounds if one is not None]
    tip = of_one_tip(found) if found else None
    radius_um = None if tip is None else tip.radius_um
    if tip is None or radius_um is None:
        print("tip: the scans set no limit on its radius, so no pixels are excluded", file=sys.stderr)
    elif tip.reason:
        print(f"tip: radius at most {radius_um:.3g} µm; {tip.reason}", file=sys.stderr)
    else:
        print(f"tip: radius {radius_um:.3g} ± {tip.sd_um:.2g} µm", file=sys.stderr)
    # The radius is rounded, so that it does not depend on the order in which the scans finish. The rounding
    # changes the radius by far less than its uncertainty.
    rounded = None if radius_um is None else float(f"{radius_um:.9g}")
    card = jobs[0].card
    process = card.process.model_copy(update={"tip": rounded})
    return [replace(job, card=card.model_copy(update={"process": process})) for job in jobs]


def tip_of(job: FieldJob) -> PeakRadius | None:
    """Estimate the radius of the tip from one scan, or return None if the scan cannot be read. If the card
    names calibration standards, the radius is computed with calibrated lengths.
    """
    try:
        chain = job.begin()
    except InputError:
        return None
    pitch_y_um, pitch_x_um = chain.pitch_um
    height_um = chain.arrays["raw_height_um"].astype(float) * chain.scales.get("scale_z", 1.0)
    return peak_radius(height_um, (pitch_y_um, pitch_x_um))
