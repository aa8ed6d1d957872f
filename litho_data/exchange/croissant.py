"""Write the description of a release in the metadata format Croissant: its files, and the columns of its
table of scan quality.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from litho_data.foundation import Facts

_VERSION = "http://mlcommons.org/croissant/1.0"
_CONTEXT = json.loads(Path(__file__).with_name("croissant.json").read_text(encoding="utf-8"))
_TYPES = {"i": "sc:Integer", "f": "sc:Float", "b": "sc:Boolean"}


def croissant(root: Facts, files: Sequence[Facts], file: str, table: pd.DataFrame) -> dict[str, Any]:
    """Return the Croissant description of a release as JSON-LD.

    Args:
        root: the entry that describes the dataset in the RO-Crate.
        files: the entries that describe the files of the release in the RO-Crate.
        file: name of the CSV file that contains the table.
        table: the table, with one row per scan. The description states the columns of this table and their
            types. The types are not read from the CSV file, in which an id such as 01 looks like a number.
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
            "source": {"fileObject": {"@id": file}, "extract": {"column": name}},
        }
        for name, column in table.items()
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


def _file_object(file: Facts) -> dict[str, Any]:
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
