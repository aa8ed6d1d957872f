"""Check the comparison of printers on the second machine, and that the page shows the measured results."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from benchmarks import film_design, film_trials, second_machine
from benchmarks.record import NOT_MEASURED, published
from benchmarks.second_machine import BASE, PAGE, RESULT, WHOLE, compared, judged, made, started, text_of
from litho_data.foundation.errors import InputError
from litho_data.store.schema import DatasetId
from litho_models.models.printers import Printer
from litho_models.splits.folds import Fold
from tests.litho_models.prints import make_scan

GEOMETRY: dict[str, Any] = {"pitch_um": 0.004, "levels": 17, "level_height_um": 0.01375}


def test_a_gain_in_every_pattern_is_significant_and_equal_errors_have_no_gain() -> None:
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
    # The bias of the bare printer is not fitted.
    assert not models[0].raw_etch__bias_px.requires_grad


def test_the_error_of_a_print_is_the_displacement_of_its_edges() -> None:
    scan = replace(make_scan(0, 128), seen_by="sem")
    level = np.zeros((128, 128), np.uint8)
    level[40:90, 40:90] = scan.levels - 1
    film = film_design.wanted_film(replace(scan, mask_level=level), 112)
    # All four edges of the square are displaced by one pixel, and its rounded corners by less.
    smaller = binary_erosion(film.mask_level) * film.height_um.max()
    for printed, pixels in ((film.height_um, 0.0), (smaller, 1.0)):
        found = judged(film, printed)
        assert found["edge_mean_nm"] == pytest.approx(1e3 * scan.pitch_um * pixels, rel=0.03)
        assert (found["missing"], found["extra"], found["merged"]) == (0, 0, 0)
    assert judged(film, 0 * film.height_um)["missing"] == 1
    layout = film_design.settings_for(scan, 64).layout
    assert (layout.pitch_um, layout.cell_um, layout.levels) == (scan.pitch_um, scan.pitch_um, scan.levels)


def store_of(sha256: str) -> SimpleNamespace:
    dataset = DatasetId(name="made", sha256=sha256)
    scan = make_scan(0, 64)
    return SimpleNamespace(
        name="made", sha256=sha256, dataset_id=dataset, locked_ids=[], scans=list, scan=lambda _: scan
    )


def test_results_of_another_store_are_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def loop(store: Path, *_: Any, **__: Any) -> SimpleNamespace:
        return SimpleNamespace(dataset=store_of(store.name).dataset_id)

    def fit(*_: Any) -> dict[str, Any]:
        return {"values": {}, "rows": [{"scan": sys.argv[1]}]}

    empty = {"text_of": lambda _: "", "summary": lambda *_: {}, "of_loop": lambda *_: {}}
    own = {"open_store": lambda path: store_of(path.name), "close_loop": loop, "fit_and_judge": fit}
    for name, function in {**empty, **own, "plan_folds": lambda *_: [Fold(0, [], [])]}.items():
        monkeypatch.setattr(second_machine, name, function)
    for name in ("a", "b"):
        out = tmp_path / f"{name}.json"
        words = [name, "--out", str(out), "--cache", str(tmp_path / "cache")]
        monkeypatch.setattr(sys, "argv", ["second_machine", *words])
        second_machine.main()
        assert json.loads(out.read_text())["rows"][BASE] == [{"scan": name}]
    monkeypatch.setattr(second_machine, "close_loop", lambda *_, **__: loop(Path("a")))
    with pytest.raises(InputError, match="loop in"):
        second_machine.main()


def test_films_are_corrected_with_models_of_their_own_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = []

    def printer(name: str, _store: Path, cache: Path, _settings: Any) -> None:
        places.append(cache / name)
        raise InputError("no training in this test")

    monkeypatch.setattr(film_design, "printer", printer)
    monkeypatch.setattr(film_design, "wanted_film", lambda scan: scan)
    monkeypatch.setattr(film_design, "open_store", lambda path: store_of(path.name))
    for name in ("a", "b"):
        monkeypatch.setattr(sys, "argv", ["film_design", name, "--cache", str(tmp_path)])
        with pytest.raises(InputError, match="no training"):
            film_design.main()
    assert len(set(places)) == 2


@pytest.mark.parametrize(
    ("name", "result", "text"),
    [
        ("second machine", RESULT, text_of),
        ("film design", film_design.RESULT, film_design.text_of),
        ("film trials", film_trials.RESULT, film_trials.text_of),
    ],
)
def test_the_page_shows_the_record(name: str, result: Path, text: Callable[[Any], str]) -> None:
    made = text(json.loads(result.read_text(encoding="utf-8"))) if result.is_file() else NOT_MEASURED
    assert published(PAGE, name) == made
