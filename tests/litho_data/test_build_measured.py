"""Check that the 24 measured prints are built in bounded memory, and identically with one or two workers."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from litho_data.cards.fetch import find_card
from litho_data.making.build import build_dataset
from litho_data.provenance.verify import verify
from litho_data.store import open_store
from litho_data.store.schema import SAMPLE_VARIABLES

_BUILD = """
import json, resource, sys
from pathlib import Path
from litho_data.making.build import build_dataset
if __name__ == "__main__":
    result = build_dataset(sys.argv[1], sys.argv[2], workers=int(sys.argv[3]))
    child = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    # Of the process itself getrusage also counts what started it, here the tests with all that they hold.
    status = Path("/proc/self/status").read_text()
    own = int(status.split("VmHWM:")[1].split()[0]) / 1024
    print(json.dumps([result.dataset.sha256, result.n_scans, result.seconds, own, child]))
"""


def _built(out: Path, workers: int) -> tuple[str, int, float, float]:
    """Build the dataset and return its hash, the number of scans, the seconds, and the peak memory in MiB.

    The peak memory is that of the main process, plus the number of workers times that of the largest worker.
    """
    script = out.with_suffix(".py")
    script.write_text(_BUILD, encoding="utf-8")
    command = [sys.executable, str(script), str(find_card("neural-lithography")), str(out), str(workers)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    sha256, scans, seconds, own, child = json.loads(done.stdout.splitlines()[-1])
    return sha256, scans, seconds, own + (workers * child if workers > 1 else 0)


@pytest.mark.long
@pytest.mark.measured
def test_all_measured_scans_build_in_bounded_memory(measured_prints: Path, tmp_path: Path) -> None:
    sha256, scans, seconds, peak_mib = _built(tmp_path / "prints.zarr", workers=2)
    print(f"{scans} scans, 2 workers: {seconds:.1f} s, peak at most {peak_mib:.0f} MiB")
    assert scans == 24
    # A measurement gave 309 + 2 x 250 MiB.
    assert peak_mib < 1024
    store = open_store(tmp_path / "prints.zarr")
    assert store.sha256 == sha256
    assert store.quality["passed"].all()
    assert verify(tmp_path / "prints.zarr").findings == ()

    # Two scans that are built alone, in another order and in one process, have the same arrays as before.
    for name in ("afm_ug/FOV42.txt", "afm_ug/FOV72.txt", "mask_ug/FOV42.tif", "mask_ug/FOV72.tif"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(measured_prints / name, tmp_path / name)
    build_dataset(find_card("neural-lithography"), tmp_path / "two.zarr", data_dir=tmp_path, workers=1)
    two = open_store(tmp_path / "two.zarr")
    for scan_id in two.ids:
        for variable in SAMPLE_VARIABLES:
            arrays = [getattr(one.scan(scan_id), variable.name) for one in (store, two)]
            assert variable.sample_sha256(arrays[0]) == variable.sample_sha256(arrays[1]), variable.name
