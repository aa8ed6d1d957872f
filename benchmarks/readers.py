"""What the readers make of real files, of random bytes behind every signature, and of a damaged header.

    LITHO_ORACLE_DIR=… python -m benchmarks.readers [--bodies 1000] [--out FILE.json] [--publish]

$LITHO_ORACLE_DIR/vendor holds the files, and in reference.npz what another reader (AFMReader 0.0.7) returns
for three of them at every 8th pixel. --publish also writes the tables into docs/readers.md.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.build import cost_of
from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, options, origin, write_record
from litho_data.foundation.commands import progress, run_script
from litho_data.foundation.errors import InputError
from litho_data.readers import list_channels, read_scan

PAGE = Path(__file__).parents[1] / "docs" / "readers.md"
RESULT = PAGE.parent / "results" / "readers" / "readers.json"
NAME = "readers.json"
DAMAGED = "damaged_header.ibw"
# Files that are no measurement: what the folder holds about them.
_NOT_MEASURED = {"README.md", "reference.npz"}
_EVERY_PX = 8
# Channel, and what the other reader returns for it, nm.
_REFERENCES = {
    "sample_0.jpk": ("Height", "jpk_nm_every_8px"),
    "sample_0.stp": (None, "stp_nm_every_8px"),
    "sample_0.top": (None, "top_nm_every_8px"),
}
_TURNS = {
    "as the reference": lambda z: z,
    "half a turn from the reference": lambda z: z[::-1, ::-1],
    "upside down against the reference": lambda z: z[::-1],
    "a mirror image of the reference": lambda z: z[:, ::-1],
}
SIGNATURES = (
    b"Gwyddion Simple Field 1.0\n", b"GWYPGwyContainer\0", b"\x93NUMPY\x01\x00", b"II*\0\x08\0\0\0", b"MM\0*",
    b"II+\0", b"\x89PNG\r\n\x1a\n", b"BM", b"\x05\x00", b"\x00\x05", b"DIGITAL SURF\0", b"\\*File list\r\n",
    b"PK\x03\x04", b"\x89HDF\r\n\x1a\n", b"CDF\x01", b"MATLAB 5.0 MAT-file", b"WSxM file copyright",
    b"1 2 3\n", b"# Width: 1 um\n",
)  # fmt: skip
_MORE_SIGNATURES = (
    b"\x1f\x8b\x08\0", b"\xff\xfe1\x00 \x00", b"VCA DATA\x01\0\0\x55", b"OLYMPUSRAWFORMAT",
    b"\xd0\xcf\x11\xe0", b"[DataSet]\r\n", b"?*File list\r\n", b"CDF\x02",
)  # fmt: skip


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the tables into docs/readers.md", RESULT)
    parser.add_argument("--bodies", type=int, default=1000, help="random bodies behind each signature")
    parser.add_argument("--only-bodies", action="store_true", help="read random bodies and nothing else")
    arguments = parser.parse_args()
    if arguments.only_bodies:
        write_record(arguments.out, {"signatures": read_bodies(arguments.bodies)})
        return
    if "LITHO_ORACLE_DIR" not in os.environ:
        raise InputError("LITHO_ORACLE_DIR", got="nothing", wanted="the folder that holds vendor/")
    folder = Path(os.environ["LITHO_ORACLE_DIR"]) / "vendor"
    record = {
        "schema": "litho-data/benchmark-readers/1",
        **origin(),
        "files": [
            file_row(path, folder) for path in sorted(folder.iterdir()) if path.name not in _NOT_MEASURED
        ],
        "damaged_header": damaged_header(folder / DAMAGED),
        "bodies": bodies_within_limits(arguments.bodies),
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def file_row(path: Path, folder: Path) -> dict[str, Any]:
    """What one file gives: its channels and first height map, or why it is refused."""
    row: dict[str, Any] = {"file": path.name, "refused": "", "reference": ""}
    try:
        channels = list_channels(path)
        heights = [channel for channel in channels if channel.is_height]
        shown = (heights or channels)[0]
        scan = read_scan(
            path, channel=shown.name, unit=shown.unit or "um", size_um=shown.size_um or (1.0, 1.0)
        )
    except InputError as error:
        return {**row, "refused": str(error).replace(f"{folder}{os.sep}", "")}
    row |= {"channels": len(channels), "heights": len(heights), "shape": list(scan.shape), "unit": shown.unit}
    row["size_um"] = None if shown.size_um is None else [round(value, 6) for value in shown.size_um]
    if (reference := _REFERENCES.get(path.name)) is not None:
        name, key = reference
        compared = scan if name is None else read_scan(path, channel=name)
        with np.load(folder / "reference.npz") as stored:
            row["reference"], row["difference_nm"] = against(compared.height_um * 1e3, stored[key])
    return row


def against(height_nm: np.ndarray, reference_nm: np.ndarray) -> tuple[str, float]:
    """The orientation in which a map fits the reference, and the largest difference without the datum."""
    found = {}
    for name, turn in _TURNS.items():
        sampled = turn(height_nm)[::_EVERY_PX, ::_EVERY_PX]
        if sampled.shape == reference_nm.shape:
            difference = sampled - reference_nm
            found[name] = float(np.abs(difference - np.median(difference)).max())
    best = min(found, key=lambda name: found[name])
    return best, found[best]


def damaged_header(path: Path) -> dict[str, Any]:
    """Time and memory of the command on a file whose header lies, interpreter and children included."""
    command = [str(Path(sys.executable).with_name("litho-data")), "inspect", str(path)]
    cost = cost_of(["sh", "-c", '"$@" 2>/dev/null; test $? -eq 2', "sh", *command])
    return {"wall_s": round(cost.wall_s, 2), "cpu_s": round(cost.cpu_s, 2), "peak_mib": round(cost.peak_mib)}


def bodies_within_limits(bodies: int) -> dict[str, Any]:
    """Random bodies in a process of their own, with its time and memory."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "bodies.json"
        command = [sys.executable, "-m", "benchmarks.readers", "--only-bodies", "--bodies", str(bodies)]
        cost = cost_of([*command, "--out", str(out)])
        rows = json.loads(out.read_text(encoding="utf-8"))["signatures"]
    return {
        "bodies": bodies,
        "wall_s": round(cost.wall_s),
        "peak_mib": round(cost.peak_mib),
        "signatures": rows,
    }


def read_bodies(bodies: int) -> list[dict[str, Any]]:
    """One row per signature: how many bodies are refused, opened as a map, or end in anything else."""
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "scan"
        for signature in progress(signatures(), "signatures"):
            outcomes: Counter[str] = Counter()
            longest_s = 0.0
            for body in range(bodies):
                rng = np.random.default_rng([len(signature), *signature, body])
                path.write_bytes(signature + random_body(rng))
                started = time.perf_counter()
                outcomes[outcome(path)] += 1
                longest_s = max(longest_s, time.perf_counter() - started)
            rows.append({"signature": repr(signature)[2:-1], **outcomes, "longest_s": round(longest_s, 2)})
    return rows


def random_body(rng: np.random.Generator) -> bytes:
    """Up to 64 kB, short ones more often; half of them small numbers, which pass for sizes."""
    size = int(2 ** rng.uniform(0, 16))
    return rng.integers(0, 4 if rng.random() < 0.5 else 256, size=size).astype(np.uint8).tobytes()


def outcome(path: Path) -> str:
    """What reading a file ends in: ``opened``, ``refused`` in one line, or the name of another error."""
    try:
        read_scan(path, unit=None, size_um=(1.0, 1.0))
    except InputError as error:
        return "refused" if "\n" not in str(error) else "several lines"
    except Exception as error:  # what is counted here
        return type(error).__name__
    return "opened"


def signatures() -> list[bytes]:
    """How files start: those of our readers, and all that SurfaceTopography's readers name."""
    from SurfaceTopography.IO import readers

    named = [
        magic for reader in readers for offset, magic in getattr(reader, "_magic", None) or () if not offset
    ]
    return list(dict.fromkeys([*SIGNATURES, *_MORE_SIGNATURES, *named]))


def as_markdown(record: Mapping[str, Any]) -> str:
    """Both tables and the damaged header."""
    heads = ("file", "opened", "first height map", "largest difference from the reference", "orientation")
    damaged = record["damaged_header"]
    note = (
        f"`{DAMAGED}`, which asks for gigabytes: refused after {damaged['wall_s']:.1f} s "
        f"({damaged['cpu_s']:.1f} s of computing) with {damaged['peak_mib']} MiB, interpreter and child "
        "process included."
    )
    rows = [_file_cells(row) for row in record["files"]]
    return markdown_table(heads, rows, note, _bodies(record["bodies"]))


def _file_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    name = f"`{row['file']}`"
    if row["refused"]:
        return name, f"refused: {row['refused'].replace('|', '/')}", "", "", ""
    opened = f"{row['channels']} channel{'s' * (row['channels'] > 1)}, {row['heights']} of heights"
    size_um = row["size_um"]
    size = "no size" if size_um is None else f"{size_um[0]:.6g} × {size_um[1]:.6g} µm"
    shape = f"{row['shape'][0]} × {row['shape'][1]} px, {size}, {row['unit'] or 'no unit'}"
    difference = f"{row['difference_nm']:.2g} nm" if row["reference"] else ""
    return name, opened, shape, difference, row["reference"]


def _bodies(bodies: Mapping[str, Any]) -> str:
    rows: Sequence[Mapping[str, Any]] = bodies["signatures"]
    total = Counter[str]()
    for row in rows:
        total.update({key: value for key, value in row.items() if key not in ("signature", "longest_s")})
    others = sum(total.values()) - total["refused"] - total["opened"]
    slowest = max(rows, key=lambda row: row["longest_s"])
    opened = ", ".join(f"`{row['signature']}` {row['opened']}" for row in rows if row.get("opened"))
    return (
        f"{bodies['bodies']} random bodies of up to 64 kB behind each of {len(rows)} signatures: "
        f"{total['refused']} refused in one line, {total['opened']} opened as maps ({opened or 'none'}), "
        f"{others} ended in anything else. The slowest took {slowest['longest_s']:.1f} s "
        f"(`{slowest['signature']}`); the most memory was {bodies['peak_mib']} MiB in all processes together."
    )


if __name__ == "__main__":
    run_script(main)
