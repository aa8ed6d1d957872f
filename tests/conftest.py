"""Fixtures shared by all tests: where the measured prints and the reference fields are."""

from __future__ import annotations

import gc
import os
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from litho_data.foundation.faces import let_waiting_threads_sleep
from litho_data.reports import page as report
from tests.figures import require_legible

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Before any test loads torch.
let_waiting_threads_sleep()

# In place of a figure: half a second each, some hundreds of them.
BLANK = "data:image/svg+xml;base64,PHN2ZyB4bWxucz0iaHR0cDovL3d3dy53My5vcmcvMjAwMC9zdmciLz4="


_figure = report.Page.figure


def _legible(page: report.Page, figure: Figure, caption: str) -> None:
    require_legible(figure)
    _figure(page, figure, caption)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Figures are made and looked at, but drawn only for tests marked ``pictures``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report.Page, "figure", _legible)
        if item.get_closest_marker("pictures") is None:
            patch.setattr(report, "svg_address", lambda figure: BLANK)
        return (yield)


def pytest_collection_finish() -> None:
    """Modules that were loaded to collect stay: no search for garbage has to pass through them again."""
    gc.collect()
    gc.freeze()


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
