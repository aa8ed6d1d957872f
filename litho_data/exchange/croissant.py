"""The Croissant description of a release: its files, and the columns of its quality table."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

_VERSION = "http://mlcommons.org/croissant/1.0"
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_TYPES = {"i": "sc:Integer", "f": "sc:Float", "b": "sc:Boolean"}


def croissant(root: Mapping[str, Any], files: Sequence[Mapping[str, Any]], table: Path) -> dict[str, Any]:
    """The description as JSON-LD.

    Args:
        root: the crate's entry for the dataset; ``files``: its entries for the files.
        table: CSV with one row per scan; the description covers each column.
    """
    said = {name: root[name] for name in ("name", "description", "datePublished")}
    said |= {"license": root["license"]["@id"]} if "license" in root else {}
    said |= {"citeAs": root["citation"]} if "citation" in root else {}
    fields = [
        {
            "@type": "cr:Field",
            "@id": f"scans/{name}",
            "name": name,
            "dataType": _TYPES.get(column.dtype.kind, "sc:Text"),
            "source": {"fileObject": {"@id": table.name}, "extract": {"column": name}},
        }
        for name, column in pd.read_csv(table).items()
    ]
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": _VERSION,
        "version": "1.0.0",
        **said,
        "distribution": [_file_object(one) for one in files],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "scans",
                "name": "scans",
                "key": {"@id": "scans/scan"},
                "field": fields,
            }
        ],
    }


def _file_object(file: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": file["@id"],
        "name": file["@id"],
        "description": file["name"],
        "contentUrl": file["@id"],
        "contentSize": f"{file['contentSize']} B",
        "encodingFormat": file["encodingFormat"],
        "sha256": file["sha256"],
    }
