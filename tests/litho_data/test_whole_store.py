"""Check that an incomplete store cannot be opened, and that ``verify`` reports any damage."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from litho_data.exchange.release import export_zip
from litho_data.foundation.errors import InputError
from litho_data.provenance.verify import verify
from litho_data.store import open_store
from litho_data.store.access import array_of
from litho_data.store.contract import require_complete


def files_of(store: Path) -> list[Path]:
    return sorted(path for path in store.rglob("*") if path.is_file())


def test_every_chunk_has_a_file_even_if_it_is_all_zeros(campaign: Path) -> None:
    """Check this because otherwise a lost chunk could not be told apart from a chunk that was never
    written.
    """
    root = zarr.open_group(campaign / "prints.zarr", mode="r", use_consolidated=False)
    stored: Any = [(path, one) for path, one in root.members(max_depth=None) if isinstance(one, zarr.Array)]
    assert len(stored) > 50
    for path, one in stored:
        parts = math.prod(-(-n // size) for n, size in zip(one.shape, one.shards or one.chunks, strict=True))
        assert (
            len([file for file in files_of(campaign / "prints.zarr" / path) if "/c/" in str(file)]) == parts
        )


def test_a_store_without_any_one_of_its_files_is_refused(own_campaign: Path) -> None:
    store = own_campaign / "prints.zarr"
    for number, file in enumerate(files_of(store)):
        content = file.read_bytes()
        file.unlink()
        # To open a store begins with this check, which is faster alone.
        with pytest.raises(InputError, match=r"store|metadata"):
            require_complete(store) if number % 9 else open_store(store)
        file.write_bytes(content)
    open_store(store)


@pytest.mark.parametrize(
    "lost", ["mask_level/c", "scans/P12/removed_um", "manifest/scan/c/0", "order", "quality", "manifest"]
)
def test_verify_answers_for_a_store_that_has_lost_a_part(own_campaign: Path, lost: str) -> None:
    part = own_campaign / "prints.zarr" / lost
    if part.is_dir():
        shutil.rmtree(part)
    else:
        part.unlink()
    found = [str(finding) for finding in verify(own_campaign / "prints.zarr").findings]
    assert any(f"file {lost}" in one and "but missing" in one for one in found)


def test_a_packed_store_that_has_lost_a_file_is_refused(own_campaign: Path, tmp_path: Path) -> None:
    whole = export_zip(own_campaign / "prints.zarr", tmp_path / "whole.zarr.zip")
    lost = tmp_path / "lost.zarr.zip"
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(lost, "w") as target:
        for name in source.namelist():
            if name != "height_um/c/0/0/0":
                target.writestr(name, source.read(name))
    assert open_store(whole).sha256 == open_store(own_campaign / "prints.zarr").sha256
    with pytest.raises(InputError, match="got no height_um/c/0/0/0"):
        open_store(lost)


def put(store: Path, name: str, value: Any, place: Any = 1) -> None:
    """Write a value into an array of a store. A float value converts an array of integers to floats."""
    root = zarr.open_group(store, mode="a", use_consolidated=False)
    old = array_of(root, name)
    values: Any = old[...]
    if isinstance(value, float) and values.dtype.kind == "i":
        values = values.astype(np.float64)
    values[place] = value
    new = root.create_array(
        name,
        shape=values.shape,
        dtype="string" if values.dtype.kind in "OTU" else values.dtype,
        dimension_names=old.metadata.to_dict()["dimension_names"],  # type: ignore[arg-type]
        attributes=dict(old.attrs),
        config={"write_empty_chunks": True},
        overwrite=True,
    )
    new[...] = values


def add_column(store: Path, name: str, value: float) -> None:
    root = zarr.open_group(store, mode="a", use_consolidated=False)
    root.create_array(name, shape=(3,), dtype="float64")[...] = np.array([1.0, np.nan, value])


def put_attribute(store: Path, name: str, value: Any) -> None:
    document = json.loads((store / "zarr.json").read_text())
    document["attributes"][name] = value
    (store / "zarr.json").write_text(json.dumps(document))


Change = Callable[[Path], None]
# Each kind of damage, with words of the message that reports it.
IMPOSSIBLE: dict[str, tuple[Change, str]] = {
    "a level above the highest": (lambda s: put(s, "mask_level", 13, (1, 5, 7)), "level .*P12.*got 13"),
    "nothing measured": (lambda s: put(s, "valid", False), "measured pixels of scan P12"),
    "no number measured": (lambda s: put(s, "height_um", np.nan), "measured pixels of scan P12"),
    "a height of a kilometre": (lambda s: put(s, "height_um", 1e9, (1, 3, 4)), "height_um of scan P12"),
    "no transform": (lambda s: put(s, "scan_to_layout", np.nan), "scan_to_layout of scan P12"),
    "a flat transform": (lambda s: put(s, "scan_to_layout", 0.0), "scan_to_layout of scan P12"),
    "order NaN": (lambda s: put(s, "order", np.nan), "order of"),
    "order beyond all": (lambda s: put(s, "order", 1e300), "order of"),
    "dose zero": (lambda s: add_column(s, "dose", 0.0), "dose of"),
    "dose below zero": (lambda s: add_column(s, "dose", -1.0), "dose of"),
    "dose infinite": (lambda s: add_column(s, "dose", math.inf), "dose of"),
    "a place beyond all": (lambda s: add_column(s, "field_x_um", 1e308), "field_x_um of"),
    "a negative size": (lambda s: put(s, "quality/layout_ny", -4), "sizes of the layouts"),
    "a size beyond the field": (lambda s: put(s, "quality/layout_nx", 113), "sizes of the layouts"),
    "a size of no number": (lambda s: put(s, "quality/layout_ny", np.nan), "sizes of the layouts"),
    "an id that is a path": (lambda s: put(s, "scan", "../P12"), "scan of .*plain name"),
    "an id that is empty": (lambda s: put(s, "scan", ""), "scan of .*plain name"),
    "a print that is a path": (lambda s: put(s, "print", "/etc"), "print of .*plain name"),
    "a name that is a path": (lambda s: put_attribute(s, "name", "../../escaped"), "name of .*plain name"),
    "a pitch beyond all": (lambda s: put_attribute(s, "pitch_um", 1e300), "attribute pitch_um"),
    "a pitch of 4,000 digits": (lambda s: put_attribute(s, "pitch_um", 10**4000), "attribute pitch_um"),
    "a write field of no size": (lambda s: put_attribute(s, "write_field_um", -3.0), "write_field_um of"),
    "a card that is none": (lambda s: put_attribute(s / "manifest", "card", "none"), "manifest"),
    "a build without software": (lambda s: put_attribute(s / "manifest", "build", {}), "manifest"),
    "facts of a reader that are no JSON": (lambda s: put(s, "manifest/read", "{"), "manifest"),
}


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_impossible_values_are_refused_when_a_store_is_opened(what: str, own_campaign: Path) -> None:
    store = own_campaign / "prints.zarr"
    change, words = IMPOSSIBLE[what]
    change(store)
    with pytest.raises(InputError, match=words) as refusal:
        open_store(store)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 600
    assert verify(store).findings


@pytest.mark.parametrize("part", ["", "height_um"])
@pytest.mark.parametrize("document", ["[]", "null", '"x"', "1", "{}"])
def test_a_document_of_another_kind_is_refused(part: str, document: str, own_campaign: Path) -> None:
    store = own_campaign / "prints.zarr"
    (store / part / "zarr.json").write_text(document)
    with pytest.raises(InputError, match=r"metadata|no Zarr v3 group"):
        open_store(store)
    with contextlib.suppress(InputError):
        assert verify(store).findings


def test_a_result_records_the_hash_of_the_arrays_that_were_read(own_campaign: Path) -> None:
    store = own_campaign / "prints.zarr"
    stated = json.loads((store / "zarr.json").read_text())["attributes"]["dataset_sha256"]
    assert open_store(store).dataset_id.sha256 == stated
    put(store, "height_um", 0.25, (1, 3, 4))
    assert open_store(store).dataset_id.sha256 not in (stated, "")
