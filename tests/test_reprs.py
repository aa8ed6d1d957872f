"""Check that the ``repr`` of objects for users is one line, or a small table in a notebook."""

from __future__ import annotations

import numpy as np

import litho_data
import litho_design
import litho_models
from litho_models.evaluation.results import Benchmark
from tests.litho_models.prints import make_scan, make_scans, write_store

PUBLISHED = "docs/results/neural-lithography/benchmark.json"


def test_the_repr_of_an_object_is_one_line(tmp_path):
    scan = litho_data.Scan(np.arange(6.0).reshape(2, 3), (0.1, 0.2), name="P11")
    assert repr(scan) == "<Scan P11: 2 x 3 px of 0.1 x 0.2 µm, heights 0 to 5 µm, 0 px missing>"
    assert "P0F1: 96 x 96 px of 0.1 µm, print 0, 13 levels of 0.1 µm, 100.0% valid" in repr(make_scan(1))
    store = litho_data.open_store(write_store(tmp_path / "prints.zarr", make_scans(3, 32)))
    assert "'made', 3 scans" in repr(store)
    shown = store._repr_html_()
    assert "<td>P1F0</td>" in shown
    assert repr(litho_models.load_frozen("zoo:pbl")).startswith("<FrozenSimulator pbl: 27,049 parameters")


def test_a_notebook_shows_maps_and_the_card_of_a_model(tmp_path):
    scan = litho_data.Scan(np.arange(6.0).reshape(2, 3), (0.1, 0.2), name="<P11>")
    shown = scan._repr_html_()
    assert "&lt;P11&gt;" in shown
    assert "height, µm: 0 … 5" in shown
    assert shown.count("data:image/png") == 1
    assert make_scan(1)._repr_html_().count("data:image/png") == 2
    assert "<td>27049</td>" in litho_models.load_frozen("zoo:pbl")._repr_html_()
    settings = litho_design.hologram_settings(
        changes={
            "layout.size_px": 64,
            "optics.distance_um": 12,
            "search.iterations": 1,
            "search.polish_rounds": 0,
            "window.yield_draws": 2,
        }
    )
    litho_design.design_hologram("ring", "none", tmp_path / "ring", settings=settings)
    design = litho_design.load_design(tmp_path / "ring")
    assert repr(design).startswith("<LoadedDesign hoe in ")
    assert repr(design).endswith(": 64 px of 0.1 µm, designed through none>")
    assert design._repr_html_().count("data:image/png") == 2


def test_the_repr_of_a_result_names_its_dataset_and_counts_its_entries():
    result = Benchmark.read(PUBLISHED)
    shown = repr(result)
    assert f"scores: {len(result.scores)}" in shown
    assert "dataset: neural-lithography" in shown
    # The line omits the hash, whose 64 digits would not fit and do not help readers.
    assert len(shown) < 400
    assert f"<td>{len(result.scores)}</td>" in result._repr_html_()
