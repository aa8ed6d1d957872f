"""The second machine: what its search adds, and that the page shows what was measured."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.record import published
from benchmarks.second_machine import BASE, PAGE, PARTS, RESULT, Bench, label, search, text_of


class Planted(Bench):
    """A printer whose edges gain so many nm, of 12 patterns, by each of its parts; scatter 0.05 nm."""

    def __init__(self, gain_nm: dict[str, float]):
        self._gain_nm = gain_nm

    def rows(self, name: str) -> list[dict[str, object]]:
        parts = name.split(" + ")[1:]
        scatter = np.random.default_rng(len(name)).normal(0, 0.05, 12)
        left = 3 - sum(self._gain_nm.get(part, 0.0) for part in parts)
        return [{"scan": f"P{i}", "edge_mean_nm": left + one} for i, one in enumerate(scatter)]


@pytest.mark.parametrize("planted", [(), ("diffusion",), ("backscatter", "etch bias")])
def test_the_search_adds_what_the_edges_lack_and_nothing_else(planted: tuple[str, ...]) -> None:
    found, rounds = search(Planted(dict.fromkeys(planted, 0.4)))
    assert set(found) == set(planted)
    assert len(rounds) == min(len(planted) + 1, len(PARTS))
    assert label(found) == " + ".join((BASE, *(part for part in PARTS if part in planted)))


def test_the_page_shows_the_record() -> None:
    record = json.loads(RESULT.read_text(encoding="utf-8"))
    assert published(PAGE, "second machine") == text_of(record)
