"""Check that opening a store tests its contract, and that hashes depend only on values."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import array_sha256, record_sha256
from litho_data.store import open_store
from litho_data.store.access import array_of, values_of


def test_array_hash_depends_on_values_type_shape_unit_and_names() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    known = array_sha256(array, "um", ("y", "x"))
    assert known == array_sha256(np.asfortranarray(array), "um", ("y", "x"))
    assert known == array_sha256(array.astype(">f4"), "um", ("y", "x"))
    others = [
        array_sha256(array.astype(np.float64), "um", ("y", "x")),
        array_sha256(array.reshape(3, 2), "um", ("y", "x")),
        array_sha256(array, "nm", ("y", "x")),
        array_sha256(array, "um", ("x", "y")),
        array_sha256(np.nextafter(array, np.inf), "um", ("y", "x")),
    ]
    assert len({known, *others}) == 6


def test_array_hash_treats_all_nans_alike() -> None:
    quiet = np.array([np.nan, 1.0], dtype=np.float32)
    other = quiet.copy()
    other.view(np.uint32)[0] = 0xFFC01234  # negative, with a payload
    assert np.isnan(other[0])
    assert array_sha256(quiet, "um", ("x",)) == array_sha256(other, "um", ("x",))


def test_record_hash_does_not_depend_on_the_order_of_keys() -> None:
    assert record_sha256({"a": 1, "b": [2.5, None]}) == record_sha256({"b": [2.5, None], "a": 1})
    assert record_sha256({"a": 1}) != record_sha256({"a": 2})


def test_dataset_hash_does_not_depend_on_chunks_or_codecs(own_campaign: Path) -> None:
    path = own_campaign / "prints.zarr"
    known = open_store(path).sha256
    root = zarr.open_group(path, mode="a", use_consolidated=False)
    for name, chunks in (("height_um", (3, 50, 17)), ("mask_level", (2, 64, 64)), ("valid", (1, 112, 112))):
        old = array_of(root, name)
        values, attributes, dims = old[...], dict(old.attrs), old.metadata.dimension_names
        new = root.create_array(name, shape=old.shape, chunks=chunks, dtype=old.dtype, overwrite=True,
                                compressors=None, attributes=attributes, dimension_names=dims)  # fmt: skip
        new[...] = values
    assert open_store(path).computed_sha256() == known
    array_of(root, "height_um")[1, 5, 5] += 1e-4
    assert open_store(path).computed_sha256() != known


def test_opens_with_xarray_without_a_warning(campaign: Path, recwarn: pytest.WarningsRecorder) -> None:
    import xarray

    dataset = xarray.open_zarr(campaign / "prints.zarr")
    assert not [one for one in recwarn if "onsolidated" in str(one.message)]
    assert set(dataset.coords) >= {"scan", "print", "order", "y_um", "x_um"}
    assert dataset["height_um"].dims == ("scan", "y", "x")
    assert dataset["height_um"].attrs["units"] == "um"
    assert dataset["y_um"].values[:2] == pytest.approx([0.05, 0.15])
    assert [str(value) for value in dataset["print"].values] == ["1", "1", "2"]
    assert [dataset[name].attrs["axis"] for name in "yx"] == ["Y", "X"]
    assert dataset["height_um"].attrs["ancillary_variables"] == "valid height_sigma_um"
    assert "units" not in dataset["scan_to_layout"].attrs
    quality = xarray.open_zarr(campaign / "prints.zarr", group="quality")
    assert float(quality["ncc_after"].min()) > 0.9


def test_the_whole_store_opens_as_one_tree(campaign: Path) -> None:
    import xarray

    tree = xarray.open_datatree(campaign / "prints.zarr", engine="zarr")
    assert tree["scans/P11/raw_height_um"].dims == ("scan_y", "scan_x")
    assert tree["scans/P11/raw_height_um"].shape != tree["height_um"].shape[1:]
    assert float(tree["quality/ncc_after"].min()) > 0.9


def test_one_chunk_is_one_scan(campaign: Path) -> None:
    array = array_of(open_store(campaign / "prints.zarr").root, "height_um")
    assert array.chunks == (1, 112, 112)
    # If a shard held several scans, other tools could not copy single scans.
    assert array.shards is None


def test_broken_contracts_are_named(own_campaign: Path, tmp_path: Path) -> None:
    path = own_campaign / "prints.zarr"
    with pytest.raises(InputError, match="wanted P11, P12, P21"):
        open_store(path).scan("P99")
    with pytest.raises(InputError, match="does not exist"):
        open_store(tmp_path / "absent.zarr")
    (tmp_path / "note.txt").write_text("no zip")
    with pytest.raises(InputError, match="cannot open"):
        open_store(tmp_path / "note.txt")
    root = zarr.open_group(path, mode="a", use_consolidated=False)
    for key, value in (("pitch_um", 0), ("pitch_um", "0.1"), ("level_height_um", None), ("levels", 13.5)):
        good = root.attrs[key]
        root.attrs[key] = value
        with pytest.raises(InputError, match=f"attribute {key}"):
            open_store(path)
        root.attrs[key] = good
    shutil.rmtree(path / "valid")
    with pytest.raises(InputError, match="array valid"):
        open_store(path)


def test_a_store_without_quality_and_provenance_can_be_read(own_campaign: Path) -> None:
    path = own_campaign / "prints.zarr"
    known = open_store(path).sha256
    for name in ("quality", "provenance", "manifest", "scans"):
        shutil.rmtree(path / name)
    root = zarr.open_group(path, mode="a", use_consolidated=False)
    del root.attrs["dataset_sha256"]
    store = open_store(path)
    assert store.sha256 == known
    assert list(store.quality["scan"]) == store.ids
    assert store.manifest == {}
    assert values_of(store.root, "valid").all()


@pytest.mark.parametrize("ids", [["P11", "P12", "P21"], ["P12", "P21"], ["P11"]])
def test_a_copy_or_a_part_by_xarray_is_a_store_again(campaign: Path, tmp_path: Path, ids: list[str]) -> None:
    import xarray

    path = campaign / "prints.zarr"
    whole = open_store(path)
    part = xarray.open_zarr(path).sel(scan=ids)
    part.to_zarr(tmp_path / "copy.zarr", mode="w")
    copy = open_store(tmp_path / "copy.zarr")
    assert copy.ids == ids
    assert (copy.sha256 == whole.sha256) == (ids == whole.ids)
    assert copy.write == whole.write
    for scan_id in ids:
        for name in ("mask_level", "height_um", "valid", "scan_to_layout"):
            one, other = getattr(copy.scan(scan_id), name), getattr(whole.scan(scan_id), name)
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
    part.to_netcdf(tmp_path / "copy.nc")
    with xarray.open_dataset(tmp_path / "copy.nc") as back:
        np.testing.assert_array_equal(back["height_um"], part["height_um"])
        # The coordinates of the pixel centres allow a selection by length.
        assert float(back.sel(x=5.04, y=1.01, method="nearest")["x_um"]) == pytest.approx(5.05)


def test_the_selection_that_the_page_shows_is_a_store_again(
    campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "dataset_store.md").read_text("utf-8")
    code = re.search(r"^import xarray\n.*?(?=```)", page, re.MULTILINE | re.DOTALL)
    shown: dict[str, Any] = {}
    monkeypatch.chdir(campaign)
    exec(code[0], shown)
    monkeypatch.undo()
    shown["prints"].isel(y=slice(96)).to_zarr(tmp_path / "part.zarr")
    whole, part = open_store(campaign / "prints.zarr"), open_store(tmp_path / "part.zarr")
    assert part.ids == [whole.ids[0], whole.ids[2]]
    for one in part.scans():
        np.testing.assert_array_equal(one.height_um, whole.scan(one.id).height_um[:96])


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (lambda whole: whole.isel(y=slice(16, 80)), "y_um of"),
        (lambda whole: whole.isel(x=slice(None, None, -1)), "x_um of"),
        (lambda whole: whole.isel(y=slice(None, None, 2), x=slice(None, None, 2)), "y_um of"),
        (lambda whole: whole.transpose("scan", "x", "y", ...), "dimensions of mask_level"),
    ],
)
def test_a_part_with_other_pixels_is_refused(
    campaign: Path, tmp_path: Path, part: Callable[[Any], Any], words: str
) -> None:
    import xarray

    whole = xarray.open_zarr(campaign / "prints.zarr")
    part(whole).drop_encoding().to_zarr(tmp_path / "part.zarr")
    with pytest.raises(InputError, match=words):
        open_store(tmp_path / "part.zarr")


def test_a_copy_by_xarray_may_lack_only_the_chunks_of_empty_columns(campaign: Path, tmp_path: Path) -> None:
    import xarray

    copy = tmp_path / "copy.zarr"
    whole = xarray.open_zarr(campaign / "prints.zarr")
    unknown = xarray.full_like(whole["order"], np.nan, dtype=float)
    whole.assign_coords(dose=unknown.rename("dose")).to_zarr(copy)
    assert not (copy / "dose" / "c").exists()
    scan = open_store(copy).scan("P11")
    assert scan.dose is None
    chunks = sorted(
        path for path in copy.rglob("*") if "c" in path.relative_to(copy).parts and path.is_file()
    )
    assert len(chunks) > 15
    for chunk in chunks:
        content = chunk.read_bytes()
        chunk.unlink()
        with pytest.raises(InputError, match="every file that it declares"):
            open_store(copy)
        chunk.write_bytes(content)


def test_a_copy_with_its_groups_has_to_be_whole(campaign: Path, tmp_path: Path) -> None:
    import xarray

    tree = xarray.open_datatree(campaign / "prints.zarr", engine="zarr")
    parts = {"/": tree.to_dataset(), "/manifest": tree["manifest"].to_dataset()}
    xarray.DataTree.from_dict(parts).to_zarr(tmp_path / "lacks.zarr")
    with pytest.raises(InputError, match="write empty chunks"):
        open_store(tmp_path / "lacks.zarr")
    tree.to_zarr(tmp_path / "whole.zarr", write_empty_chunks=True)
    assert open_store(tmp_path / "whole.zarr").sha256 == open_store(campaign / "prints.zarr").sha256
