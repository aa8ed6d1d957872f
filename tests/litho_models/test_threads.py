"""Check that threads of the numerical libraries sleep while they wait."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_LOADED = """
import importlib.abc, os, sys
class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "torch":
            print(os.environ.get("OMP_WAIT_POLICY"), os.environ.get("KMP_BLOCKTIME"))
            raise SystemExit(0)
sys.meta_path.insert(0, Watch())
"""


@pytest.mark.parametrize("given", [None, "ACTIVE"])
@pytest.mark.parametrize(
    "use",
    [
        "import litho_models; litho_models.load_frozen",
        "import litho_design; litho_design.design_hologram",
        "sys.argv = ['litho-models', 'zoo', 'list']; from litho_models.cli import main; main()",
        "sys.argv = ['litho-design', 'first', '--out', '/tmp']; from litho_design.cli import main; main()",
    ],
)
def test_threads_sleep_while_they_wait_unless_told_otherwise(use, given):
    """Check the setting, because spinning threads are ten times slower if another process is busy."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {} if given is None else {"OMP_WAIT_POLICY": given}
    words = [sys.executable, "-c", _LOADED + use]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.stdout.split() == [given or "PASSIVE", "0"], done.stderr
