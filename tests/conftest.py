"""Fixtures shared by all tests: where the measured prints and the reference fields are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from litho_data.foundation.faces import let_waiting_threads_sleep

# Before any test loads torch.
let_waiting_threads_sleep()


@pytest.fixture(scope="session")
def measured_prints() -> Path:
    """The folder `neural-lithography` with `mask_ug/`, `afm_ug/`, `mask/`, `afm/`."""
    return _folder_or_skip("LITHO_DATA_DIR", "neural-lithography")


@pytest.fixture(scope="session")
def oracles() -> Path:
    """The folder with `gwyddion/` and `formats/`."""
    return _folder_or_skip("LITHO_ORACLE_DIR", "")


def _folder_or_skip(variable: str, name: str) -> Path:
    root = os.environ.get(variable)
    if not root:
        pytest.skip(f"{variable} is not set")
    folder = Path(root) / name
    if not folder.is_dir():
        pytest.skip(f"{variable} is set, but {name or 'its folder'} is not there")
    return folder.resolve()
