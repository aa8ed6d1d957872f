"""Check that a build names mixed-up layouts, files and doses, and does not warn about a correct set."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter

from litho_data.making import right_layout
from litho_data.making.build import build_dataset
from litho_data.making.right_layout import doubts, prints_of
from litho_data.register.topography import pearson
from litho_data.store import open_store
from tests.litho_data.campaigns import MARGIN_PX, height_of, layout_of, write_campaign

SHAPE = (112, 112)


@pytest.fixture(autouse=True)
def _without_report(without_report: None) -> None:
    """Look at stores and warnings only."""


def built(card: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Build a store. Return two dicts by scan: the warnings, and the reasons why scans were refused."""
    result = build_dataset(card, card.parent / "prints.zarr")
    quality = open_store(card.parent / "prints.zarr").quality
    warnings = dict(zip(quality["scan"], quality["warning"], strict=True))
    return warnings, result.skipped


def doubted(warnings: dict[str, str]) -> set[str]:
    said = ("layout of", "unlike the other", "mirror image", "height per level")
    return {name for name, text in warnings.items() if any(word in text for word in said)}


DOSES = {0.8: 0.85, 0.9: 0.93, 1.0: 1.0, 1.1: 1.06}


def doses(layouts: int, seed: int) -> dict[str, dict[str, Any]]:
    """Return scans P<dose><layout> of every layout at every dose. Their heights are scaled by the gain of the
    dose.
    """
    prints = {}
    for block, (dose, gain) in enumerate(DOSES.items(), start=1):
        for field in range(1, layouts + 1):
            level = layout_of(10 * seed + field, SHAPE)
            whole = gain * height_of(level, 100 * seed + 10 * block + field)
            height_um = whole[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
            arrays = {"mask_level": level, "height_um": height_um.astype(np.float32)}
            prints[f"P{block}{field}"] = {"dose": dose, **arrays}
    return prints


def doubts_of(prints: dict[str, dict[str, Any]]) -> dict[str, str]:
    records = [record_of(name, one) for name, one in prints.items()]
    return doubts(prints_of(records, lambda name: prints[name]))


def record_of(name: str, one: dict[str, Any]) -> dict[str, Any]:
    quality = {"dihedral": "identity"}
    return {"id": name, "print": name[1], "columns": {"dose": one["dose"]}, "quality": quality}


def swap_heights(prints: dict[str, dict[str, Any]], one: str, other: str) -> None:
    first, second = prints[one], prints[other]
    first["height_um"], second["height_um"] = second["height_um"], first["height_um"]


def swap(folder: Path, one: str, other: str) -> None:
    paths = [folder / "scans" / f"{name}.txt" for name in (one, other)]
    texts = [path.read_bytes() for path in paths]
    for path, text in zip(paths, reversed(texts), strict=True):
        path.write_bytes(text)


@pytest.mark.parametrize(
    ("mode", "rim", "alone"), [("nearest", 0, False), ("constant", 0, True), ("constant", 2, False)]
)
def test_the_outermost_pixels_show_whether_a_field_stands_alone(mode: str, rim: int, alone: bool) -> None:
    prints = doses(3, 0)
    for one in prints.values():
        # Beyond the layout, either its outermost levels continue or the substrate begins. If the stored field
        # has a rim, it includes this edge.
        level = np.pad(one["mask_level"].astype(float), 20, mode="edge" if mode == "nearest" else "constant")
        height_um = (
            0.1 * gaussian_filter(level, 2.5)[20 - rim : rim - 20 or None, 20 - rim : rim - 20 or None]
        )
        one |= {"mask_level": np.pad(one["mask_level"], rim), "height_um": height_um.astype(np.float32)}
    found = prints_of([record_of(name, one) for name, one in prints.items()], lambda name: prints[name])
    assert {one.edge_times > 3 for one in found} == {alone}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("layouts", [1, 3])
def test_doses_that_were_mixed_up_are_named(layouts: int, seed: int) -> None:
    assert doubts_of(doses(layouts, seed)) == {}
    prints = doses(layouts, seed)
    for field in range(1, layouts + 1):
        swap_heights(prints, f"P2{field}", f"P3{field}")
    said = doubts_of(prints)
    assert set(said) == {f"P{block}{field}" for block in (2, 3) for field in range(1, layouts + 1)}
    assert "are these two swapped" in said["P21"]
    if layouts == 3:
        prints = doses(layouts, seed)
        swap_heights(prints, "P11", "P31")
        said = doubts_of(prints)
        assert set(said) == {"P11", "P31"}
        assert "+" in said["P11"]
        assert "agrees with 0.8" in said["P31"]


@pytest.mark.parametrize("left_out", [(), (0.8,)])
def test_doses_in_the_wrong_order_throughout_are_named(left_out: tuple[float, ...]) -> None:
    prints = {name: one for name, one in doses(1, 0).items() if one["dose"] not in left_out}
    right = [one["dose"] for one in prints.values()]
    for one, dose in zip(prints.values(), reversed(right), strict=True):
        one["dose"] = dose
    said = doubts_of(prints)
    # If three doses are reversed, the middle one is right.
    assert set(said) == {name for name, one in prints.items() if len(right) == 4 or one["dose"] != 1.0}
    assert said[min(prints)] == said[max(prints)]


@pytest.mark.parametrize(("exposure", "expected"), [(0.5, 2), (6.0, 0)])
def test_in_a_saturated_print_more_dose_may_lower_its_slope(exposure: float, expected: int) -> None:
    """Check heights of 1 - exp(-exposure · dose · level), which saturate at high exposures.

    The slope is that of the height over the level. At an exposure of 0.5, the slope grows with the dose. At
    an exposure of 6, the slope falls with the dose, although the order of the doses is right.
    """
    prints = doses(1, 0)
    for name, dose in zip(prints, DOSES, strict=True):
        level = prints[name]["mask_level"]
        height_um = 1 - np.exp(-exposure * dose * gaussian_filter(level.astype(float), 2) / 12)
        prints[name]["height_um"] = height_um.astype(np.float32)
    gains = [np.polyfit(one["mask_level"].ravel(), one["height_um"].ravel(), 1)[0] for one in prints.values()]
    assert np.all(np.diff(gains) > 0) == (expected > 0)
    assert doubts_of(prints) == {}
    swap_heights(prints, "P11", "P41")
    assert len(doubts_of(prints)) == expected


def test_a_mirrored_layout_is_named(tmp_path: Path) -> None:
    card = write_campaign(tmp_path, count=2)
    path = tmp_path / "layouts" / "P12.tif"
    tifffile.imwrite(path, np.ascontiguousarray(tifffile.imread(path)[:, ::-1]))
    warnings, skipped = built(card)
    assert not skipped
    assert doubted(warnings) == {"P12"}
    assert "mirror image" in warnings["P12"]


def test_turned_prints_do_not_say_how_upright_scans_lie() -> None:
    one = {**doses(1, 0)["P11"], "dose": None}
    ways = {"A0": ("identity", 0.0), "A90": ("rotate-90", 90.0), "B90": ("rotate-90", 90.0)}
    records = [
        {**record_of(name, one), "columns": {"turned_deg": deg}, "quality": {"dihedral": dihedral}}
        for name, (dihedral, deg) in ways.items()
    ]
    assert doubts(prints_of(records, lambda _: one)) == {}
    records += [{**records[0], "id": name} for name in ("B0", "C0")]
    records[1]["columns"]["turned_deg"] = 0.0
    assert [*doubts(prints_of(records, lambda _: one))] == ["A90"]


def test_scans_under_wrong_ids_are_named_with_the_right_one(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    card = write_campaign(tmp_path, count=4)
    # One layout is printed twice. Its two ids must not be reported as mixed up.
    for file in ("layouts/{}.tif", "scans/{}.txt"):
        shutil.copy(tmp_path / file.format("P11"), tmp_path / file.format("P22"))
    swap(tmp_path, "P11", "P21")
    warnings, skipped = built(card)
    assert set(skipped) == {"P11", "P21"}
    assert skipped["P11"].endswith("it shows the layout of P21")
    assert skipped["P21"].endswith("it shows the layout of P11")
    assert "check P11: it shows the layout of P21" in capsys.readouterr().err
    assert not doubted(warnings)


def test_a_scan_of_a_similar_layout_is_named(tmp_path: Path) -> None:
    """Check a scan of another version of a layout, which registers well but differs in details."""
    card = write_campaign(tmp_path, count=2)
    first = layout_of(0, SHAPE)
    change = gaussian_filter(np.random.default_rng(5).standard_normal(SHAPE), 3)
    second = np.clip(first + np.round(1.2 * change / change.std()), 0, 12).astype(np.uint8)
    tifffile.imwrite(tmp_path / "layouts" / "P12.tif", second)
    shutil.copy(tmp_path / "scans" / "P11.txt", tmp_path / "scans" / "P12.txt")
    warnings, _ = built(card)
    assert doubted(warnings) == {"P12"}
    assert "fit the layout of P11 better" in warnings["P12"]


def test_correlations_use_measured_pixels_only() -> None:
    rng = np.random.default_rng(3)
    layouts = rng.normal(size=(5, 400))
    height = layouts[2] + rng.normal(size=400)
    height[::3] = np.nan
    seen = np.isfinite(height)
    alone = [pearson(height[seen], layout[seen]) for layout in layouts]
    np.testing.assert_allclose(right_layout._correlations(height, layouts), alone, rtol=0, atol=1e-12)
    assert not right_layout._correlations(np.full(400, 0.5), layouts).any()
