"""Test edges, areas and features of films against closed forms. Also test an electron-beam printer made of
parts.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from litho_data.store import PrintedScan
from litho_models.evaluation.benchmark import benchmark
from litho_models.evaluation.results import compare
from litho_models.fitting import TrainingConfig, fit
from litho_models.fitting.runs import train
from litho_models.fitting.small_models import fit_small_model
from litho_models.loop.bases import bases_for
from litho_models.loop.fits import Study
from litho_models.loop.model import FoldedBase
from litho_models.models import build_model
from litho_models.models.parts import etch, hill, illuminate, project
from litho_models.scan_terms import NuisanceProtocol
from litho_models.scoring.films import film_errors
from litho_models.scoring.records import Prediction, paired_scores
from litho_models.scoring.scores import score_model
from tests.litho_models.prints import make_scans, write_store

FILM_UM, PITCH_UM = 0.22, 0.004
GEOMETRY = {"pitch_um": PITCH_UM, "levels": 17, "level_height_um": FILM_UM / 16}
BARE = {"parts": ("spot", "etch"), "spot.sigma_um": 0.02}


def _disc(radius_px: float, size_px: int = 96) -> np.ndarray:
    y, x = np.mgrid[:size_px, :size_px] - (size_px - 1) / 2
    return (FILM_UM * np.clip(0.5 + radius_px - np.hypot(y, x), 0, 1)).astype(np.float32)


def _scan(height_um: np.ndarray, **fields: object) -> PrintedScan:
    level = np.rint(16 * height_um / FILM_UM).astype(np.uint8)
    own = {"id": "F1", "print_id": "F", "order": 0, "mask_level": level, "height_um": height_um}
    rest = {"valid": np.ones(level.shape, bool), "scan_to_layout": np.eye(3), "seen_by": "sem"}
    return PrintedScan(**{**own, **rest, **GEOMETRY, **fields})


def test_a_disc_that_is_too_large_is_off_by_the_difference_of_radii() -> None:
    scores = score_model(
        "m", [_scan(_disc(30))], [Prediction(_disc(31.5))], NuisanceProtocol.of_policy("none")
    )
    # The contours of the coverage agree with the disc to a twentieth of a pixel.
    assert scores.leading_nm == scores.edge_mean_nm == pytest.approx(1e3 * 1.5 * PITCH_UM, abs=0.05 * 4)
    # The area counts whole pixels. For a circle of radius 30 px it is right to some 10 of 2,800 pixels.
    assert scores.metrics["area_error_percent"] == pytest.approx(100 * (31.5**2 / 30**2 - 1), abs=0.8)
    assert scores.metrics["features_missing"] == scores.metrics["features_merged"] == 0
    assert scores.ssim is None


def test_a_film_without_a_predicted_edge_is_off_by_the_search_distance() -> None:
    scans, blank = [_scan(_disc(30), id="F1"), _scan(_disc(0), id="F2")], _disc(0)
    policy = NuisanceProtocol.of_policy("none")
    missed = score_model("blank", scans, [Prediction(blank)] * 2, policy)
    found = score_model("disc", scans, [Prediction(_disc(30)), Prediction(blank)], policy)
    # Edges are matched within 10 px of 4 nm. The second scan has no edge, in agreement with both models.
    assert missed.leading_of_scans_nm == {"F1": pytest.approx(40), "F2": 0}
    assert found.leading_nm == pytest.approx(0, abs=1e-3)
    assert paired_scores(missed, found).mean_nm == pytest.approx(20, abs=1e-3)


@pytest.mark.parametrize("instrument", ["afm", "profilometer", "confocal"])
def test_only_films_have_the_figures_of_films(instrument: str) -> None:
    scan = replace(_scan(_disc(30)), seen_by=instrument)
    scores = score_model("m", [scan], [Prediction(_disc(31))], NuisanceProtocol.of_policy("offset"))
    assert scores.leading_nm == scores.mae_datum_free_nm
    assert scores.ssim is not None
    assert not scores.metrics


def test_features_are_counted_as_lost_too_many_and_joined() -> None:
    measured = np.zeros((60, 60))
    measured[10:20, 10:20] = measured[10:20, 24:34] = measured[40:45, 40:45] = 1
    measured[30:50, 5:25] = 1
    expected = measured.copy()
    expected[40:45, 40:45] = 0  # one island is lost
    expected[14:16, 20:24] = 1  # two islands are joined
    expected[38:42, 12:16] = 0  # there is an extra hole
    expected[55, 55] = 1  # a dot does not count as a feature
    found = film_errors(measured, expected, 0.5)
    assert (found.missing, found.extra, found.merged) == (1, 1, 1)
    assert film_errors(expected, measured, 0.5)[1:] == (1, 1, 1)
    assert film_errors(measured, measured, 0.5) == (0, 0, 0, 0)


def test_a_spot_of_parts_is_the_sum_of_its_parts() -> None:
    torch.manual_seed(0)
    pattern = torch.rand(1, 1, 80, 80)
    widths = torch.tensor([0.008, 0.02])
    both = illuminate(pattern, [(0.7, widths[0]), (0.3, widths[1])], PITCH_UM, 20)
    alone = [illuminate(pattern, [(1.0, width)], PITCH_UM, 20) for width in widths]
    assert torch.allclose(both, 0.7 * alone[0] + 0.3 * alone[1], atol=1e-6)


def test_resists_are_monotonic_and_known_at_their_threshold() -> None:
    dose, threshold = torch.linspace(0, 1, 50), torch.tensor(0.4)
    for resist in (hill(dose, torch.tensor(5.0), threshold), project(dose, torch.tensor(5.0), threshold)):
        assert (resist.diff() > 0).all()
    assert float(hill(threshold, torch.tensor(5.0), threshold)) == pytest.approx(0.5)
    ends = project(torch.tensor([0.0, 1.0]), torch.tensor(5.0), threshold)
    assert ends.tolist() == pytest.approx([0, 1], abs=1e-6)


@pytest.mark.parametrize("bias_px", [-1.5, 0.0, 1.0])
def test_etching_moves_an_edge_by_its_bias_whatever_the_slope_of_the_resist(bias_px: float) -> None:
    x = torch.arange(60.0)
    for width in (4.0, 8.0):
        resist = torch.sigmoid((x - 30) / width).expand(1, 1, 8, 60)
        film = etch(resist, 0.5, bias_px * PITCH_UM, PITCH_UM)[0, 0, 0].numpy()
        edge = 1 + float(np.interp(0.5, film, np.arange(len(film))))
        # Using the slope at the pixel, not at the edge, adds bias³ / 6 width² = 0.04 px. Curvature adds more.
        assert edge == pytest.approx(30 - bias_px, abs=0.1)


def test_the_spot_of_a_printer_rounds_corners_and_a_blurred_edge_stays_where_it_is() -> None:
    model = build_model("e-beam", **BARE, fixed=("etch.bias_px",), **GEOMETRY)
    layout = torch.zeros(1, 1, 120, 120)
    layout[..., 40:80, 40:80] = FILM_UM
    with torch.no_grad():
        film = model(layout)[0, 0].numpy()
    assert film[60, 40] > FILM_UM / 2 > film[60, 39]
    assert film[40, 40] < FILM_UM / 2


def test_a_fit_finds_the_spot_the_threshold_and_the_bias_of_a_film() -> None:
    numbers = {"spot.sigma_um": 0.016, "etch.threshold": 0.45, "etch.bias_px": 0.5}
    true = build_model("e-beam", **(BARE | numbers), fixed=(), **GEOMETRY)
    level = 16 * (gaussian_filter(np.random.default_rng(0).normal(size=(2, 128, 128)), (0, 5, 5)) > 0)
    scans = []
    for number, one in enumerate(level.astype(np.uint8)):
        scan = _scan(np.zeros(one.shape, np.float32), mask_level=one, id=f"F{number}")
        with torch.no_grad():
            height = true(torch.from_numpy(scan.layout_um)[None, None])[0, 0].numpy()
        scans.append(replace(scan, height_um=height))
    found = build_model("e-beam", **BARE, fixed=(), **GEOMETRY)
    fit_small_model(found, scans, "none")
    # The fit stops when a step reduces the error by less than 1e-4. Without noise, the error is almost zero.
    for name, value in true.values.items():
        assert float(found.values[name]) == pytest.approx(float(value), rel=0.03, abs=0.05), name


def test_defaults_of_models_follow_the_pitch_of_another_printer() -> None:
    first, other = (build_model("features", pitch_um=pitch).config for pitch in (0.1, 0.004))
    assert other.sigmas_um == pytest.approx([0.04 * one for one in first.sigmas_um])
    near = build_model("features", pitch_um=0.2).config
    assert near.sigmas_um == first.sigmas_um
    network = build_model("pbl", pitch_um=0.004).config.surroundings
    assert network is not None
    assert max(network.shifts_um) == pytest.approx(0.04)


def test_training_fits_no_terms_to_films_unless_asked(tmp_path: Path) -> None:
    scans = [replace(scan, seen_by="sem") for scan in make_scans(4, 48)]
    store = write_store(tmp_path / "films.zarr", scans, instrument="sem")
    assert train(store, "affine", tmp_path / "run").config.nuisance == "none"
    asked = train(store, "affine", tmp_path / "asked", settings={"nuisance": "offset"})
    assert asked.config.nuisance == "offset"
    base = bases_for("features", Study.dealt(scans, 2), cache=tmp_path)["features"]
    assert isinstance(base, FoldedBase)
    free = fit("features", scans, TrainingConfig.of_recipe("fast", "features", nuisance="none")).model
    assert torch.equal(base.models[-1].weights, free.weights)


def test_a_benchmark_of_films_is_led_by_their_edges(tmp_path: Path) -> None:
    store = write_store(tmp_path / "films.zarr", make_scans(6, 64, datum_um=0.0), instrument="sem")
    result = benchmark(store, tmp_path / "out", models=("identity", "blur-table"), folds=2)
    assert (result.nuisance.policy, result.nuisance.background) == ("none", "none")
    assert result.training["blur-table"]["nuisance"] == "none"
    identity, blurred = result.scores
    assert identity.seen_by == "sem"
    assert identity.edge_mean_nm is not None
    assert blurred.edge_mean_nm is not None
    shift = identity.edge_mean_nm - blurred.edge_mean_nm
    assert result.paired[0].mean_nm == pytest.approx(shift)
    table = compare(tmp_path / "out", tmp_path / "out")
    assert (table["first_nm"] - table["second_nm"]).to_numpy() == pytest.approx(
        table["difference_nm"].to_numpy()
    )
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "mean error of the edges over" in page
    assert "features missing" in page
    assert "Noise that no model" not in page
