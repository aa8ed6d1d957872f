"""The second machine: how printers are compared, and that the page shows what was measured."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from benchmarks.record import published
from benchmarks.second_machine import BASE, PAGE, RESULT, WHOLE, compared, made, started, text_of
from litho_models.models.printers import Printer

GEOMETRY: dict[str, Any] = {"pitch_um": 0.004, "levels": 17, "level_height_um": 0.01375}


def test_a_gain_in_every_pattern_is_no_chance_and_none_is() -> None:
    scatter = np.random.default_rng(0).normal(0, 0.05, 12)
    before = [{"edge_mean_nm": 3 + one} for one in scatter]
    better = compared(before, [{"edge_mean_nm": 2.8 + one / 2} for one in scatter])
    assert better["gain_nm"] == pytest.approx(0.2 + scatter.mean() / 2)
    assert better["better"] == [12, 12]
    assert better["p"] < 0.01
    assert compared(before, before)["gain_nm"] == 0


def test_the_printer_of_all_parts_can_start_where_the_bare_one_ended() -> None:
    bare = {"spot.sigma_um": 0.017, "etch.threshold": 0.42}
    models: list[Any] = [made(BASE, bare, **GEOMETRY), made(WHOLE, started(bare), **GEOMETRY)]
    assert all(isinstance(model, Printer) for model in models)
    spots = [models[0].values["spot.sigma_um"].item(), models[1].values["two-spots.sigma_um"].item()]
    assert spots == pytest.approx([0.017, 0.017])
    assert models[0].values["etch.threshold"].item() == pytest.approx(0.42)
    assert models[1].values["hill.threshold"].item() == pytest.approx(0.42)
    # A bias is no number of the bare one.
    assert not models[0].raw_etch__bias_px.requires_grad


def test_the_page_shows_the_record() -> None:
    record = json.loads(RESULT.read_text(encoding="utf-8"))
    assert published(PAGE, "second machine") == text_of(record)
