"""Releases in the tools of others: mlcroissant and rocrate."""

from __future__ import annotations

import shutil
from pathlib import Path

import mlcroissant
import pytest
from rocrate.rocrate import ROCrate

from litho_data.exchange.release import export_ro_crate
from litho_data.foundation.hashes import file_sha256
from litho_data.store import open_store


@pytest.fixture(scope="module")
def release(campaign: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_ro_crate(campaign / "prints.zarr", tmp_path_factory.mktemp("release") / "crate")


def test_croissant_is_valid_and_reads_the_table(release: Path, campaign: Path) -> None:
    """mlcroissant downloads nothing: the files lie beside the description, and their hashes are checked."""
    dataset = mlcroissant.Dataset(jsonld=release / "croissant.json")
    assert not dataset.metadata.ctx.issues.errors
    quality = open_store(campaign / "prints.zarr").quality
    records = list(dataset.records("scans"))
    assert [record["scans/scan"].decode() for record in records] == quality["scan"].tolist()
    assert [record["scans/ncc_after"] for record in records] == quality["ncc_after"].tolist()


def test_a_changed_file_is_refused_by_croissant(release: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(release, tmp_path / "copy")
    (copy / "quality.csv").write_text((copy / "quality.csv").read_text() + "\n")
    with pytest.raises(Exception, match=r"quality\.csv"):
        list(mlcroissant.Dataset(jsonld=copy / "croissant.json").records("scans"))


def test_the_crate_reads_as_one(release: Path) -> None:
    crate = ROCrate(release)
    parts = {part.id: part for part in crate.root_dataset["hasPart"]}
    assert parts.keys() == {path.name for path in release.iterdir()} - {"ro-crate-metadata.json"}
    assert all(part["sha256"] == file_sha256(release / name) for name, part in parts.items())
    build = crate.get("#build")
    assert build["startTime"] < build["endTime"]
    assert build["instrument"]["name"] == "litholoop"
