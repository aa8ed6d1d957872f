"""Check that edges in micrographs are found to a fraction of a pixel despite rims, charging and dirt."""

from __future__ import annotations

import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr
from scipy.ndimage import gaussian_filter

from litho_data import build_dataset, open_store
from litho_data.cards.card import check_card
from litho_data.cards.listing import list_fields
from litho_data.foundation.errors import InputError
from litho_data.making.contour import coverage, edge_shift_px, find_edges, foreign, with_moved_edges
from litho_data.making.jobs import field_jobs
from litho_data.making.operations import OPERATIONS, no_recipe
from litho_data.provenance.verify import verify

RADIUS_PX = 60.0
CARD = """
name = "films"
[layout]
files = "layout/{id}.png"
pitch_um = 0.004
average_px = 4
levels = 17
level_height_um = 0.01
[scan]
files = "sem/{id}.png"
instrument = "sem"
size_um = [0.48, 0.56]
[write]
surround = "unknown"
"""


def _from_centre(shape: tuple[int, int]) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    return RADIUS_PX - np.hypot(y - (shape[0] - 1) / 2, x - (shape[1] - 1) / 2)


def _micrograph(distance_px: np.ndarray, charging: float = 0.2) -> np.ndarray:
    """Return a micrograph of a film with flanks one pixel wide, a bright rim, charging along x, and noise."""
    film = 1 / (1 + np.exp(-distance_px / 0.5))
    grey = 70 + film * (70 + 60 * np.exp(-np.maximum(distance_px, 0) / 12))
    grey *= 1 + charging * np.linspace(-1, 1, distance_px.shape[1])
    noise = np.random.default_rng(1).normal(0, 3, distance_px.shape)
    return np.clip(grey + noise, 0, 255).astype(np.uint8)


def test_rim_and_charging_do_not_move_an_edge() -> None:
    distance = _from_centre((200, 260))
    found = find_edges(_micrograph(distance)).distance_px
    near = np.abs(distance) < 4
    off = (found - distance)[near]
    # Smoothed noise of 3 displaces an edge by 0.03 px, as the flank rises by 110 in 2 px. A rim 1.6 times as
    # bright as the film displaces it by 0.3 px.
    assert off.std() < 0.06
    assert abs(off.mean()) < 0.3


def test_coverage_keeps_the_area_of_a_disc_at_any_pitch() -> None:
    distance = _from_centre((201, 201))
    for every in (1, 2, 4):
        share = coverage(distance[::every, ::every], every)
        # The coverage of a pixel that the edge crosses at an angle is wrong by at most an eighth, with
        # varying sign around the disc.
        assert share.sum() * every**2 == pytest.approx(np.pi * RADIUS_PX**2, rel=2e-3)


def test_film_far_from_the_layout_is_dirt_and_a_lost_island_belongs_to_the_print() -> None:
    layout = np.zeros((80, 80))
    layout[:, 40:] = 1
    layout[10:24, 10:24] = 1
    seen = layout.copy()
    seen[10:24, 10:24] = 0
    seen[50:56, 15:21] = 1
    dirt = foreign(seen, layout, 5)
    # These pixels and their surroundings are farther than 5 px from all edges of the layout.
    assert dirt[52, 16:20].all()
    assert dirt[45:61, 17].all()
    assert not dirt[44, 17]
    assert not dirt[:44].any()


def test_the_edges_of_a_film_tell_how_far_they_have_moved() -> None:
    y, x = np.mgrid[-50:50, -60:60]
    radius = np.hypot(y, x)
    disc = (17 * (radius < 30)).astype(np.uint8)
    # Whole pixels make the edge of the disc uncertain by half a pixel.
    assert edge_shift_px(disc, 33.5 - radius) == pytest.approx(3.5, abs=0.3)
    assert with_moved_edges(disc, 3.5).mean() / 17 == pytest.approx(np.pi * 33.5**2 / disc.size, rel=0.02)
    # Half of the film is lost, which moves few edges.
    lost = np.minimum(30 - radius, 15 - y)
    assert edge_shift_px(disc, lost) == edge_shift_px(disc, 29.5 - radius) == 0
    assert edge_shift_px(np.full_like(disc, 17), 30 - radius) == 0


def test_edges_that_have_moved_far_are_not_dirt() -> None:
    y, x = np.mgrid[-50:50, -60:60]
    radius = np.hypot(y, x)
    disc = (17 * (radius < 30)).astype(np.uint8)
    moved = np.maximum(38 - radius, 3 - np.hypot(y + 40, x + 50))
    params = {
        "scan_pitch_um": [1.0, 1.0],
        "layout_pitch_um": 1.0,
        "layout_shape": disc.shape,
        "edge_px": 0,
        "film_um": 2.0,
        "full_level": 17,
        "edge_sigma_um": 0.1,
        "dirt_px": 5,
    }
    arrays = {"mask_level": disc, "edge_distance_um": moved, "scan_to_layout": np.eye(3)}
    made, facts = OPERATIONS["cover"].function(params, [], arrays)
    assert made["valid"][np.abs(radius - 34) < 8].all()
    # Only the spot far outside the disc, widened by 5 px, is dirt.
    spot = np.hypot(y + 40, x + 50)
    assert not made["valid"][spot < 3].any()
    assert facts["dirt_share"] < (spot < 12).mean()


def test_small_specks_are_ignored() -> None:
    distance = _from_centre((200, 260))
    grey = _micrograph(distance, 0)
    grey[10:14, 10:14] = 200
    edges = find_edges(grey)
    assert edges.specks[10:14, 10:14].all()
    assert (edges.distance_px[:20, :20] < 0).all()


def test_a_picture_without_edges_is_refused() -> None:
    with pytest.raises(InputError, match="no edge"):
        find_edges(np.full((64, 64), 90, np.uint8))


@pytest.mark.parametrize("size_um", [[0.48, 0.28], [0.56, 0.48]])
def test_a_micrograph_with_oblong_pixels_is_refused(size_um: list[float], tmp_path: Path) -> None:
    """Check that distances from edges have the same unit along both axes."""
    cv2.imwrite(str(tmp_path / "F1.png"), np.zeros((48, 56), np.uint8))
    read, files = OPERATIONS["read-micrograph"], {"F1.png": tmp_path / "F1.png"}
    assert read.run({"size_um": [0.48, 0.5595]}, files, {})[2]["pitch_um"] == pytest.approx(
        [0.01] * 2, rel=0.01
    )
    with pytest.raises(InputError, match=r"pixels of .* × .* µm \(y × x\), wanted square pixels"):
        read.run({"size_um": size_um}, files, {})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("size_um = [0.48, 0.56]|", "size_um"),
        ('size_um = [0.48, 0.56]|size_um = [0.48, 0.56]\nunit = "nm"', "a micrograph has no heights"),
        ("[write]|[process]\ntip = 0.1\n[write]", "no levelling, tip"),
        ("levels = 17|levels = 16", "levels = 17"),
        ('"sem"\n|"tem"\n', "instrument"),
        ('"sem"\nsize_um = [0.48, 0.56]|"confocal"\n[process]\ntip = 0.1', "no tip, because a confocal"),
    ],
)
def test_a_card_that_contradicts_its_instrument_is_refused(change: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        check_card(tomllib.loads(CARD.replace(*change.split("|"))), "card")


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a film from a layout with 1 nm pixels and a micrograph with 2 nm pixels and rounded corners."""
    folder = tmp_path_factory.mktemp("films")
    (folder / "card.toml").write_text(CARD, encoding="utf-8")
    for name in ("layout", "sem"):
        (folder / name).mkdir()
    layout = gaussian_filter(np.random.default_rng(1).normal(size=(480, 560)), 20) > 0
    printed = gaussian_filter(layout.astype(float), 10) - 0.5
    distance_px = printed / np.maximum(np.hypot(*np.gradient(printed)), 1e-3) / 2
    grey = _micrograph(distance_px.reshape(240, 2, 280, 2).mean(axis=(1, 3)))
    cv2.imwrite(str(folder / "layout/F1.png"), layout.astype(np.uint8) * 255)
    cv2.imwrite(str(folder / "sem/F1.png"), grey)
    build_dataset(folder / "card.toml", folder / "films.zarr")
    return folder


def test_a_film_is_built_into_a_store_that_says_what_its_heights_are(films: Path) -> None:
    store = open_store(films / "films.zarr")
    assert store.instrument == "sem"
    scan = store.scan("F1")
    assert scan.seen_by == "sem"
    inner = scan.height_um[scan.valid]
    assert inner.min() >= 0
    assert inner.max() == pytest.approx(0.16)
    # After registration the film agrees with its layout, except for a rim of a few pixels.
    wrong = (scan.height_um > 0.08) != (scan.layout_um > 0.08)
    assert wrong[scan.valid].mean() < 0.05
    assert np.isfinite(scan.height_sigma_um[scan.valid]).all()
    assert store.quality["edge_sigma_nm"].between(0.01, 0.5).all()


def test_a_film_store_is_verified_and_its_instrument_is_part_of_it(films: Path, tmp_path: Path) -> None:
    assert not verify(films / "films.zarr").findings
    copy = tmp_path / "films.zarr"
    shutil.copytree(films / "films.zarr", copy)
    zarr.open_group(copy, mode="r+", use_consolidated=False).attrs["instrument"] = "afm"
    assert open_store(copy).sha256 != open_store(films / "films.zarr").sha256


def test_film_is_whole_and_ground_bare_however_fine_the_micrograph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check the heights of a stripe if a layout pixel is 20 pixels of the micrograph."""
    card = CARD.replace("average_px = 4\nlevels = 17", "levels = 2").replace(".png", ".tif", 1)
    card = card.replace("[0.48, 0.56]", "[0.048, 0.08]").replace("unknown", "substrate")
    (tmp_path / "card.toml").write_text(card, encoding="utf-8")
    for name in ("layout", "sem"):
        (tmp_path / name).mkdir()
    layout = np.zeros((12, 20), np.uint8)
    layout[:, 6:12] = 1
    across_px = np.broadcast_to(60 - np.abs(np.arange(400) - 179.5), (240, 400))
    cv2.imwrite(str(tmp_path / "layout/F1.tif"), layout)
    cv2.imwrite(str(tmp_path / "sem/F1.png"), _micrograph(across_px))
    # So small a pattern cannot be registered. Its place is known: a rim of two layout pixels is added to it.
    in_place = np.array([[1, 0, 0.008], [0, 1, 0.008], [0, 0, 1]])
    placed = replace(OPERATIONS["register"], function=lambda *_: ({"scan_to_layout": in_place}, {}))
    monkeypatch.setitem(OPERATIONS, "register", placed)
    (job,) = field_jobs(list_fields(tmp_path / "card.toml"), no_recipe())
    height_um = job.run().arrays["height_um"][2:-2, 2:-2]
    np.testing.assert_allclose(height_um, 0.01 * layout, atol=0.0002)


@pytest.mark.measured
def test_the_card_of_the_silicon_patterns_finds_all_of_them() -> None:
    card = Path(__file__).parents[2] / "datasets" / "prefab-soi.toml"
    assert len(list_fields(card).fields) == 14
