"""Fixtures shared by the tests of the models."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module

import pytest


@pytest.fixture(scope="session", autouse=True)
def few_like_pixels() -> Iterator[None]:
    """Estimate noise floors from few pixels. Tests of the value of a floor set their own number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("litho_models.scoring.like_layouts._PIXELS_PER_SCAN", 400)
        yield


@pytest.fixture
def pageless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the pages of evaluations and benchmarks, which take longer than the rest of them."""
    for name in ("evaluate.write_evaluation_report", "benchmark.write_benchmark_report"):
        monkeypatch.setattr(f"litho_models.evaluation.{name}", lambda *args: None)


@pytest.fixture(scope="module")
def rough_networks() -> Iterator[None]:
    """Start the fits of networks from a fit of two numbers, and fit their features to few pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("litho_models.fitting.fit"), "FIRST_MODEL", "affine")
        patch.setattr(import_module("litho_models.fitting.pixels"), "FITTED_PX", 2**11)
        yield
