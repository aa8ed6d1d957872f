"""Check that a build keeps good scans, names bad ones, is repeatable, and never leaves half a store."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from litho_data.cards.listing import list_fields
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.making.build import _relative, build_dataset
from litho_data.making.jobs import field_jobs, finish
from litho_data.making.operations import load_recipe, no_recipe
from litho_data.making.result import BuildResult, report_folder
from litho_data.provenance.history import raw_folder, read_steps, replay
from litho_data.provenance.verify import verify
from litho_data.readers.gsf import gsf_bytes
from litho_data.store import open_store
from litho_data.store.access import values_of
from litho_data.store.partial import PartialStore, Piece, partial_store
from tests.litho_data.campaigns import (
    LEVEL_HEIGHT_UM,
    MARGIN_PX,
    NOISE_UM,
    height_of,
    layout_of,
    write_campaign,
    write_scan,
)

GAP = 40, 60


def test_heights_come_back_on_the_layout(campaign: Path) -> None:
    store = open_store(campaign / "prints.zarr")
    assert store.ids == ["P11", "P12", "P21"]
    assert (store.pitch_um, store.level_height_um, store.levels) == (0.1, LEVEL_HEIGHT_UM, 13)
    for index, scan in enumerate(store.scans()):
        layout = layout_of(index)
        np.testing.assert_array_equal(scan.mask_level, layout)
        truth = height_of(layout, index)[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
        assert scan.valid.all()
        # The scan is shifted from the layout's grid by whole pixels. Resampling keeps 0.76 of the noise
        # variance, so the difference of the two noises has less than twice the sd of one. A registration
        # error of 0.02 px adds about 2 nm.
        assert np.std(scan.height_um - truth) < 2 * NOISE_UM
        assert scan.print_id == scan.id[1]
        assert scan.order == index
        assert scan.layout_um[5, 7] == pytest.approx(layout[5, 7] * LEVEL_HEIGHT_UM)
        corner = scan.scan_to_layout @ [MARGIN_PX * 0.1, MARGIN_PX * 0.1, 1]
        # The held-out registration error of these scans is below 0.05 px, or 0.005 µm. At the corner, three
        # times that is allowed.
        np.testing.assert_allclose(corner, [0, 0, 1], atol=0.015)


def test_raw_heights_are_kept_as_read(campaign: Path) -> None:
    store = open_store(campaign / "prints.zarr")
    text = np.loadtxt(campaign / "scans" / "P12.txt") * 1e6
    # float32 numbers have 24 significant bits.
    np.testing.assert_allclose(store.scan_frame("P12", "raw_height_um"), text, rtol=2**-24)
    np.testing.assert_array_equal(store.scan_frame("P12", "removed_um"), 0)


def test_building_again_with_other_workers_gives_the_same(own_campaign: Path, without_report: None) -> None:
    first = open_store(own_campaign / "prints.zarr")
    hashes = first.sha256, first.root.attrs["manifest_sha256"]
    result = build_dataset(own_campaign / "card.toml", own_campaign / "prints.zarr", workers=2)
    again = open_store(own_campaign / "prints.zarr")
    assert result.reused == 0
    assert (again.sha256, again.root.attrs["manifest_sha256"]) == hashes
    assert again.computed_sha256() == again.sha256
    assert not list(own_campaign.glob(".*"))


def test_an_address_without_dask_scheduler_is_bad_input(campaign: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="Dask scheduler"):
        build_dataset(campaign / "card.toml", tmp_path / "prints.zarr", dask="nonsense://")
    assert not list(tmp_path.iterdir())


def test_bad_scans_are_skipped_with_their_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    card = write_campaign(tmp_path, count=3)
    good = (tmp_path / "scans" / "P11.txt").read_text()
    bad = {
        "P31": good[: len(good) // 2],  # the text ends within a row
        "P32": "\n".join(["nan\t" * 127 + "nan"] * 128),
        "P33": "\n".join(good.splitlines()[:125]),  # readable, but rows are missing
        "P34": "\x00\x01 no heights",
        "P35": good,  # its layout has too many levels
        "P37": "\n".join(good.splitlines()[:64]),  # with half of the rows, it cannot be registered
    }
    for scan_id, text in bad.items():
        shutil.copy(tmp_path / "layouts" / "P11.tif", tmp_path / "layouts" / f"{scan_id}.tif")
        (tmp_path / "scans" / f"{scan_id}.txt").write_text(text)
    tifffile.imwrite(tmp_path / "layouts" / "P35.tif", layout_of(0) + 4)
    write_scan(tmp_path / "scans" / "P36.txt", height_of(layout_of(6), 6))  # it has no layout

    result = build_dataset(card, tmp_path / "prints.zarr")
    skipped = result.skipped
    assert result.n_scans == 3
    assert set(skipped) == set(bad)
    assert "finite" in skipped["P32"]
    assert "rows or columns are missing" in skipped["P33"]
    assert "highest level" in skipped["P35"]
    assert skipped["P37"].endswith("the pixels are 0.2 × 0.1 µm (y × x): are rows missing?")
    assert [*result.unpaired] == ["P36"]
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("skipped ")]
    assert sorted(line.split()[1].rstrip(":") for line in lines) == sorted(bad)
    store = open_store(tmp_path / "prints.zarr")
    assert store.ids == ["P11", "P12", "P21"]
    status = {row["path"]: (row["status"], bool(row["reason"])) for row in store.manifest["files"]}
    assert status["scans/P31.txt"] == ("skipped", True)
    assert status["scans/P36.txt"] == ("unpaired", True)
    assert status["scans/P11.txt"] == ("ok", False)
    assert BuildResult.read(report_folder(tmp_path / "prints.zarr")) == result

    for scan_id in ("P11", "P12", "P21", "P33", "P37"):
        (tmp_path / "scans" / f"{scan_id}.txt").unlink()
    with pytest.raises(InputError, match="10 ids cannot be used"):
        build_dataset(card, tmp_path / "strict.zarr", strict=True)
    assert not [path for path in tmp_path.iterdir() if "strict" in path.name]


def test_scans_that_state_their_own_size_may_have_pixels_of_another_shape(
    tmp_path: Path, without_report: None
) -> None:
    card = write_campaign(tmp_path, count=5)
    card.write_text(
        card.read_text().replace("{id}.txt", "{id}.*").replace('format = "text-matrix"', "")
        + 'table = "table.csv"\n'
    )
    # Half as many lines over the same field: they are missing unless the file or the table states the size.
    for scan_id in ("P12", "P21", "P22", "P31"):
        text = tmp_path / "scans" / f"{scan_id}.txt"
        lines = np.loadtxt(text).reshape(64, 2, 128).mean(axis=1)
        if scan_id == "P12":
            text.unlink()
            text.with_suffix(".gsf").write_bytes(gsf_bytes(1e6 * lines, (0.2, 0.1)))
        else:
            np.savetxt(text, lines, delimiter="\t")
    (tmp_path / "table.csv").write_text("id,use,size_um\nP21,,12.8\nP22,flat,\n")
    for part in ("layouts/{}.tif", "scans/{}.txt"):  # a whole scan more, so that P31 differs from most
        shutil.copy(tmp_path / part.format("P11"), tmp_path / part.format("P13"))

    result = build_dataset(card, tmp_path / "prints.zarr")
    assert (result.n_scans, result.n_references) == (4, 1)
    assert [*result.skipped] == ["P31"]
    assert "rows or columns are missing" in result.skipped["P31"]


def test_a_unit_in_the_table_leaves_the_size_in_the_card_a_default(tmp_path: Path) -> None:
    card = write_campaign(tmp_path, count=1)
    text = card.read_text().replace("{id}.txt", "{id}.gsf").replace('format = "text-matrix"', "")
    card.write_text(text + 'table = "table.csv"\n')
    (tmp_path / "scans" / "P11.gsf").write_bytes(gsf_bytes(np.eye(64), (0.2, 0.1)))
    for row in ("id,unit\nP11,m\n", "id,size_um\nP11,12.8 x 6.4\n", "id\nP11\n"):
        (tmp_path / "table.csv").write_text(row)
        (job,) = field_jobs(list_fields(card), no_recipe())
        assert job.begin().pitch_um == [0.2, 0.1]
    (tmp_path / "table.csv").write_text("id,size_um\nP11,12.8\n")
    with pytest.raises(InputError, match="size_um, got"):
        field_jobs(list_fields(card), no_recipe())[0].begin()


def test_the_manifest_does_not_depend_on_where_the_raw_files_lie(
    campaign: Path, tmp_path: Path, without_report: None, capsys: pytest.CaptureFixture[str]
) -> None:
    hashes = set()
    for name in ("here", "there"):
        folder = tmp_path / name
        for part in ("layouts", "scans"):
            shutil.copytree(campaign / part, folder / part)
        shutil.copy(campaign / "card.toml", folder)
        (folder / "scans" / "P21.txt").write_text("1\t2\n3")
        (folder / "scans" / "P12.txt").unlink()
        build_dataset(folder / "card.toml", folder / "prints.zarr")
        store = open_store(folder / "prints.zarr")
        hashes.add(store.root.attrs["manifest_sha256"])
        assert "reason: P21: scans/P21.txt: line" in [
            f"reason: {row['scan']}: {row['reason'][:19]}" for row in store.manifest["files"]
        ]
    assert len(hashes) == 1
    assert str(tmp_path) not in capsys.readouterr().err


def test_the_raw_files_are_found_through_links(own_campaign: Path) -> None:
    deep, link = own_campaign / "a" / "b", own_campaign / "link"
    deep.mkdir(parents=True)
    link.symlink_to(deep)
    for start in (own_campaign, deep, link):
        assert (start / _relative(own_campaign, start)).samefile(own_campaign)
        assert _relative(start, own_campaign) == _relative(start.resolve(), own_campaign)
    (link / "latest.zarr").symlink_to(own_campaign / "prints.zarr")
    assert raw_folder(open_store(link / "latest.zarr")) == own_campaign.resolve()


@pytest.fixture(scope="module")
def tilted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of one scan with a tilt of 0.3 µm along x and a gap, levelled with its layout."""
    folder = tmp_path_factory.mktemp("tilted")
    recipe = '[[step]]\nop = "layout-aware"\nblur_px = 1.0\n'
    (folder / "recipe.toml").write_text(recipe, encoding="utf-8")
    card = write_campaign(folder, count=1, more='[process]\nlevel = "recipe.toml"')
    height = height_of(layout_of(0), 0) + 0.3 * (np.arange(128) / 128 - 0.5)
    height[GAP[0] + MARGIN_PX, GAP[1] + MARGIN_PX] = np.nan
    write_scan(folder / "scans" / "P11.txt", height)
    build_dataset(card, folder / "prints.zarr")
    return folder / "prints.zarr"


def test_isolated_gaps_are_not_valid(tilted: Path) -> None:
    scan = open_store(tilted).scan("P11")
    assert not scan.valid[GAP]
    # Only the gap and the at most 6 x 6 pixels whose interpolation uses it are invalid, never the rest of
    # the field.
    assert 0 < (~scan.valid).sum() <= 36
    np.testing.assert_array_equal(np.isnan(scan.height_um), ~scan.valid)


def test_a_build_without_a_good_scan_leaves_nothing(tmp_path: Path) -> None:
    card = write_campaign(tmp_path, count=1)
    (tmp_path / "scans" / "P11.txt").write_text("1\t2\n3")
    before = {path.name for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=r"no scan can be used.*P11"):
        build_dataset(card, tmp_path / "prints.zarr")
    assert {path.name for path in tmp_path.iterdir()} == before


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a campaign with its store: two layouts of different sizes with 3,001 levels, and a
    scan of the substrate.
    """
    folder, levels = tmp_path_factory.mktemp("mixed"), 3001
    card = write_campaign(folder, count=1, shape=(144, 144), more='table = "scans.csv"')
    written = card.read_text(encoding="utf-8").replace("levels = 13", f"levels = {levels}")
    card.write_text(written.replace("level_height_um = 0.1", f"level_height_um = {1.2 / (levels - 1)}"))
    (folder / "scans.csv").write_text("id,use\nP11,dataset\nP12,\nbare,substrate\n", encoding="utf-8")
    small = layout_of(5, (144, 128))
    for scan_id, layout in (("P11", layout_of(0, (144, 144))), ("P12", small)):
        tifffile.imwrite(folder / "layouts" / f"{scan_id}.tif", layout.astype(np.uint16) * 250)
    # All scans must have the same size, so the margin around the smaller field is wider.
    margin = MARGIN_PX + 8
    height = np.pad(height_of(small, 5)[:, MARGIN_PX:-MARGIN_PX], ((0, 0), (margin, margin)), mode="edge")
    write_scan(folder / "scans" / "P12.txt", height)
    write_scan(folder / "scans" / "bare.txt", 0.001 * np.random.default_rng(0).standard_normal((160, 160)))
    result = build_dataset(card, folder / "prints.zarr")
    assert (result.n_scans, result.n_references) == (2, 1)
    return folder


def test_smaller_layouts_are_padded_and_cut_again(mixed: Path) -> None:
    store = open_store(mixed / "prints.zarr")
    np.testing.assert_array_equal(store.scan("P12").mask_level, 250 * layout_of(5, (144, 128)).astype(int))
    assert store.scan("P12").height_um.shape == (144, 128)
    assert not values_of(store.root, "valid")[1, :, 128:].any()
    assert np.isnan(values_of(store.root, "height_um")[1, :, 128:]).all()
    assert verify(mixed / "prints.zarr").findings == ()


def test_levels_beyond_a_byte_come_back(mixed: Path) -> None:
    scan = open_store(mixed / "prints.zarr").scan("P11")
    np.testing.assert_array_equal(scan.mask_level, 250 * layout_of(0, (144, 144)).astype(int))
    assert scan.mask_level.dtype == np.uint16
    assert np.abs((scan.height_um - scan.layout_um)[scan.usable]).mean() < 0.1


def test_references_are_kept_apart_from_the_dataset(mixed: Path) -> None:
    store = open_store(mixed / "prints.zarr")
    assert store.ids == ["P11", "P12"]
    assert store.references() == {"bare": "substrate"}
    # From 160² pixels, the standard deviation of white noise is known to 1 / sqrt(2 · 160²) = 0.4 %.
    assert store.scan_frame("bare", "levelled_height_um").std() == pytest.approx(0.001, rel=0.03)


def test_references_are_levelled_without_their_layouts(tmp_path: Path) -> None:
    """Check that a plane is removed from surfaces of one level, and nothing from steps, by default."""
    card = write_campaign(tmp_path, count=1, more='table = "scans.csv"\n[write]\nsurround = "substrate"')
    card.write_text(card.read_text().replace("levelled = true\n", ""))
    (tmp_path / "scans.csv").write_text("id,use\nP11,\nbare,substrate\neven,flat\nstairs,steps\n")
    ladder, tilt_um = np.tile(np.arange(112) // 14, (112, 1)).astype(np.uint8), np.arange(128) / 400
    tifffile.imwrite(tmp_path / "layouts" / "stairs.tif", ladder)
    tifffile.imwrite(tmp_path / "layouts" / "even.tif", np.full_like(ladder, 6))
    for name, shape in {"bare": 0, "even": 0.6, "stairs": np.pad(0.1 * ladder, MARGIN_PX)}.items():
        write_scan(tmp_path / "scans" / f"{name}.txt", shape + tilt_um + np.zeros((128, 128)))
    jobs = field_jobs(list_fields(card), load_recipe(None))
    made = {job.id: job.run().arrays for job in jobs if job.field.use != "dataset"}
    for name in ("bare", "even"):
        # The file keeps six digits.
        np.testing.assert_allclose(made[name]["levelled_height_um"], 0, atol=1e-5)
    stairs = made["stairs"]
    np.testing.assert_array_equal(stairs["levelled_height_um"], stairs["raw_height_um"])


def test_a_levelling_recipe_is_applied_and_recorded(tmp_path: Path) -> None:
    recipe = '[[step]]\nop = "plane"\n'
    (tmp_path / "recipe.toml").write_text(recipe, encoding="utf-8")
    card = write_campaign(tmp_path, count=1, more='[process]\nlevel = "recipe.toml"')
    height = height_of(layout_of(0), 0)
    tilt_um = 0.3 * (np.arange(128) / 128 - 0.5)
    write_scan(tmp_path / "scans" / "P11.txt", height + tilt_um)
    build_dataset(card, tmp_path / "prints.zarr")
    store = open_store(tmp_path / "prints.zarr")
    removed = store.scan_frame("P11", "removed_um").astype(float)
    raw, levelled = (
        store.scan_frame("P11", f"{name}_height_um").astype(float) for name in ("raw", "levelled")
    )
    np.testing.assert_allclose(levelled + removed, raw, atol=1e-6)  # three float32 roundings at ~1 µm
    slope = np.polyfit(np.arange(128), levelled.mean(axis=0), 1)[0]
    assert abs(slope) < 1e-8  # least squares removes the slope, up to float32 rounding
    assert store.quality["removed_sd_nm"][0] > 50
    assert store.manifest["recipe"]["step"][0]["op"] == "plane"


def test_layout_aware_levelling_locates_the_layout_first(tilted: Path) -> None:
    removed = open_store(tilted).scan_frame("P11", "removed_um").astype(float)
    # The margin has no layout, and the response is fitted as piecewise linear. Together, these may change the
    # fitted tilt by up to 5 %.
    slope_um = np.polyfit(np.arange(128), np.nanmean(removed, axis=0), 1)[0] * 128
    np.testing.assert_allclose(slope_um, 0.3, rtol=0.05)
    steps = [step.op for _, step in read_steps(open_store(tilted))["P11"]]
    assert steps == ["read-layout", "read-scan", "locate", "level", "register", "resample", "uncertainty"]
    assert replay(tilted)["same_hash"].all()


def test_a_full_disk_loses_neither_the_older_store_nor_the_finished_scans(
    own_campaign: Path, monkeypatch: pytest.MonkeyPatch, without_report: None
) -> None:
    out, card = own_campaign / "prints.zarr", own_campaign / "card.toml"
    older = open_store(out).sha256
    card.write_text(card.read_text() + '\n[process]\nregistration = "homography"\n')
    (own_campaign / "scans" / "P21.txt").unlink()
    add, kept = PartialStore.add, []

    def full_after_one(self: PartialStore, piece: Piece) -> None:
        if len(kept) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        kept.append(piece)
        add(self, piece)

    with monkeypatch.context() as disk:
        disk.setattr(PartialStore, "add", full_after_one)
        with pytest.raises(OSError, match="No space left"):
            build_dataset(card, out)
    assert open_store(out).sha256 == open_store(out).computed_sha256() == older
    result = build_dataset(card, out)
    assert result.reused == 1
    assert result.dataset.sha256 == open_store(out).sha256 != older
    assert verify(out).findings == ()


def test_a_damaged_or_outdated_piece_is_made_again(
    campaign: Path, own_campaign: Path, without_report: None
) -> None:
    out = own_campaign / "again.zarr"
    jobs = field_jobs(list_fields(own_campaign / "card.toml"), no_recipe())
    with partial_store(out) as partial:
        partial.open()
        for job in jobs:
            assert not isinstance(finish(job, partial), str)
        damaged = partial.folder / "pieces" / "P11.npz"
        content = bytearray(damaged.read_bytes())
        content[len(content) // 2] ^= 1
        damaged.write_bytes(content)
        # Zarr leaves behind such a file when a write is interrupted.
        (partial.store / "scans" / "zarr.0123.partial").write_text("{")
    text = (own_campaign / "scans" / "P12.txt").read_text()
    (own_campaign / "scans" / "P12.txt").write_text(text.replace("\t", " ", 1))
    result = build_dataset(own_campaign / "card.toml", out)
    assert result.reused == 1
    assert result.dataset.sha256 == open_store(campaign / "prints.zarr").sha256
    assert not list(out.rglob("*.partial"))


def test_a_changed_card_changes_the_key_of_a_piece(campaign: Path) -> None:
    listing = list_fields(campaign / "card.toml")
    job = field_jobs(listing, no_recipe())[0]
    levels = listing.card.layout.model_copy(update={"levels": 14})
    changed = [
        replace(job, card=listing.card.model_copy(update={"layout": levels})),
        replace(job, seed=1),
        replace(job, recipe={"schema": "litho-data/recipe/1", "step": [{"op": "plane"}]}),
        replace(job, field=replace(job.field, order=5)),
    ]
    assert len({one.key() for one in (job, *changed)}) == 5
    assert replace(job).key() == job.key()


def test_the_sidecar_of_an_exported_layout_is_a_raw_file(tmp_path: Path, without_report: None) -> None:
    card = write_campaign(tmp_path, count=1)
    card.write_text(card.read_text().replace("layouts/{id}.tif", "layouts/{id}.*"))
    layout, sidecar = (tmp_path / "layouts" / f"P11.png{end}" for end in ("", ".json"))
    (tmp_path / "layouts" / "P11.tif").unlink()
    cv2.imwrite(str(layout), layout_of(0) + 20)
    says = {"schema": "litho-design/export/2", "file_sha256": file_sha256(layout), "format": "png"}
    says |= {"shape_px": [112, 112], "pitch_um": 0.1, "level_height_um": 0.1, "greys": [*range(20, 33)]}
    keys, steps = set(), set()
    for element in ([0, 112, 0, 100], [0, 112, 0, 112]):
        sidecar.write_text(json.dumps({**says, "marks": {"element_px": element}}))
        (job,) = field_jobs(list_fields(card), no_recipe())
        chain = job.begin()
        assert chain.arrays["mask_level"].shape == (112, element[3])
        keys.add(job.key())
        steps.add(chain.steps[0].id)
    assert len(keys) == len(steps) == 2

    out = tmp_path / "prints.zarr"
    assert build_dataset(card, out, strict=True).unpaired == {}
    paths = [row["path"] for row in open_store(out).manifest["files"]]
    assert paths == ["layouts/P11.png", "layouts/P11.png.json", "scans/P11.txt"]
    assert verify(out).findings == ()
    sidecar.write_text(json.dumps(says))
    assert [one.where for one in verify(out).findings] == ["raw file layouts/P11.png.json"]


def test_another_build_or_a_foreign_folder_is_left_alone(campaign: Path, tmp_path: Path) -> None:
    with partial_store(tmp_path / "busy.zarr"), pytest.raises(InputError, match="another process"):
        build_dataset(campaign / "card.toml", tmp_path / "busy.zarr")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("years of work")
    with pytest.raises(InputError, match="not a dataset store"):
        build_dataset(campaign / "card.toml", tmp_path / "thesis")
    assert (tmp_path / "thesis" / "chapter.txt").read_text() == "years of work"
