"""Test the virtual fab for films: its knobs move edges as stated, and a build accepts its files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from litho_data import build_dataset, open_store
from litho_data.cli.app import main
from litho_data.foundation.errors import InputError
from litho_data.readers import read_layout
from litho_data.virtual_fab.films import (
    FILM_PRINTERS,
    FilmKnobs,
    edge_distance_px,
    film_knobs,
    micrograph,
    simulate_films,
)

BEAM, LENS = FILM_PRINTERS["e-beam"], FILM_PRINTERS["projection"]
PLAIN = FilmKnobs()


def stripes(width_px: int = 32, size_px: int = 128) -> np.ndarray:
    """Return alternating stripes of film and ground, each ``width_px`` wide."""
    return np.tile(np.arange(size_px) // width_px % 2, (size_px, 1))


def film_width_px(distance_px: np.ndarray, count: int = 2) -> float:
    """Return the mean width of ``count`` stripes of film, in pixels of the layout."""
    return float(np.mean(distance_px > 0)) * distance_px.shape[1] / 4 / count


@pytest.mark.parametrize("knobs", [PLAIN, FilmKnobs(diffusion_um=0.02), FilmKnobs(backscatter=0.3)])
def test_a_threshold_of_half_the_dose_keeps_straight_edges_in_place(knobs: FilmKnobs) -> None:
    # Film and ground have equal areas. By symmetry the edges stay in place, within a quarter of a pixel.
    assert film_width_px(edge_distance_px(stripes(), BEAM, knobs)) == pytest.approx(32, abs=0.26)


def test_a_bias_and_a_dose_move_edges_by_the_stated_amount() -> None:
    wide = edge_distance_px(stripes(), BEAM, FilmKnobs(etch_bias_um=0.008))
    # Each edge is known to a quarter of a pixel.
    assert film_width_px(wide) == pytest.approx(32 + 2 * 2, abs=0.51)
    # The distance at which an edge blurred by a Gaussian of 5 px falls to 0.5 / 1.2 of its height is a
    # quantile of the Gaussian.
    dosed = edge_distance_px(stripes(), BEAM, FilmKnobs(dose_error=0.2))
    assert film_width_px(dosed) == pytest.approx(32 + 2 * 5 * 0.2104, abs=0.51)


def test_a_lens_sees_a_wide_edge_at_a_quarter_of_the_light_and_defocus_rounds() -> None:
    coherent = replace(LENS, source=1e-6, threshold=0.25)
    assert film_width_px(edge_distance_px(stripes(), coherent, PLAIN)) == pytest.approx(32, abs=0.51)
    island = np.zeros((64, 64))
    island[28:36, 28:36] = 1
    sharp, blurred = (edge_distance_px(island, LENS, FilmKnobs(defocus_um=z)) for z in (0.0, 1.5))
    assert (blurred > 0).sum() < (sharp > 0).sum()


def test_a_micrograph_has_a_bright_rim_and_charges() -> None:
    distance = edge_distance_px(stripes(), BEAM, PLAIN)
    grey = micrograph(distance, PLAIN, np.random.default_rng(0)).astype(float)
    rim = (distance > 0.5) & (distance < 1.5)
    assert grey[rim].mean() > grey[distance > 8].mean() > grey[distance < -1].mean()
    charged = micrograph(distance, FilmKnobs(charging=0.3), np.random.default_rng(0)).astype(float)
    assert charged[:, -128:].mean() > 1.3 * charged[:, :128].mean()


def test_a_run_is_built_into_a_store_of_the_films_that_were_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = "simulate --preset e-beam --count 1 --size-px 160 --knob etch_bias_um=0.004 --out"
    monkeypatch.setattr("sys.argv", ["litho-data", *words.split(), str(tmp_path / "fab")])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    truth = json.loads((tmp_path / "fab" / "truth" / "films.json").read_text())
    assert truth["knobs"]["etch_bias_um"] == 0.004
    build_dataset(tmp_path / "fab" / "raw" / "card.toml", tmp_path / "films.zarr")
    for scan in open_store(tmp_path / "films.zarr").scans():
        distance = np.load(tmp_path / "fab" / "truth" / f"{scan.id}.npy")
        share = (distance > 0).reshape(160, 4, 160, 4).mean(axis=(1, 3))
        # The contour follows the flank of the rim and is displaced by a fraction of a pixel. At edges, this
        # changes the height by a few per cent.
        off = np.abs(scan.height_um / BEAM.film_um - share)[scan.usable]
        assert off.mean() < 0.05
        assert scan.usable.mean() > 0.8


def test_shifted_edges_are_not_taken_for_defects_or_for_a_scale(tmp_path: Path, without_report: None) -> None:
    """Check a film whose edges are all shifted by 2.5 px, which is many times the usual misfit."""
    knobs = FilmKnobs(etch_bias_um=0.01)
    card = simulate_films(tmp_path / "fab", "e-beam", count=1, size_px=208, seed=303, knobs=knobs)
    build_dataset(card, tmp_path / "films.zarr")
    (scan,) = open_store(tmp_path / "films.zarr").scans()
    # The microscope does not shift, rotate or scale. A fit to the layout as drawn takes the shift for a scale
    # of 0.99, which displaces the outer edges of the field by a pixel.
    assert scan.scan_to_layout[:2, :2] == pytest.approx(np.eye(2), abs=0.003)
    assert scan.scan_to_layout[:2, 2] == pytest.approx(np.zeros(2), abs=0.3 * BEAM.pitch_um)
    assert scan.usable.mean() > 0.8


def test_a_field_lies_alone_on_bare_ground(tmp_path: Path) -> None:
    knobs = FilmKnobs(backscatter=0.6, backscatter_um=0.08)
    simulate_films(tmp_path / "fab", "e-beam", count=1, size_px=96, knobs=knobs)
    level = read_layout(tmp_path / "fab" / "raw" / "layouts" / "F00.tif")
    assert not level[:12].any()
    assert level.any()
    wide = edge_distance_px(np.pad(level, 200), BEAM, knobs)[800:-800, 800:-800]
    # Edges are searched in steps of a quarter of a pixel. A wider canvas moves them by at most one step.
    assert np.abs(wide - np.load(tmp_path / "fab" / "truth" / "F00.npy")).max() < 0.3
    # If the field were repeated periodically, more electrons would scatter back, and more film would stay.
    assert (edge_distance_px(level, BEAM, knobs) > 0).sum() > 1.05 * (wide > 0).sum()


def test_unknown_knobs_are_refused() -> None:
    assert film_knobs(["backscatter=0.2"]).backscatter == 0.2
    for word, said in {"tilt=1": "tilt", "backscatter=much": "a number", "backscatter": "a number"}.items():
        with pytest.raises(InputError, match=said):
            film_knobs([word])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["dose_error=nan"], "dose_error"),
        (["dose_error=-1"], "dose_error"),
        (["backscatter=-1"], "backscatter, "),
        (["backscatter_um=0"], "backscatter_um"),
        (["diffusion_um=-0.01"], "diffusion_um"),
        (["etch_bias_um=inf"], "etch_bias_um"),
        (["defocus_um=nan"], "defocus_um"),
        (["charging=-inf"], "charging"),
        (["diffusion_um=0.01", "charging=0.1", "diffusion_um=0.02"], "diffusion_um more than once"),
    ],
)
def test_knobs_that_no_process_can_have_are_refused(words: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said) as refused:
        film_knobs(words)
    assert "wanted" in str(refused.value)


def test_an_electron_beam_has_no_lens_to_defocus(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="defocus_um, got the process e-beam"):
        simulate_films(tmp_path / "fab", "e-beam", count=1, knobs=FilmKnobs(defocus_um=1.0))
    assert not list(tmp_path.iterdir())
