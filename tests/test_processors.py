"""Check that an imitated processor uses the instructions that its name says."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests import processors

CODE = "import torch; print(torch.backends.cpu.get_cpu_capability())"


@pytest.mark.parametrize("name", ["avx2", "avx512"])
def test_a_played_processor_uses_its_own_instructions(name):
    if not processors.can_play(name):
        pytest.skip(f"this processor cannot imitate {name}")
    environment = {**os.environ, **processors.PROCESSORS[name].environment}
    told = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True)
    assert told.stdout.split() == [name.upper()], told.stderr


def test_an_unknown_processor_is_refused(capsys):
    assert processors.main(["avx3"]) == 2
    assert "wanted native, avx2, avx512" in capsys.readouterr().err


def test_an_equal_processor_is_played_only_where_the_native_tests_do_not_run(monkeypatch):
    monkeypatch.setattr("torch.cpu.get_capabilities", lambda: {"avx2": True, "avx512_f": False})
    played = processors.why_left_out("avx2", ["native", "avx2"])
    assert played == "this processor gives the same numbers natively"
    assert not processors.why_left_out("avx2", ["avx2", "avx512"])
    assert processors.why_left_out("avx512", ["avx2", "avx512"]) == "this processor lacks the instructions"
    able = {"avx2": True, "avx512_f": True, "avx512_bf16": True}
    monkeypatch.setattr("torch.cpu.get_capabilities", lambda: able)
    assert not any(processors.why_left_out(name, processors.PROCESSORS) for name in processors.PROCESSORS)
