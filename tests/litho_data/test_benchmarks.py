"""The benchmarks of this package measure what they say, and the pages quote what was measured."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks import build as build_benchmark
from benchmarks import height_sigma as height_sigma_benchmark
from benchmarks import levelling as levelling_benchmark
from benchmarks import mixed_up as mixed_up_benchmark
from benchmarks import readers as readers_benchmark
from benchmarks import registration as registration_benchmark
from benchmarks import tip as tip_benchmark
from benchmarks.record import publish, published
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts
from tests.quoted import require_quoted


@pytest.mark.parametrize(
    "benchmark",
    [
        build_benchmark,
        levelling_benchmark,
        height_sigma_benchmark,
        mixed_up_benchmark,
        readers_benchmark,
        registration_benchmark,
        tip_benchmark,
    ],
)
def test_the_page_quotes_the_committed_measurement(benchmark):
    require_quoted(benchmark)


def test_the_page_quotes_the_builds_in_turns():
    name = build_benchmark.IN_TURNS
    record = json.loads(build_benchmark.RESULT.with_name(name).read_text(encoding="utf-8"))
    assert published(build_benchmark.PAGE, name) == build_benchmark.compared(record)


def test_publishing_replaces_what_stands_between_the_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("top\n<!-- a: written by the benchmark -->\nold\n<!-- end of a -->\nbottom\n")
    publish(page, "a", "| new |")
    publish(page, "a", "| newer |")
    assert published(page, "a") == "| newer |"
    assert page.read_text().startswith("top\n")
    assert page.read_text().endswith("-->\nbottom\n")
    with pytest.raises(InputError, match="marks"):
        publish(page, "b", "x")


def test_a_record_says_by_which_command_and_commit_it_was_made(tmp_path, monkeypatch):
    file = tmp_path / "levelling.json"
    options = ["--scan", str(tmp_path / "scan.npy"), "--unit", "um", "--repeats", "1", "--out", str(file)]
    monkeypatch.setattr("sys.argv", ["levelling.py", *options])
    monkeypatch.setattr(levelling_benchmark, "measure", lambda height_um, repeats: [])
    np.save(tmp_path / "scan.npy", np.zeros((64, 64)))
    levelling_benchmark.main()
    record = json.loads(file.read_text())
    assert record["command"].endswith(" ".join(options))
    assert record["commit"] == run_facts()["commit"]
    assert record["versions"]["numpy"] == np.__version__
    # A module is named as it is started.
    asked = "from benchmarks.record import origin; print(origin()['command'])"
    (tmp_path / "asked.py").write_text(asked)
    places = os.pathsep.join([str(Path(__file__).parents[2]), str(tmp_path)])
    said = subprocess.run(
        [sys.executable, "-m", "asked", "--size", "3"],
        env=os.environ | {"PYTHONPATH": places}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert said.stdout.strip() == "python -m asked --size 3"


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_cost_counts_the_memory_and_the_work_of_descendants():
    child = (
        "import time; x = bytearray(b'1') * (200 << 20); t = time.process_time()\n"
        "while time.process_time() < t + 0.3: pass"
    )
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}], check=True)"
    started = time.perf_counter()
    cost = build_benchmark.cost_of([sys.executable, "-c", parent])
    assert 0.3 < cost.wall_s < time.perf_counter() - started + 1e-3
    assert cost.cpu_s > 0.3
    # Two interpreters of about 10 MiB each beside the 200.
    assert 200 < cost.peak_mib < 300


def test_levelling_is_compared_where_gwyddions_time_is_known():
    rows = levelling_benchmark.measure(levelling_benchmark.artificial_scan(), repeats=1)
    known = {row["method"]: row for row in rows if row["ratio"] is not None}
    assert set(known) == set(levelling_benchmark.GWYDDION_MS)
    for row in known.values():
        # Both times are rounded to four digits after the point.
        assert row["ratio"] == pytest.approx(row["best_ms"] / row["gwyddion_ms"], abs=2e-4)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_virtual_scans_of_the_benchmark_can_be_built(tmp_path: Path):
    card = build_benchmark.write_virtual_scans(tmp_path / "virtual", 3, 128)
    (run,) = build_benchmark.measure("virtual scans", card, tmp_path, workers=2, repeats=1)
    assert (run["scans"], run["skipped"]) == (3, 0)
    assert np.isfinite([*run["wall_s"], *run["cpu_s"], *run["peak_mib"]]).all()
