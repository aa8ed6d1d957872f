"""`litho-data build --dask` with one worker, with two, and with two of which one is killed, in turns.

    python -m benchmarks.cluster --out FILE.json [--scans 1000] [--size 128] [--turns 1] [--publish]

All workers have one thread. The virtual scans are those of benchmarks/build.py; making them is not measured.
A wall time tells of the machine too: so processor times stand beside it, of the workers, of the client
(which puts the store together) and of the scheduler (whose process watches them too), and with them the least
wall time that so much work can take. --publish also writes the table into docs/cluster.md.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.build import resident_bytes, write_virtual_scans
from benchmarks.record import conclude, options, origin, usable_cores
from litho_data.foundation.commands import run_script
from litho_data.foundation.workers import ONE_THREAD

PAGE = Path(__file__).parents[1] / "docs" / "cluster.md"
RESULT = PAGE.parent / "results" / "build" / "cluster.json"
NAME = "cluster.json"
WAYS = {"one worker": (1, False), "two workers": (2, False), "two, one killed half-way": (2, True)}
_SAMPLED_EVERY_S = 2.0
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure, print, write."""
    parser = options(__doc__, "write the table into docs/cluster.md", RESULT)
    parser.add_argument("--scans", type=int, default=1000)
    parser.add_argument("--size", type=int, default=128, help="side of their layouts, pixels")
    parser.add_argument("--turns", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        card = write_virtual_scans(Path(scratch) / "virtual", arguments.scans, arguments.size)
        runs = [
            {"way": way, **measure(card, Path(scratch) / "prints.zarr", *settings)}
            for _ in range(arguments.turns)
            for way, settings in WAYS.items()
        ]
    record = {
        "schema": "litho-data/benchmark-cluster/1",
        "machine": {"cores": usable_cores()},
        **origin(),
        "scans": arguments.scans,
        "size_px": arguments.size,
        "runs": runs,
    }
    conclude(record, as_markdown(record), arguments.out, PAGE, NAME, published=arguments.publish)


def measure(card: Path, store: Path, workers: int, kill: bool) -> dict[str, Any]:
    """One build on a cluster of its own; memory and processor time of its workers are read from /proc."""
    from distributed import Client, LocalCluster

    os.environ.update(ONE_THREAD)
    load = os.getloadavg()[0]
    samples: dict[int, list[tuple[int, float, float]]] = {}
    killed = not kill
    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(workers)
        # Processes are started and have the libraries of a build before the clock starts.
        client.run(_import_build)
        pids = list(client.run(os.getpid).values())
        idle_s = {pid: _cpu_s(pid) for pid in pids}
        command = [sys.executable, "-c", "from litho_data.cli.app import main; main()", "build", str(card)]
        command += ["--out", str(store), "--dask", cluster.scheduler_address]
        pieces = store.parent / f".{store.name}.partial" / "pieces"
        total = len(list(card.parent.glob("scans/*.npy")))
        started, scheduler_s = time.perf_counter(), time.process_time()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            finished = len(list(pieces.glob("*.json"))) if pieces.exists() else 0
            if len(pids) < workers or not all(resident_bytes(pid) for pid in pids):
                pids = list(client.run(os.getpid).values())
            for pid in pids:
                sample = finished, resident_bytes(pid) / 2**20, _cpu_s(pid)
                samples.setdefault(pid, []).append(sample)
            if not killed and finished >= total // 2:
                os.kill(pids[0], signal.SIGKILL)
                killed = True
            time.sleep(_SAMPLED_EVERY_S)
        wall_s, scheduler_s = time.perf_counter() - started, time.process_time() - scheduler_s
        process.returncode = os.waitstatus_to_exitcode(ended[1])
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    result = json.loads((store.parent / "prints-report" / "build.json").read_text(encoding="utf-8"))
    worker_s = sum(seen[-1][2] - idle_s.get(pid, 0.0) for pid, seen in samples.items())
    client_s = ended[2].ru_utime + ended[2].ru_stime
    return {
        "workers": workers,
        "killed": kill,
        "load": [round(load, 1), round(os.getloadavg()[0], 1)],
        "wall_s": round(wall_s, 1),
        "worker_cpu_s": round(worker_s, 1),
        "client_cpu_s": round(client_s, 1),
        "scheduler_cpu_s": round(scheduler_s, 1),
        # A worker cannot be faster than its half of the work, nor all than the cores.
        "least_wall_s": round(
            max(worker_s / workers, client_s, (worker_s + client_s + scheduler_s) / usable_cores()), 1
        ),
        "worker_mib": {str(part): round(_mib_at(samples, part * total), 1) for part in (0.1, 0.5, 1.0)},
        "scans": result["n_scans"],
        "skipped": len(result["skipped"]),
        "dataset_sha256": result["dataset"]["sha256"],
    }


def as_markdown(record: Mapping[str, Any]) -> str:
    """The runs as a table, and what they say."""
    runs: Sequence[Mapping[str, Any]] = record["runs"]
    rows = [
        f"| {run['way']} | {run['wall_s']:.0f} | {run['least_wall_s']:.0f} | {run['worker_cpu_s']:.0f} "
        f"| {run['client_cpu_s']:.0f} | {run['scheduler_cpu_s']:.0f} "
        f"| {', '.join(f'{mib:.0f}' for mib in run['worker_mib'].values())} "
        f"| {run['load'][0]:g} – {run['load'][1]:g} | `{run['dataset_sha256'][:12]}` |"
        for run in runs
    ]
    gains = {name: runs[0][name] / runs[1][name] for name in ("wall_s", "least_wall_s")}
    return (
        f"{record['scans']} virtual scans of {record['size_px']} px, workers of one thread, "
        f"{record['machine']['cores']} cores. Two workers are {gains['wall_s']:.2f} × as fast as one, "
        f"by the least wall {gains['least_wall_s']:.2f} ×.\n\n"
        "| | wall, s | least wall, s | workers' processor time, s | client's, s | scheduler's, s "
        "| memory of the largest worker after 10, 50, 100 % of the scans, MiB | load | dataset |\n"
        "|---|---|---|---|---|---|---|---|---|\n" + "\n".join(rows)
    )


def _import_build() -> None:
    import litho_data.build.build  # noqa: F401


def _mib_at(samples: Mapping[int, Sequence[tuple[int, float, float]]], finished: float) -> float:
    """Largest resident set of a worker up to so many finished scans."""
    return max(mib for seen in samples.values() for done, mib, _ in seen if done <= finished)


def _cpu_s(pid: int) -> float:
    """User and system time of a process; 0 where it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


if __name__ == "__main__":
    run_script(main)
