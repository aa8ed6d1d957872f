"""Check that the loop finds the edge effect that a bare printer lacks. The scans are micrographs of films."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_models import close_loop
from litho_models.effects import FieldContext, get_effect
from litho_models.effects.films import FILM_LAWS
from litho_models.models import build_model
from tests.litho_models.prints import write_store

FILM_UM, PITCH_UM = 0.22, 0.004
GEOMETRY = {"pitch_um": PITCH_UM, "levels": 17, "level_height_um": FILM_UM / 16}
BARE = {"parts": ("spot", "etch"), "spot.sigma_um": 0.02, "fixed": ("etch.bias_px",)}


def _context(layout_um: torch.Tensor) -> FieldContext:
    return FieldContext(layout_um, PITCH_UM, FILM_UM)


def _film(distance_px: np.ndarray) -> torch.Tensor:
    """Return the heights (1, 1, y, x) in µm of a film whose edge is where the signed distance is zero."""
    return torch.from_numpy(FILM_UM / (1 + np.exp(-4 * distance_px)))[None, None]


def _disc(radius_px: float, size_px: int = 97) -> np.ndarray:
    y, x = np.mgrid[:size_px, :size_px] - size_px // 2
    return radius_px - np.hypot(y, x)


def _radius_px(film: torch.Tensor) -> float:
    return float(np.sqrt(float(film.sum()) / FILM_UM / np.pi))


@pytest.mark.parametrize("bias_px", [-3.0, 1.0, 3.0])
def test_a_bias_moves_every_edge_by_itself(bias_px: float) -> None:
    film = _film(_disc(25))
    moved = get_effect("etch-bias")(film, {"bias_px": bias_px}, _context(film))
    # Cubic interpolation of a rim one pixel wide has an error of some hundredths of a pixel. The edge is
    # taken as straight up to 0.75 px beside its crossing with the grid, which adds 0.75² / (2 * 25) px.
    assert _radius_px(moved) - _radius_px(film) == pytest.approx(bias_px, abs=0.03 + 0.75**2 / 50)


@pytest.mark.parametrize("bias_px", [-4.0, 4.0])
def test_films_and_gaps_narrower_than_twice_the_shift_vanish(bias_px: float) -> None:
    stripe = np.sign(-bias_px) * (3 - np.abs(np.arange(97) - 48.0))
    film = _film(np.tile(stripe, (97, 1)))
    moved = get_effect("etch-bias")(film, {"bias_px": bias_px}, _context(film))
    # The middle is 3 px from the old edges, so 1 px beyond the new ones, where the rim is 1 / (1 + e^4).
    assert torch.allclose(moved, torch.full_like(film, FILM_UM * (bias_px > 0)), atol=0.02 * FILM_UM)


def test_diffusion_leaves_straight_edges_and_shrinks_a_disc_by_its_curvature() -> None:
    values, disc = {"variance_px2": 3**2}, _film(_disc(20))
    spread = get_effect("resist-diffusion")
    # A disc blurred by s reaches half height at a radius smaller by s² / 2R, to second order in s / R.
    shrunk_px = _radius_px(disc) - _radius_px(spread(disc, values, _context(disc)))
    assert shrunk_px == pytest.approx(3**2 / (2 * 20), rel=0.05)
    straight = _film(np.tile(np.arange(97) - 48.3, (97, 1)))
    assert torch.allclose(spread(straight, values, _context(straight)), straight, atol=0.02 * FILM_UM)


def test_a_shift_by_density_leaves_straight_edges_and_shrinks_a_disc_by_its_curvature() -> None:
    values, law = {"bias_px": 5.0, "length_px": 10.0}, get_effect("edge-shift-by-density")
    disc = _film(_disc(40, 129))
    # The Gaussian mean (sd L) at the edge of a disc is 1/2 - L / (2R sqrt(2 pi)), to first order in L / R,
    # and falls by 1 / (L sqrt(2 pi)) per pixel outwards. The new edge is where shift and distance agree.
    falling = 2 / (10 * np.sqrt(2 * np.pi))
    wanted_px = 5 * falling * 10**2 / (2 * 40) / (1 + 5 * falling)
    shrunk_px = _radius_px(disc) - _radius_px(law(disc, values, _context(disc)))
    # Cubic interpolation of a rim one pixel wide has an error of some hundredths of a pixel.
    assert shrunk_px == pytest.approx(wanted_px, abs=0.03)
    straight = _film(np.tile(np.arange(129) - 64.0, (129, 1)))
    assert torch.allclose(law(straight, values, _context(straight)), straight, atol=0.08 * FILM_UM)


def test_a_constant_shift_is_the_bias_without_its_cause() -> None:
    film = _film(_disc(25))
    shifted = get_effect("edge-shift")(film, {"bias_px": 1.5}, _context(film))
    assert torch.equal(shifted, get_effect("etch-bias")(film, {"bias_px": 1.5}, _context(film)))
    assert {(one.knowledge, one.role, one.of_films) for one in FILM_LAWS.values()} == {
        ("law", "undetermined", True)
    }


def test_electrons_come_back_where_something_is_written() -> None:
    layout = _film(_disc(20))
    dose = get_effect("electron-backscatter")(layout, {"weight": 0.5, "length_px": 8.0}, _context(layout))
    # Electrons are spread, not lost, except those that leave the field, four lengths away.
    assert float(dose.sum()) == pytest.approx(float(layout.sum()), rel=1e-3)
    assert 0 < float(dose[0, 0, 48, 48 + 26]) < FILM_UM / 3


def _prints(count: int, bias_px: float) -> list[PrintedScan]:
    """Return noisy scans of random films, which are made by a spot, a threshold and an edge bias."""
    numbers = {"spot.sigma_um": 0.014, "etch.bias_px": bias_px}
    printer = build_model("e-beam", **(BARE | numbers), **GEOMETRY)
    scans = []
    for number in range(count):
        rng = np.random.default_rng([5, number])
        smooth = gaussian_filter(rng.normal(size=(96, 96)), 6, mode="wrap")
        level = (16 * (smooth > 0)).astype(np.uint8)
        blank = PrintedScan(
            id=f"F{number:02}", print_id=f"F{number:02}", order=number, mask_level=level,
            height_um=np.zeros(level.shape, np.float32), valid=np.ones(level.shape, bool),
            scan_to_layout=np.eye(3), seen_by="sem", **GEOMETRY,
        )  # fmt: skip
        with torch.no_grad():
            film = printer(torch.from_numpy(blank.layout_um)[None, None])[0, 0].numpy()
        noisy = film + FILM_UM * 0.02 * rng.normal(size=film.shape)
        scans.append(replace(blank, height_um=noisy.astype(np.float32)))
    return scans


@pytest.mark.pictures
def test_the_loop_names_the_bias_that_a_bare_printer_lacks(tmp_path: Path) -> None:
    scans = _prints(10, -3.5)
    store = write_store(tmp_path / "films.zarr", scans, instrument="sem")
    result = close_loop(store, tmp_path / "loop", base="e-beam", base_settings=BARE, folds=2)
    assert [one.name for one in result.effects] == ["etch-bias"]
    (found,) = result.effects[0].strengths["bias_px"]
    # The refitted threshold and spot absorb part of the bias, but do not change its sign.
    assert -4.5 < found.value < -1
    before, after = result.error("base"), result.error("all")
    assert before is not None
    assert after is not None
    assert (before.policy, before.k) == ("none", 0)
    assert after.leading_nm < before.leading_nm
    assert {one.name for one in result.candidates} == {"electron-backscatter", "resist-diffusion"}
    assert all(get_effect(one.name).of_films for one in result.candidates)
    assert not result.single_scans
    assert not result.measurement.parts


def test_settings_that_a_base_does_not_have_are_refused(tmp_path: Path) -> None:
    store = write_store(tmp_path / "films.zarr", _prints(2, 0.2), instrument="sem")
    for settings in ({"spot_count": 1}, {"spot.width": 1}, {"parts": ["spots"]}):
        with pytest.raises(InputError, match="spot"):
            close_loop(store, tmp_path / "loop", base="e-beam", base_settings=settings)
    with pytest.raises(InputError, match="small model"):
        close_loop(store, tmp_path / "loop", base="auto", base_settings={"spots": 1})
