"""Check that every typical mistake of a user is answered in one line that says what to do. Check also that
the faults of ``tests/faults.py`` can still be put into the code.
"""

from __future__ import annotations

import re

import pytest

from tests.faults import FAULTS, ROOT
from tests.mistakes import MISTAKES, answer, world

ALL = [(did, mistake) for mistakes in MISTAKES.values() for did, mistake in mistakes.items()]


@pytest.fixture(scope="module")
def files():
    with world() as folder:
        yield folder


@pytest.mark.parametrize(("did", "mistake"), ALL, ids=[did for did, _ in ALL])
def test_a_mistake_is_answered_in_one_line(did, mistake, files):
    before = sorted(path.name for path in files.iterdir())
    code, said = answer(mistake)
    *skipped, last = said.strip().splitlines()
    assert code == (2 if mistake.startswith("litho-") else "InputError"), said
    # Lines that report progress, or the scans that a build skips, do not count.
    assert [
        line
        for line in skipped
        if not (line.startswith(("skipped ", "building ", "training ", "checking ")) or "is at work" in line)
    ] == []
    # The answer says what was given and what is wanted, or what to do. It is never Python's own message.
    assert any(word in last for word in ("wanted", ";", ": no ")), last
    assert not any(word in last for word in ("Errno", "PosixPath", "Traceback", "codec")), last
    assert sorted(path.name for path in files.iterdir()) == before


def test_the_right_text_of_every_fault_stands_once_in_its_file():
    found = {fault.name: (ROOT / fault.file).read_text("utf-8").count(fault.right) for fault in FAULTS}
    assert {name: count for name, count in found.items() if count != 1} == {}


def test_the_tests_of_every_fault_exist():
    for fault in FAULTS:
        file, *selected = fault.tests.split()
        names = re.findall(r"def test_(\w+)", (ROOT / file).read_text("utf-8"))
        assert [name for name in names if "-k" not in selected or selected[-1] in name], fault.name
