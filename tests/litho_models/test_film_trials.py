"""Test blind trials on films: which causes are planted, and which answers are right."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields
from types import SimpleNamespace

import pytest

from benchmarks import film_trials
from benchmarks.film_trials import BASES, EFFECTS, EMPTY, PLANTED, draw, run, text_of
from litho_data.virtual_fab.films import FilmKnobs
from litho_models.effects import CATALOGUE
from litho_models.models import build_model


@pytest.mark.parametrize("process", sorted(BASES))
def test_seven_of_ten_trials_have_one_cause_which_the_loop_could_name(process: str) -> None:
    trials = draw(process, 1)
    assert Counter(one.cause for one in trials) == Counter(PLANTED) + Counter({"": EMPTY})
    assert trials == draw(process, 1)
    assert trials != draw(process, 2)
    assert all(CATALOGUE[name].of_films for name in EFFECTS.values())
    plain = FilmKnobs()
    for one in trials:
        turned = {f.name for f in fields(FilmKnobs) if getattr(one.knobs, f.name) != getattr(plain, f.name)}
        assert turned - {"dose_error", "charging", "backscatter_um"} == ({one.cause} - {""})
    build_model(process, **BASES[process])


@pytest.mark.parametrize(
    ("named", "right"), [(["etch-bias"], True), ([], False), (["etch-bias", "x"], False)]
)
def test_an_answer_is_right_if_it_names_the_cause_and_nothing_else(
    tmp_path, monkeypatch: pytest.MonkeyPatch, named: list[str], right: bool
) -> None:
    row = SimpleNamespace(leading_nm=1.0)
    causes = [SimpleNamespace(name=one, confusable_with=[], knowledge="cause") for one in named]
    # A law does not name a cause.
    effects = [*causes, SimpleNamespace(name="edge-shift", knowledge="law")]
    result = SimpleNamespace(effects=effects, error=lambda stage: row)
    monkeypatch.setattr(film_trials, "simulate_films", lambda out, *more, **knobs: out.mkdir(parents=True))
    monkeypatch.setattr(film_trials, "build_dataset", lambda *more: None)
    monkeypatch.setattr(film_trials, "close_loop", lambda *more, **settings: result)
    trial = next(one for one in draw("e-beam", 1) if one.cause == "etch_bias_um")
    found = run(trial, "e-beam", 1, tmp_path)
    assert found["right"] == right
    record = {"processes": {"e-beam": [found, {**found, "planted": "nothing", "right": True}]}}
    table = text_of(record)
    assert f"| e-beam | etch_bias_um | {int(right)} of 1 | 1 of 1 | 1.00 → 1.00 nm |" in table
    assert "| e-beam | nothing | 1 of 1 |" in table
