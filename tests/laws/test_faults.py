"""Check that each fault of ``tests/faults.py`` can still be put in: its text and its test files exist."""

from __future__ import annotations

import pytest

from tests.faults import FAULTS, ROOT, Fault


@pytest.mark.parametrize("fault", FAULTS, ids=[one.name for one in FAULTS])
def test_a_fault_can_still_be_put_in(fault: Fault) -> None:
    assert (ROOT / fault.file).read_text(encoding="utf-8").count(fault.right) == 1
    assert fault.right != fault.wrong
    files = fault.tests.partition(" -k ")[0].split()
    assert files
    assert all((ROOT / file).is_file() for file in files)
