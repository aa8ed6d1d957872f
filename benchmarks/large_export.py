"""Memory, time and file size of the export of a lens of rings, written and read back in bands of rows.

    python -m benchmarks.large_export [--sizes 1024 4096] [--out FILE]

Seconds of the processor. Memory is what the highest resident memory grows by, from before the export (Linux).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import origin, write_record
from litho_data.foundation.commands import run_script
from litho_design.exports.gds import GdsRows, write_gds
from litho_design.exports.image import TiffRows, write_tiff
from litho_design.exports.rows import LevelRows, RingRows, bands_of
from litho_design.printers.layout import LayoutSettings

_MIB = 2**20
_SMALL_PX = 256


def main() -> None:
    """Export both formats at every size, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[1024, 4096])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        # The first of each imports what it needs.
        for size in [_SMALL_PX, *given.sizes]:
            rows += [_exported(kind, size, Path(name) / f"layout.{kind}") for kind in ("tiff", "gds")]
    content = {"schema": "litho-design/large-export/1", **origin(), "exports": rows[2:]}
    print(json.dumps(content, indent=1))
    if given.out:
        write_record(given.out, content)


def _exported(kind: str, size_px: int, file: Path) -> dict[str, Any]:
    """One export of a Fresnel lens whose outermost zone has two pixels, read back by the same package."""
    layout = LayoutSettings()
    radius = np.arange(size_px // 2)
    levels = RingRows((radius**2 * layout.levels // (2 * size_px) % layout.levels).astype(np.uint8))
    # 5 sets the highest resident memory to that of now (proc(5)).
    Path("/proc/self/clear_refs").write_text("5")
    before, started = _resident_kib("VmRSS"), time.process_time()
    back: LevelRows
    if kind == "tiff":
        write_tiff(file, levels, layout.pitch_um, layout.level_height_um)
        back = TiffRows(file)
    else:
        write_gds(file, levels, layout.pitch_um, "cumulative")
        back = GdsRows(file, (size_px, size_px), layout.pitch_um, "cumulative")
    for rows in bands_of(levels, 128):
        if not np.array_equal(back[rows], levels[rows]):
            raise AssertionError(f"{kind} of {size_px} px does not read back as it was written")
    return {
        "format": kind,
        "size_px": size_px,
        "processor_s": time.process_time() - started,
        "file_mib": file.stat().st_size / _MIB,
        "memory_mib": (_resident_kib("VmHWM") - before) / 1024,
    }


def _resident_kib(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name))


if __name__ == "__main__":
    run_script(main)
