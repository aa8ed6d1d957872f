"""Test what all benchmarks share: how they put text on a page, and what their records state."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.record import origin, publish, published
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts


def test_publishing_replaces_the_text_between_the_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("top\n<!-- a: written by the benchmark -->\nold\n<!-- end of a -->\nbottom\n")
    publish(page, "a", "| new |")
    publish(page, "a", "| newer |")
    assert published(page, "a") == "| newer |"
    assert page.read_text().startswith("top\n")
    assert page.read_text().endswith("-->\nbottom\n")
    with pytest.raises(InputError, match="marks"):
        publish(page, "b", "x")


def test_a_record_states_the_command_and_commit_that_made_it(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["speed.py", "--repeats", "1"])
    record = origin()
    assert record["command"].endswith("--repeats 1")
    assert record["commit"] == run_facts()["commit"]
    assert record["versions"]["numpy"] == np.__version__
    # A module is recorded in the form in which it was started.
    asked = "from benchmarks.record import origin; print(origin()['command'])"
    (tmp_path / "asked.py").write_text(asked)
    places = os.pathsep.join([str(Path(__file__).parents[2]), str(tmp_path)])
    said = subprocess.run(
        [sys.executable, "-m", "asked", "--size", "3"],
        env=os.environ | {"PYTHONPATH": places}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert said.stdout.strip() == "python -m asked --size 3"
