"""Check that splits are disjoint, complete and reproducible, and only the paper's split divides scans."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from litho_data.foundation.errors import InputError
from litho_data.store.lock_box import lock_box
from litho_models.splits.folds import (
    Crop,
    grouped_folds,
    inner_validation,
    leave_one_print_out,
    paper_draw,
)

MEASURED_IDS = [f"FOV{print_}{field}" for print_ in (1, 2, 3, 4, 6, 7) for field in (1, 2, 3, 4)]
PRINTS = [scan_id[3] for scan_id in MEASURED_IDS]


def test_folds_hold_each_scan_out_exactly_once():
    folds = grouped_folds(MEASURED_IDS, MEASURED_IDS, 5)
    assert sorted(scan_id for fold in folds for scan_id in fold) == sorted(MEASURED_IDS)
    assert max(map(len, folds)) - min(map(len, folds)) <= 1


def test_folds_depend_on_the_seed_and_not_on_the_order_of_the_ids():
    assert grouped_folds(MEASURED_IDS, MEASURED_IDS, 5, seed=3) == grouped_folds(
        MEASURED_IDS[::-1], MEASURED_IDS[::-1], 5, seed=3
    )
    assert grouped_folds(MEASURED_IDS, MEASURED_IDS, 5, seed=3) != grouped_folds(
        MEASURED_IDS, MEASURED_IDS, 5, seed=4
    )


def test_the_recorded_folds_of_the_measured_prints_are_those_that_are_computed():
    record = Path(__file__).parents[2] / "datasets" / "neural-lithography.split.toml"
    stated = tomllib.loads(record.read_text(encoding="utf-8"))
    locked = lock_box(MEASURED_IDS, PRINTS, MEASURED_IDS)
    rest = [scan_id for scan_id in MEASURED_IDS if scan_id not in locked]
    assert stated["grouped"]["folds"] == grouped_folds(rest, rest, 5)


def test_no_fold_separates_scans_of_one_field():
    field_of = {f"{scan_id}{way}": scan_id for scan_id in MEASURED_IDS for way in ("trace", "retrace")}
    folds = grouped_folds([*field_of], [*field_of.values()], 5)
    assert sorted(one for fold in folds for one in fold) == sorted(field_of)
    held_out = [{field_of[one] for one in fold} for fold in folds]
    assert sum(map(len, held_out)) == len(MEASURED_IDS)
    assert len(grouped_folds([*field_of][:6], [*field_of.values()][:6], 5)) == 3


def test_leave_one_print_out_holds_out_whole_prints():
    folds = leave_one_print_out(MEASURED_IDS, PRINTS)
    assert [len(fold) for fold in folds] == [4] * 6
    assert all(len({scan_id[3] for scan_id in fold}) == 1 for fold in folds)


def test_paper_draw_is_72_against_24_and_leaky():
    held_out = paper_draw(MEASURED_IDS, 0)
    assert len(held_out) == 24
    # The draw takes 24 of 96 quadrants at random. Without a leak, each scan would be completely in or out.
    split_scans = {crop.scan_id for crop in held_out} & {
        scan_id for scan_id in MEASURED_IDS if sum(c.scan_id == scan_id for c in held_out) < 4
    }
    assert split_scans


def test_quadrants_tile_a_scan_of_odd_size():
    import numpy as np

    seen = np.zeros((7, 9), int)
    for quadrant in range(4):
        seen[Crop("a", quadrant).slices((7, 9))] += 1
    assert (seen == 1).all()


def test_inner_validation_is_a_small_part_of_the_training_scans():
    assert len(inner_validation(MEASURED_IDS, 2)) == 2
    assert len(inner_validation(MEASURED_IDS[:5], 2)) == 1
    assert inner_validation(MEASURED_IDS[:3], 2) == []


@pytest.mark.parametrize(
    "call",
    [
        lambda: grouped_folds(["a", "a", "b"], ["a", "a", "b"], 2),
        lambda: grouped_folds(["a", "b"], ["1", "1"], 2),
        lambda: leave_one_print_out(["a", "b"], ["1", "1"]),
    ],
)
def test_impossible_splits_are_refused(call):
    with pytest.raises(InputError):
        call()
