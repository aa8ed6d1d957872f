"""Test planting effects in copies of the data. This shows how small an effect may be and still be found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.sharing.workers import HERE, Workers
from litho_data.store import PrintedScan
from litho_models.effects import get_effect
from litho_models.loop.closing import Closed, _rest_beside
from litho_models.loop.fits import fit_state
from litho_models.loop.model import Twin
from litho_models.loop.planting import parse_planted, plant
from litho_models.loop.search import Found, search
from tests.litho_models.loop_scans import base_model, planted, study_of

LAW = "height-times-slope-size-x"


def closed_on(scans: Sequence[PrintedScan], workers: Workers = HERE) -> Closed:
    """Run only the search of the loop, with two laws as candidates."""
    study = replace(study_of(scans), workers=workers)
    base = fit_state(Twin.bare(base_model()), study)
    found = search(Found(base), [get_effect(LAW), get_effect("height-power-2")])
    return Closed("affine-mtf", {}, base, base, found, found, found, _rest_beside(base), {})


def test_a_large_amount_is_found_and_a_tiny_one_is_not_and_the_data_stay_as_they_were() -> None:
    scans = planted()
    before = [scan.height_um.copy() for scan in scans]
    # The copies are searched by two other processes.
    closed = closed_on(scans, Workers(2))
    large, tiny = plant([(get_effect(LAW), amount) for amount in (0.04, 0.0002)], closed, closed_on)
    assert (large.name, large.amount, large.unit) == (LAW, 0.04, get_effect(LAW).parameters["strength"].unit)
    assert large.named == [LAW]
    assert large.found == pytest.approx(0.04, rel=0.05)
    assert (tiny.named, tiny.found) == ([], None)
    assert all((a.height_um == b).all() for a, b in zip(scans, before, strict=True))
    # Both amounts are so small that the change is proportional to the amount.
    assert large.rms_nm / tiny.rms_nm == pytest.approx(0.04 / 0.0002, rel=1e-2)
    changes = []
    for scan in closed.given.scans:
        bare, there = closed.base.twin, {"": {"strength": 0.04}}
        here = bare.height(scan)
        change = bare.with_effect(LAW, "all", there).height(scan) - here
        changes.append(np.mean(scan.freed(scan.at_sample(change), here) ** 2))
    assert large.rms_nm == pytest.approx(NM_PER_UM * np.sqrt(np.mean(changes)), rel=1e-4)


@pytest.mark.parametrize(
    "text", ["vignetting", "vignetting=much", "vignetting=", "vignetting=inf", "nothing=1", "tilt-bow=0.1"]
)
def test_what_cannot_be_planted_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        parse_planted(text)


def test_a_name_and_an_amount_are_read() -> None:
    effect, amount = parse_planted(" vignetting =0.1")
    assert (effect.name, amount) == ("vignetting", 0.1)
