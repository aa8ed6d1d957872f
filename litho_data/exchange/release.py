"""Export a store for release, either as one packed file or as a folder that also describes the data in the
formats RO-Crate and Croissant.
"""

import json
import zipfile
from pathlib import Path
from typing import Any

from litho_data.commands.progress import progress
from litho_data.exchange.croissant import croissant
from litho_data.foundation import InputError, atomic_file, file_sha256
from litho_data.foundation.begun import whole_folder
from litho_data.store.read import Store, open_store
from litho_data.store.schema import Instrument

# A zip archive states a time for every file. A fixed time makes the archives of the same store identical.
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
_CRATE_FILE, _CROISSANT_FILE = "ro-crate-metadata.json", "croissant.json"
_MEASURED_BY: dict[Instrument, str] = {
    "afm": "AFM",
    "profilometer": "profilometry",
    "confocal": "confocal microscopy",
    "sem": "SEM",
}
_CRATE_VERSION = "https://w3id.org/ro/crate/1.1"


def export_zip(store_path: str | Path, out: str | Path) -> Path:
    """Pack a store into one ``.zarr.zip`` file, which ``open_store`` and zarr can read directly.

    Raises:
        InputError: the store does not exist or is packed already, or ``out`` is not a zip file.
    """
    store = open_store(store_path)
    folder = Path(store_path)
    if not folder.is_dir():
        raise InputError("store to export", got=f"{folder}, which is packed already", wanted="a .zarr folder")
    if Path(out).suffix != ".zip":
        raise InputError("output file", got=str(out), wanted=f"a zip file, such as {store.name}.zarr.zip")
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    with atomic_file(out) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for path in progress(files, "packing"):
            entry = zipfile.ZipInfo(path.relative_to(folder).as_posix(), _ZIP_TIME)
            archive.writestr(entry, path.read_bytes())
    return Path(out)


def export_ro_crate(store_path: str | Path, out: str | Path) -> Path:
    """Write a release folder that contains the packed store, a table of the quality of each scan, and
    descriptions of both.

    ``ro-crate-metadata.json`` states the SHA-256 of every raw file, the software of the build, the licence
    and the citation. ``croissant.json`` describes the files and the columns of the table.

    Raises:
        InputError: the store does not exist, is packed or has no manifest, or the output folder contains
            files of another kind.
    """
    store = open_store(store_path)
    if "card" not in store.manifest:
        raise InputError(f"{store_path} has no manifest", wanted="a store made by litho-data build")
    with whole_folder(out, "*.zarr.zip", "quality.csv", _CRATE_FILE, _CROISSANT_FILE) as folder:
        packed, table = folder / f"{store.name}.zarr.zip", folder / "quality.csv"
        export_zip(store_path, packed)
        store.quality.to_csv(table, index=False)
        files = [
            _file(packed, "application/zip", "Dataset store, Zarr v3 in one file"),
            _file(table, "text/csv", "Quality of each scan: registration, levelling and noise"),
        ]
        root = _root(store)
        _write(folder / _CROISSANT_FILE, croissant(root, files, table.name, store.quality))
        files.append(_file(folder / _CROISSANT_FILE, "application/ld+json", "Description in Croissant"))
        content = {"@context": f"{_CRATE_VERSION}/context", "@graph": _graph(store, root, files)}
        _write(folder / _CRATE_FILE, content)
    return Path(out)


def _write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _root(store: Store) -> dict[str, Any]:
    """Return the entry that describes the dataset in the RO-Crate."""
    manifest = store.manifest
    card = manifest["card"]
    by = _MEASURED_BY[store.instrument]
    root: dict[str, Any] = {
        "@id": "./",
        "@type": "Dataset",
        "name": card.get("title") or store.name,
        "identifier": f"sha256:{store.sha256}",
        "description": f"{len(store)} printed fields measured by {by} and registered onto their layouts, "
        f"{store.pitch_um} µm per pixel, levels of {store.level_height_um} µm",
        "datePublished": manifest["build"]["started"][:10],
    }
    if card.get("license"):
        root["license"] = {"@id": f"https://spdx.org/licenses/{card['license']}"}
    if card.get("citation"):
        root["citation"] = card["citation"]
    return root


def _graph(store: Store, root: dict[str, Any], files: list[dict[str, Any]]) -> list[dict[str, Any]]:
    manifest = store.manifest
    build, raw = manifest["build"], [row for row in manifest["files"] if row["status"] == "ok"]
    software, licence = build["software"], manifest["card"].get("license")
    parts = [{"@id": one["@id"]} for one in files]
    return [
        {
            "@id": _CRATE_FILE,
            "@type": "CreativeWork",
            "conformsTo": {"@id": _CRATE_VERSION},
            "about": {"@id": "./"},
        },
        root | {"hasPart": parts, "mentions": {"@id": "#build"}},
        *([{**root["license"], "@type": "CreativeWork", "name": licence}] if licence else []),
        *files,
        {
            "@id": "#build",
            "@type": "CreateAction",
            "name": "Building the dataset from raw files",
            "startTime": build["started"],
            # Older stores do not record when the build ended.
            **({"endTime": build["ended"]} if "ended" in build else {}),
            "instrument": {"@id": "#software"},
            "object": [{"@id": f"#raw/{row['path']}"} for row in raw],
            "result": parts[0],
        },
        {
            "@id": "#software",
            "@type": "SoftwareApplication",
            "name": "litholoop",
            "version": software["versions"].get("litholoop", ""),
            "softwareRequirements": [f"{name} {version}" for name, version in software["versions"].items()],
        },
        *(
            {
                "@id": f"#raw/{row['path']}",
                "@type": "CreativeWork",
                "name": row["path"],
                "identifier": f"sha256:{row['sha256']}",
                "size": f"{row['size_bytes']} B",
            }
            for row in raw
        ),
    ]


def _file(path: Path, media_type: str, name: str) -> dict[str, Any]:
    return {
        "@id": path.name,
        "@type": "File",
        "name": name,
        "encodingFormat": media_type,
        "contentSize": str(path.stat().st_size),
        "sha256": file_sha256(path),
    }
