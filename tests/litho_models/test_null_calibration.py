"""Check the calibration of false alarms, in which no cause is planted, and that the page quotes it."""

from __future__ import annotations

import json

import numpy as np

from benchmarks import null_calibration
from benchmarks.record import NOT_MEASURED, published


def test_the_page_quotes_the_committed_calibration() -> None:
    text = published(null_calibration.PAGE, null_calibration.NAME)
    if not null_calibration.RESULT.exists():
        assert text == NOT_MEASURED
        return
    record = json.loads(null_calibration.RESULT.read_text(encoding="utf-8"))
    assert text == null_calibration.as_markdown(record)
    false = sum(bool(store["found"]) for store in record["stores"])
    assert false <= null_calibration.most_at_the_rate(len(record["stores"]))


def test_five_of_40_are_consistent_with_the_rate_and_six_are_not() -> None:
    # At the stated rate, six or more of 40 have a probability of 0.014, and five or more one of 0.048.
    assert null_calibration.most_at_the_rate(40) == 5


def test_scans_of_one_store_share_the_model_and_nothing_else() -> None:
    scans = null_calibration.null_scans(1)
    assert len(scans) == null_calibration.SCANS
    heights = np.stack([scan.height_um for scan in scans]).astype(np.float64)
    # The roughness of 16 nm is correlated over less than 1 µm. Two scans have only the layout's statistics in
    # common, so their maps correlate by at most a few times 1 / sqrt(number of 2 µm places in 19 µm).
    maps = heights - heights.mean(axis=(1, 2), keepdims=True)
    cosine = np.corrcoef(maps.reshape(len(maps), -1))
    assert np.abs(cosine - np.eye(len(maps))).max() < 5 / np.sqrt(9.6**2)
    assert np.array_equal(scans[0].height_um, null_calibration.null_scans(1)[0].height_um)
