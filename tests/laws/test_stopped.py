"""Stop a command after any of its writes and give it again: the same result, and nothing else is left.

``python -m tests.stopped_commands NAME FOLDER every`` stops it after each.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.stopped_commands import COMMANDS

ROOT = Path(__file__).parents[2]
# One of each way to write a folder: a store, parts that grow, a whole folder, a plan from kept tiles, a file.
QUICK = ("build", "train-network", "freeze", "next-print", "export-design")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs forks")
@pytest.mark.parametrize(
    "name", [one if one in QUICK else pytest.param(one, marks=pytest.mark.long) for one in COMMANDS]
)
def test_a_stopped_command_that_is_given_again_ends_like_one_that_was_not(name: str, tmp_path: Path) -> None:
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "tests.stopped_commands", name, str(tmp_path / "place")]
    done = subprocess.run(words, cwd=ROOT, env=one_thread, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "all equal" in done.stdout
