"""What the layout does far away: found with its direction and its side, and not where nothing is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from litho_models.twin.prepared import PreparedScan, prepare_scans
from litho_models.loop.probes import selection, with_intervals
from litho_models.loop.probes.far import DIRECTIONS, LENGTHS_UM, _columns, far_response, in_words, summary
from litho_models.loop.probes.linear import Left, LinearProbe
from litho_models.loop.report.plots import probe_figure
from litho_models.loop.selection.confirming import SMALLEST_SHARE
from tests.litho_models.loop_scans import PITCH_UM
from tests.litho_models.test_loop_probes import FOLD_OF, NOISE_UM, SIZE_PX, probed, scene

SCENE = scene()
# What lies beyond the edge, in pixels: six lengths, exp(-6) is left.
AROUND_PX = 180


def averaged(layout: np.ndarray, direction_deg: float, length_um: float) -> np.ndarray:
    """Mean of the layout at distances s against a direction, weighted by exp(-s / length), by summing.

    Every ray is walked in steps of a pixel.
    """
    around = np.pad(layout - layout.mean(), AROUND_PX, mode="edge")
    angle = np.deg2rad(direction_deg)
    inside = np.arange(SIZE_PX) + AROUND_PX
    steps = np.arange(AROUND_PX)
    weights = np.exp(-steps * PITCH_UM / length_um)
    mean = np.zeros(layout.shape)
    for step, weight in zip(steps, weights / weights.sum(), strict=True):
        y, x = (round(-step * part) for part in (np.sin(angle), np.cos(angle)))
        mean += weight * around[np.ix_(inside + y, inside + x)]
    return mean


def planted(change: Callable[[np.ndarray], np.ndarray]) -> tuple[list[PreparedScan], list[np.ndarray]]:
    """The scene with a change that follows the layout."""
    scans, predictions = SCENE
    changed = [
        replace(f.stored, height_um=(f.stored.height_um + change(f.stored.layout_um)).astype(np.float32))
        for f in scans
    ]
    return prepare_scans(changed), predictions


def probe_of(scans: list[PreparedScan], predictions: list[np.ndarray]) -> LinearProbe:
    probe = far_response(Left(scans, predictions, [np.ones(len(f.sample), bool) for f in scans]))
    assert probe is not None
    return probe


def values_of(probe: LinearProbe) -> dict[str, float]:
    common = probe.held_out(FOLD_OF).common
    return {name: value for name, (value, _) in probe.summary(common).items()}


@pytest.mark.slow
def test_what_trails_to_one_side_is_taken_with_its_direction_and_length(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """6 % of the layout, trailing by 3 µm along x, in the contest with the other probes of the layout."""
    rivals = ("missing-kernel", "displaced-copy", "far-response")
    monkeypatch.setattr(selection, "GENERIC", {name: selection.GENERIC[name] for name in rivals})
    trailing = probed(*planted(lambda layout: -0.06 * averaged(layout, 0.0, 3.0))).added[0]
    assert trailing.probe.name == "far-response"
    values = {n: v for n, (v, _, _) in with_intervals(trailing.probe, trailing.estimate).items()}
    # Half the angle between two rays. The ridge, and the plane and bow that every scan may have, take from
    # the far end, so that a response looks shorter than it is, and as much stronger.
    assert values["direction"] == pytest.approx(0.0, abs=5.0)
    assert 2.0 < values["length"] < 3.6
    assert -0.10 < values["amount"] < -0.05
    assert "to one side, at" in in_words(values)
    assert probe_figure(trailing).axes
    before, after = (one.rmse_nm**2 - (1e3 * NOISE_UM) ** 2 for one in (trailing.before, trailing.after))
    # Of a response that starts at the pixel itself a grid of 0.4 µm does not hold the first part.
    assert after < 0.35 * before


@pytest.mark.parametrize("direction", [35.0, 90.0, 215.0, 270.0])
def test_a_direction_and_its_opposite_are_told_apart(direction: float) -> None:
    """35 degrees lies between two rays, 270 is against 90."""
    probe = probe_of(*planted(lambda layout: 0.06 * averaged(layout, direction, 3.0)))
    values = values_of(probe)
    # Half the angle between two rays.
    assert values["direction"] == pytest.approx(direction, abs=5.0)
    assert abs(values["opposite"]) < 0.5
    assert "to one side" in in_words(values)


def test_what_trails_to_both_sides_is_called_alike() -> None:
    both = [60.0, 240.0]
    values = values_of(
        probe_of(*planted(lambda layout: 0.04 * sum(averaged(layout, one, 3.0) for one in both)))
    )
    assert values["direction"] == pytest.approx(60.0, abs=5.0)
    assert "to both sides alike" in in_words(values)


@pytest.mark.parametrize(
    ("on_ray", "words"),
    [
        ({3: 1.0}, "to one side, at 30°"),
        ({3: 1.0, 21: 0.9}, "along one direction, at 30° from x to y, to both sides alike"),
        ({3: 1.0, 21: -0.9}, "at 30° from x to y, with opposite sign on the other side"),
        (dict.fromkeys(range(DIRECTIONS), -1.0), "all round"),
    ],
)
def test_the_words_follow_from_where_the_response_lies(on_ray: dict[int, float], words: str) -> None:
    coefficients = np.zeros((len(LENGTHS_UM), DIRECTIONS))
    for ray, amount in on_ray.items():
        coefficients[0, ray] = amount
    values = {name: value for name, (value, _) in summary(coefficients.ravel()).items()}
    assert words in in_words(values)
    # One exponential has its own length, and its amount on each of three rays that share it.
    assert values["length"] == pytest.approx(LENGTHS_UM[0])
    assert values["amount"] == pytest.approx((3 if len(on_ray) > 2 else 1) * coefficients[0, 3])


def test_noise_gives_nothing() -> None:
    probe = probe_of(*SCENE)
    assert probe.held_out(FOLD_OF).mean_gain_nm2 < 0.1 * SMALLEST_SHARE * (1e3 * NOISE_UM) ** 2


def test_the_control_leaves_nothing_of_what_all_scans_share() -> None:
    """Signs of whole scans at random: of ten, at most eight agree in 98 draws of 100."""
    probe = probe_of(*planted(lambda layout: 0.06 * averaged(layout, 0.0, 3.0)))
    random = np.random.default_rng(0)
    controls = probe.controls(FOLD_OF, random, 20)
    assert np.median(controls) < 0.05 * probe.held_out(FOLD_OF).mean_gain_nm2


def test_the_layout_goes_on_beyond_its_edge() -> None:
    """A step across x: the average along x is (1 - exp(-s / L)) beyond it and nothing before it."""
    scan = SCENE[0][0]
    at = SIZE_PX // 2
    layout = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    layout[:, at:] = 1.0
    stepped = replace(scan, stored=replace(scan.stored, mask_level=(layout * 12).astype(np.uint8)))
    high = np.ptp(stepped.stored.layout_um)
    maps = _columns(stepped, layout).reshape(len(LENGTHS_UM), DIRECTIONS, SIZE_PX, SIZE_PX) / high
    away_um = (np.arange(SIZE_PX) - at + 0.5) * PITCH_UM
    for length_um, (along, *_), against in zip(LENGTHS_UM, maps, maps[:, DIRECTIONS // 2], strict=True):
        expected = np.where(away_um > 0, 1 - np.exp(-away_um / length_um), 0.0) - 0.5
        # What comes round on the periodic grid, exp(-10) at most, and a step on a grid of 0.4 µm that is
        # smoothed by 0.2 µm: 0.4 / 2 away from it by less than a hundredth beyond 1 µm.
        far = np.abs(away_um) > 1.0
        assert np.abs(along - expected)[:, far].max() < 0.02
        assert np.abs(against + expected[::-1])[:, far].max() < 0.02


def test_a_blank_layout_has_no_response() -> None:
    scans, predictions = SCENE
    blank = [
        replace(f, stored=replace(f.stored, mask_level=np.zeros_like(f.stored.mask_level))) for f in scans
    ]
    assert far_response(Left(blank, predictions, [np.ones(len(f.sample), bool) for f in scans])) is None
