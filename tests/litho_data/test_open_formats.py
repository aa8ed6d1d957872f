"""Check that other tools (mlcroissant, rocrate, compliance-checker and others) read stores and releases."""

from __future__ import annotations

import shutil
from pathlib import Path

import mlcroissant
import pytest
import xarray
import zarr
from compliance_checker.runner import CheckSuite
from ome_zarr_models.v05 import Image
from rocrate.rocrate import ROCrate

from litho_data.exchange.release import export_ro_crate
from litho_data.foundation.hashes import file_sha256
from litho_data.store import open_store
from litho_data.store.write import consolidate


@pytest.fixture(scope="module")
def release(campaign: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_ro_crate(campaign / "prints.zarr", tmp_path_factory.mktemp("release") / "crate")


def test_croissant_is_valid_and_reads_the_table(release: Path, campaign: Path) -> None:
    """Check the description with mlcroissant, which verifies the hashes of the files beside it."""
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


def test_rocrate_reads_the_crate(release: Path) -> None:
    crate = ROCrate(release)
    parts = {part.id: part for part in crate.root_dataset["hasPart"]}
    assert parts.keys() == {path.name for path in release.iterdir()} - {"ro-crate-metadata.json"}
    assert all(part["sha256"] == file_sha256(release / name) for name, part in parts.items())
    build = crate.get("#build")
    assert build["startTime"] < build["endTime"]
    assert build["instrument"]["name"] == "litholoop"


def test_the_scans_are_images_of_ome_zarr(campaign: Path) -> None:
    """Check the images as OME-Zarr tools find them, by ``labels``, and validate axes, scales and arrays."""
    root = open_store(campaign / "prints.zarr").root
    groups = [root[letter] for letter in root.attrs["labels"]]
    names = [name for group in groups for name in group.attrs["labels"]]
    assert names == ["../scans/P11", "../scans/P12", "../scans/P21"]
    for name in names:
        image = Image.from_zarr(root[f"scans/{Path(name).name}"])
        (shown,) = image.attributes.ome.multiscales
        assert {(axis.type, axis.unit) for axis in shown.axes} == {("space", "micrometer")}
        assert shown.datasets[0].coordinateTransformations[0].scale == pytest.approx([0.1, 0.1])


def cf_complaints(store: Path, netcdf: Path) -> set[str]:
    """Return the complaints of compliance-checker about a NetCDF copy of the store.

    The copy stores words as characters, and its coordinates have no fill value.
    """
    prints = xarray.open_zarr(store)
    words = [name for name in prints.coords if prints[name].dtype.kind not in "biuf"]
    encoding = {str(name): {"_FillValue": None} for name in prints.coords if name not in words}
    prints.to_netcdf(netcdf, encoding=encoding | {str(name): {"dtype": "S1"} for name in words})
    CheckSuite.load_all_available_checkers()
    suite = CheckSuite()
    results, errors = suite.run_all(suite.load_dataset(str(netcdf)), ["cf:1.11"])["cf:1.11"]
    assert not errors
    failed = [one for one in results if one.value[0] < one.value[1]]
    return {f"{one.name}: {message}" for one in failed for message in one.msgs}


def test_units_and_coordinates_follow_the_cf_conventions(campaign: Path, tmp_path: Path) -> None:
    """Check a copy, ignoring complaints about latitude, which the checker expects of any Y axis."""
    found = cf_complaints(campaign / "prints.zarr", tmp_path / "prints.nc")
    assert not {one for one in found if not one.startswith(("§4.1 Latitude", "§4.2 Longitude"))}


def test_compliance_checker_reports_a_wrong_unit(own_campaign: Path, tmp_path: Path) -> None:
    store = own_campaign / "prints.zarr"
    root = zarr.open_group(store)
    root["height_um"].attrs["units"] = "heights"
    consolidate(root)
    assert any("heights" in one for one in cf_complaints(store, tmp_path / "prints.nc"))
