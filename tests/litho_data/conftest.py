"""Provide one small store for all tests of the store. Tests that change it work on a copy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from litho_data.making.build import build_dataset
from tests.litho_data.campaigns import write_campaign


@pytest.fixture(scope="session")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with ``card.toml``, three scans, and the built ``prints.zarr``.

    Tests must not change the folder.
    """
    folder = tmp_path_factory.mktemp("campaign")
    build_dataset(write_campaign(folder), folder / "prints.zarr")
    return folder


@pytest.fixture
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write no report of a build, for tests that look only at the store. The report takes a fifth of the
    time.
    """
    monkeypatch.setattr("litho_data.making.build.write_report", lambda *_: None)


@pytest.fixture
def own_campaign(campaign: Path, tmp_path: Path) -> Path:
    """Return a copy of ``campaign`` that a test may change or damage."""
    return Path(shutil.copytree(campaign, tmp_path / "campaign"))
