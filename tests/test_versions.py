"""The three commands say their version, and keep asking for a command without one."""

from __future__ import annotations

import importlib

import pytest
from typer.testing import CliRunner

import litho_data


@pytest.mark.parametrize("package", ["litho_data", "litho_models", "litho_design"])
def test_every_command_says_its_version(package):
    app = importlib.import_module(f"{package}.cli.app").app
    said = CliRunner().invoke(app, ["--version"])
    assert (said.exit_code, said.stdout.strip()) == (0, litho_data.__version__)
    assert "Usage" in CliRunner().invoke(app, []).output
