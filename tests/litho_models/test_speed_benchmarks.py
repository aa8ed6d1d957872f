"""Check that the speed benchmark measures every model, and that its page quotes the results."""

from __future__ import annotations

import json

from benchmarks import speed
from benchmarks.record import published


def test_the_page_quotes_the_committed_measurement():
    record = json.loads(speed.OUT.read_text(encoding="utf-8"))
    assert published(speed.PAGE, "speed") == speed.as_markdown(record)
    assert [row["model"] for row in record["models"]] == list(speed.MODELS)


def test_times_on_a_gpu_are_wall_clock_times():
    record = json.loads(speed.OUT.read_text(encoding="utf-8"))
    for device, clock in (("CPU", "processor"), ("NVIDIA H200", "wall-clock")):
        page = speed.as_markdown(record | {"device": device})
        assert f"The times of prediction and design are {clock} times" in page


def test_a_model_is_measured_in_a_process_of_its_own(tmp_path, monkeypatch):
    out = tmp_path / "out.json"
    words = ["speed", "--models", "physics", "--size-px", "64", "--out", str(out)]
    monkeypatch.setattr("sys.argv", words)
    speed.main()
    (row,) = json.loads(out.read_text())["models"]
    assert row["model"] == "physics"
    assert min(row["predict_s"], row["iteration_s"], row["training_s"]) > 0
    assert 0 < row["peak_gib"] < 4
