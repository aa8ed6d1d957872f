"""Check how scans are grouped by the card, by their ids and by their order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from litho_data.store import PrintedScan, open_store
from litho_models.scan_terms.grouped import ALL, groupings, label_of
from tests.litho_models.loop_scans import blank_scan
from tests.litho_models.prints import make_scans, write_store


def scans_of(*ids: str, **facts: object) -> list[PrintedScan]:
    """Return a scan of four pixels for each id, in this order. The id's second character is the print."""
    scans = [blank_scan(number, 2, **facts) for number in range(len(ids))]
    return [
        replace(scan, id=one, print_id=one[1:2] or one, groups={})
        for scan, one in zip(scans, ids, strict=True)
    ]


def test_all_scans_are_one_group_and_it_comes_first() -> None:
    found = groupings(scans_of("F11", "F12", "F21", "F22"))
    assert next(iter(found)) == ALL
    assert set(found[ALL]) == {""}


def test_every_label_is_that_of_the_scan_alone() -> None:
    """Check that the rule finds the same group for a scan on its own, so that it can be used for new
    scans.
    """
    scans = scans_of("F11", "F12", "F21", "F22", "F31", "F32")
    found = groupings(scans)
    assert len(found) > 3
    for by, labels in found.items():
        assert labels == tuple(label_of(scan, by) for scan in scans)


def test_characters_of_the_ids_stand_for_groups_unless_the_card_has_them() -> None:
    scans = scans_of("F11", "F12", "F21", "F22")
    # The second character gives the same groups as the print. The first is the same for all scans.
    assert list(groupings(scans, by_order=False)) == [ALL, "print", "character 3"]
    stated = [replace(scan, groups={"field": scan.id[2]}) for scan in scans]
    assert list(groupings(stated, by_order=False)) == [ALL, "field", "print"]
    assert groupings(stated)["field"] == ("1", "2", "1", "2")


def test_ids_of_different_lengths_give_no_groups() -> None:
    assert list(groupings(scans_of("F1", "F1x", "F2", "F2x"), by_order=False)) == [ALL, "print"]


@pytest.mark.parametrize(
    ("tips", "counts"),
    [((1, 1, 2, 2), True), ((1, 1, 1, 2), True), ((1, 1, 2, 3), False), ((1, 1, 1, 1), False)],
)
def test_half_of_the_groups_need_two_scans(tips: tuple[float, ...], counts: bool) -> None:
    scans = [replace(blank_scan(0, 2), id=f"s{i}", print_id="1", tip=tip) for i, tip in enumerate(tips)]
    assert ("tip" in groupings(scans)) is counts


def test_direction_and_turn_are_groups_and_what_is_not_stated_has_no_label() -> None:
    scans = scans_of("F11", "F12", "F13", "F14", "F15", "F16")
    turned = [replace(s, turned_deg=deg) for s, deg in zip(scans, (0, 0, 90, 90, None, None), strict=True)]
    assert groupings(turned)["turned_deg"] == ("0", "0", "90", "90", "", "")


def test_a_change_may_come_where_a_print_begins() -> None:
    scans = scans_of("F11", "F12", "F21", "F22", "F31", "F32")
    orders = {by: labels for by, labels in groupings(scans).items() if by.startswith("order")}
    before = {by: labels.count("before") for by, labels in orders.items()}
    assert before == {"order 1-2": 2, "order 3-4": 4}


def test_a_scan_of_a_left_out_print_at_the_place_of_a_change_has_no_label() -> None:
    """Check scans of a held-out print that lies between the two sides of a change. Such a print has no
    label.
    """
    scans = scans_of("F11", "F12", "F21", "F22", "F31", "F32", "F41", "F42")
    by, _ = (by for by in groupings([*scans[:2], *scans[4:]]) if by.startswith("order"))
    assert by == "order 1-4"
    assert [label_of(scan, by) for scan in scans] == ["before"] * 2 + [""] * 2 + ["from there on"] * 4


def test_without_prints_a_change_may_come_anywhere_with_two_scans_on_each_side() -> None:
    scans = [
        replace(scan, print_id=str(i)) for i, scan in enumerate(scans_of("a1", "b2", "c3", "d4", "e5", "f6"))
    ]
    orders = [labels for by, labels in groupings(scans).items() if by.startswith("order")]
    assert [labels.count("before") for labels in orders] == [2, 3, 4]


def test_scans_of_equal_order_are_not_grouped_by_order() -> None:
    scans = [replace(scan, order=0) for scan in scans_of("F11", "F12", "F21", "F22")]
    assert not [by for by in groupings(scans) if by.startswith("order")]


@pytest.mark.parametrize("name", ["order", "character", "tip", "direction", "field"])
def test_a_group_of_the_card_may_have_any_name(name: str) -> None:
    labels = ("1", "1", "2", "2")
    scans = [
        replace(s, groups={name: own}) for s, own in zip(scans_of("a", "b", "c", "d"), labels, strict=True)
    ]
    assert groupings([replace(s, print_id="1") for s in scans])[name] == labels
    # A scan without the group has no label, even if the group's name also has another meaning.
    assert label_of(replace(scans[0], groups={}), name) == ""


@pytest.mark.parametrize(
    ("card", "groups"),
    [
        ({"ids": {"print": r"P(?P<print>\d)F(?P<field>\d)"}}, {"field": "0"}),
        ({"ids": {"print": r"P(?P<print>\d)F(?P<field>\d)(?P<day>[ab]|)"}}, {"field": "0", "day": ""}),
        ({"ids": {"print": r"P(?P<print>\d)F\d"}}, {}),
        ({"ids": {"print": r"X(?P<print>\d)(?P<field>\d)"}}, {}),
        # A pattern with nested repetitions could run forever. A foreign store may have an invalid pattern.
        ({"ids": {"print": r"P(?P<print>\d+)F(?P<field>\d+)"}}, {}),
        ({"ids": {"print": r"P(?P<print>\dF"}}, {}),
        ({"ids": {"print": None}}, {}),
        ({"ids": None}, {}),
        ({}, {}),
    ],
)
def test_a_store_takes_groups_from_the_pattern_of_its_card(
    tmp_path: Path, card: dict[str, object], groups: dict[str, str]
) -> None:
    store = open_store(write_store(tmp_path / "made.zarr", make_scans(2, 48)))
    vars(store)["manifest"] = {"card": card}
    assert store.scan("P0F0").groups == groups
