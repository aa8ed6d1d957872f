"""Fixtures shared by all tests: the folders of the measured prints and of the reference fields."""

from __future__ import annotations

import gc
import os
from collections.abc import Generator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from litho_data.foundation.faces import let_waiting_threads_sleep
from litho_data.reports import page as report
from tests.figures import require_legible, undrawn

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# This must run before any test loads torch.
let_waiting_threads_sleep()

_figure = report.Page.figure


def _legible(page: report.Page, figure: Figure, caption: str) -> None:
    require_legible(figure)
    _figure(page, figure, caption)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Check every figure that a test makes. Figures are drawn only in tests marked ``pictures``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report.Page, "figure", _legible)
        with undrawn() if item.get_closest_marker("pictures") is None else nullcontext():
            return (yield)


def pytest_collection_finish() -> None:
    """Exclude the modules loaded during collection from all later garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def measured_prints() -> Path:
    """Return the folder `neural-lithography`, which contains `mask_ug/`, `afm_ug/`, `mask/` and `afm/`."""
    return _folder_or_skip("LITHO_DATA_DIR", "neural-lithography")


@pytest.fixture(scope="session")
def oracles() -> Path:
    """Return the folder of reference fields, which contains `gwyddion/` and `formats/`."""
    return _folder_or_skip("LITHO_ORACLE_DIR", "")


def _folder_or_skip(variable: str, name: str) -> Path:
    root = os.environ.get(variable)
    if not root:
        pytest.skip(f"{variable} is not set")
    folder = Path(root) / name
    if not folder.is_dir():
        pytest.skip(f"{variable} is set, but {name or 'its folder'} does not exist")
    return folder.resolve()
