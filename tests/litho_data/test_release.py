"""Check that the released files contain the same store."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd
import pytest

from litho_data.exchange.croissant import croissant
from litho_data.exchange.pairs import export_pairs
from litho_data.exchange.release import _root, export_ro_crate, export_zip
from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_data.provenance.verify import verify
from litho_data.store import open_store
from litho_data.store.schema import Instrument


def test_one_file_reads_as_the_folder_does(campaign: Path, tmp_path: Path) -> None:
    packed = export_zip(campaign / "prints.zarr", tmp_path / "prints.zarr.zip")
    store = open_store(packed)
    assert store.computed_sha256() == open_store(campaign / "prints.zarr").sha256
    result = verify(packed, data_dir=campaign)
    assert (result.findings, result.n_raw_files) == ((), 6)
    again = export_zip(campaign / "prints.zarr", tmp_path / "again.zarr.zip")
    assert file_sha256(again) == file_sha256(packed)
    with pytest.raises(InputError, match="packed already"):
        export_zip(packed, tmp_path / "twice.zarr.zip")


def test_a_flipped_byte_of_the_file_is_found(campaign: Path, tmp_path: Path) -> None:
    packed = export_zip(campaign / "prints.zarr", tmp_path / "prints.zarr.zip")
    content = bytearray(packed.read_bytes())
    content[len(content) // 2] ^= 1
    packed.write_bytes(content)
    assert verify(packed, data_dir=campaign).findings


def test_the_crate_describes_its_files(campaign: Path, tmp_path: Path) -> None:
    crate = export_ro_crate(campaign / "prints.zarr", tmp_path / "crate")
    graph = json.loads((crate / "ro-crate-metadata.json").read_text())["@graph"]
    entities = {entity["@id"]: entity for entity in graph}
    assert len(entities) == len(graph)
    root = entities["./"]
    assert entities["ro-crate-metadata.json"]["about"] == {"@id": "./"}
    parts = [part["@id"] for part in root["hasPart"]]
    assert sorted(path.name for path in crate.iterdir()) == sorted([*parts, "ro-crate-metadata.json"])
    for name in parts:
        assert entities[name]["sha256"] == file_sha256(crate / name)
        assert entities[name]["contentSize"] == str((crate / name).stat().st_size)
    action = entities["#build"]
    assert len(action["object"]) == 6
    for one in action["object"]:
        raw = entities[one["@id"]]
        assert raw["identifier"] == f"sha256:{file_sha256(campaign / raw['name'])}"
    assert action["startTime"] < action["endTime"]
    # RO-Crate 1.1 requires these entries of every root dataset.
    assert {"name", "description", "datePublished"} <= set(root)


@pytest.mark.parametrize("instrument", get_args(Instrument))
def test_the_crate_names_the_instrument(instrument: Instrument, campaign: Path) -> None:
    store = open_store(campaign / "prints.zarr")
    store.instrument = instrument
    assert (" AFM " in _root(store)["description"]) == (instrument == "afm")


def test_words_are_words_for_croissant() -> None:
    """Check a column whose ids look like numbers and one that is empty for all scans."""
    table = pd.DataFrame({"scan": ["01", "02"], "reason": ["", ""], "passed": [True, False], "px": [1, 2]})
    root = dict.fromkeys(("name", "description", "datePublished"), "")
    fields = croissant(root, [], "quality.csv", table.assign(error=[0.5, np.nan]))["recordSet"][0]["field"]
    types = [one["dataType"].removeprefix("sc:") for one in fields]
    assert types == ["Text", "Text", "Boolean", "Integer", "Float"]


@pytest.mark.parametrize(
    "name", ["../evil.txt", "../evil.zarr/zarr.json", "/evil.txt", "a/../../b", "..\\\\c"]
)
def test_an_archive_with_a_path_that_leads_out_is_refused(name: str, campaign: Path, tmp_path: Path) -> None:
    packed = export_zip(campaign / "prints.zarr", tmp_path / "prints.zarr.zip")
    with zipfile.ZipFile(packed, "a") as archive:
        archive.writestr(name, "{}")
    with pytest.raises(InputError, match="names inside the store"):
        open_store(packed)
    assert any("inside the store" in str(finding) for finding in verify(packed, data_dir=campaign).findings)


def test_a_name_that_leads_out_is_refused_before_anything_is_written(
    own_campaign: Path, tmp_path: Path
) -> None:
    document = own_campaign / "prints.zarr" / "zarr.json"
    document.write_text(document.read_text().replace('"name": "test-prints"', '"name": "../../escaped"'))
    for export in (export_ro_crate, export_pairs):
        with pytest.raises(InputError, match=r"escaped.*plain name"):
            export(own_campaign / "prints.zarr", tmp_path / "a" / "b" / "crate")
    assert not (tmp_path / "a").exists()
