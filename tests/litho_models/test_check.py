"""Test the check that a printer still behaves as its model says: alarm rates, invariances, the command."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from litho_data.foundation.errors import InputError
from litho_models.cli.app import main
from litho_models.fitting.runs import train
from litho_models.frozen.freezing import freeze
from litho_models.monitoring import check
from litho_models.monitoring.change_point import (
    Series,
    chance_to_notice,
    likeliest_step,
    noticeable_step,
    shares,
    step_statistics,
)
from litho_models.monitoring.judging import DEFAULT_RATE, forecast, judge, rates
from litho_models.monitoring.prints import FIGURES, Check, print_values, spread_of
from litho_models.monitoring.report import control_chart
from litho_models.monitoring.wording import notes
from litho_models.scan_terms import POLICIES
from litho_models.scan_terms.cross_fit import fitted_terms
from litho_models.scoring.printer_state import ScanFigures, scan_figures
from tests.litho_models.prints import make_scan, make_scans, printed_height_um, write_store
from tests.tables import require_tables_equal_record

GAIN = FIGURES[0]


def _equal(reference: np.ndarray, new: np.ndarray) -> Series:
    return Series(reference, new, np.ones(reference.shape[-1]), np.ones(new.shape[-1]))


def _alarms(series: Series, rate: float) -> np.ndarray:
    """Return for each set whether the t statistic of any comparison raises an alarm."""
    n, m = series.reference.shape[-1], series.new.shape[-1]
    sizes, errors = step_statistics(series)
    limit = stats.t.isf(rate * shares(m) / 2, n + m - 2)
    return (np.abs(sizes / errors) >= limit[:, None]).any(axis=0)


def _gaussian(n: int, m: int, draws: int, step: float = 0.0, seed: int = 3) -> Series:
    random = np.random.default_rng(seed)
    return _equal(random.normal(7, 0.3, (draws, n)), random.normal(7, 0.3, (draws, m)) + 0.3 * step)


def test_each_comparison_is_students_t_with_the_spread_pooled():
    random = np.random.default_rng(0)
    reference, new = random.normal(5, 2, 6), random.normal(5, 2, 4)
    sizes, errors = step_statistics(_equal(reference, new))
    for first in range(4):
        before, after = np.concatenate([reference, new[:first]]), new[first:]
        # The results differ only by rounding.
        assert sizes[first] == pytest.approx(after.mean() - before.mean(), rel=1e-9)
        if len(after) > 1:
            of_scipy = stats.ttest_ind(after, before).statistic
            assert sizes[first] / errors[first] == pytest.approx(of_scipy, rel=1e-9)
    before = np.concatenate([reference, new[:3]])
    alone = (new[3] - before.mean()) / (before.std(ddof=1) * np.sqrt(1 + 1 / 9))
    assert sizes[3] / errors[3] == pytest.approx(alone, rel=1e-9)


@pytest.mark.parametrize("prints", range(1, 9))
def test_the_comparisons_share_the_whole_rate(prints):
    assert shares(prints).sum() == pytest.approx(1)
    assert shares(prints).min() > 0


@pytest.mark.parametrize("rates", [rates(0.01), rates(0.01, FIGURES[:1]), rates(0.01, FIGURES[1:])])
def test_the_figures_share_the_whole_rate(rates):
    assert sum(rates) == pytest.approx(0.01)


@pytest.mark.parametrize(("n", "m"), [(4, 1), (5, 3), (12, 6), (30, 2)])
def test_an_unchanged_printer_alarms_no_more_often_than_stated(n, m):
    rate, draws = 0.02, 20_000
    series = _gaussian(n, m, draws)
    alarms = _alarms(series, rate)
    share = float(alarms.mean())
    # Allow four standard errors. The share may be lower, as correlated comparisons are counted separately.
    assert share <= rate + 4 * np.sqrt(rate / draws)
    assert share >= 0.5 * rate
    for number in (0, int(np.argmax(alarms))):
        p = likeliest_step(Series(series.reference[number], series.new[number], *series[2:]))[1]
        assert (p <= rate) == bool(alarms[number])


def test_a_normal_distribution_in_place_of_students_would_alarm_too_often():
    """Check that a normal distribution would give over 3 % false alarms with 5 reference prints, instead of
    0.5 %.
    """
    random = np.random.default_rng(1)
    series = _equal(random.normal(size=(20_000, 5)), random.normal(size=(20_000, 1)))
    z = (series.new[:, 0] - series.reference.mean(axis=1)) / series.reference.std(axis=1, ddof=1)
    assert np.mean(np.abs(z) >= stats.norm.isf(0.0025)) > 0.03


@pytest.mark.parametrize(("n", "m"), [(12, 3), (48, 3), (24, 1), (10, 7)])
def test_a_step_is_noticed_as_often_as_the_closed_form_says(n, m):
    """Check prints whose values are Gaussian. The values of the last three prints are shifted by three
    standard deviations.
    """
    rate, draws, soon = 0.004, 20_000, min(3, m)
    stated = chance_to_notice(3, np.ones(n), np.ones(m), rate)
    moved = np.where(np.arange(m) >= m - soon, 3.0, 0.0)
    share = float(_alarms(_gaussian(n, m, draws, moved, seed=4), rate).mean())
    # The lower limit allows four standard errors. Other comparisons also notice some steps.
    error = np.sqrt(stated * (1 - stated) / draws)
    assert stated - 4 * error <= share <= stated + 0.02 + 4 * error


def test_the_noticeable_step_is_noticed_in_nine_of_ten_cases():
    variances = np.array([1.0, 1.0, 0.5, 2.0, 1.0]), np.array([1.5, 1.0])
    step = noticeable_step(*variances, rate=0.01)
    # The step is a root, found to 1e-12.
    assert chance_to_notice(step, *variances, rate=0.01) == pytest.approx(0.9, abs=1e-6)


def test_the_page_has_the_chance_to_notice_three_spreads_within_three_prints():
    """Check the table in docs/checking.md, which describes our rule, the most powerful test, and the
    noticeable step.
    """
    page = (Path(__file__).parents[2] / "docs" / "checking.md").read_text("utf-8")
    own = rates(DEFAULT_RATE)[0]
    for prints in (6, 12, 24, 30, 48):
        ours = chance_to_notice(3, np.ones(prints), np.ones(3), own)
        # The uniformly most powerful unbiased test that knows neither mean nor spread is a t test of the
        # three new prints together (Lehmann and Romano, Testing Statistical Hypotheses, section 5.3).
        limit = stats.t.isf(DEFAULT_RATE / 2, prints + 1)
        best = stats.nct.sf(limit, prints + 1, 3 / np.sqrt(1 / 3 + 1 / prints))
        step = noticeable_step(np.ones(prints), np.ones(3), own)
        assert f"| {prints} | {100 * ours:.1f} % | {100 * best:.1f} % | {step:.1f} |" in page


def test_an_alarm_names_the_first_changed_print_and_the_size_of_the_step():
    random = np.random.default_rng(5)
    new = random.normal(0, 0.01, 6)
    new[2:] += 0.2
    step, p = likeliest_step(_equal(random.normal(0, 0.01, 20), new))
    assert p < 1e-6
    assert step.since == 2
    assert step.ci95[0] < 0.2 < step.ci95[1]


def _scans(values: np.ndarray, first_print: int = 0) -> list[ScanFigures]:
    """Return the figures of scans. ``values`` contains their gains, by print and scan."""
    return [
        ScanFigures(
            scan=f"P{p}F{f}",
            print=f"P{p}",
            order=p,
            gain=float(value),
            gain_error=0.001,
            error_nm=15.0,
            pixels=10_000,
            relief_nm=150.0,
            steepness=0.2,
        )
        for p, row in enumerate(values, first_print)
        for f, value in enumerate(row)
    ]


@pytest.mark.parametrize(("between", "within"), [(0.02, 0.0), (0.0, 0.02), (0.01, 0.02)])
def test_prints_of_one_scan_beside_prints_of_four_keep_the_rate(between, within):
    """Check prints with one scan. Their values vary more than those of prints with several scans. Ignoring
    this would cause too many alarms.
    """
    draws, rate = 800, 0.05
    random = np.random.default_rng(11)
    alarms = 0
    for _ in range(draws):
        old, now = (
            np.exp(random.normal(0, between, (prints, 1)) + random.normal(0, within, (prints, scans)))
            for prints, scans in ((10, 4), (2, 1))
        )
        rows, fresh = _scans(old), _scans(now, 10)
        spread = spread_of(rows, GAIN)
        parts = [print_values(group, GAIN) for group in (rows, fresh)]
        variances = [spread.relative_variance(part.counts) for part in parts]
        alarms += likeliest_step(Series(parts[0].values, parts[1].values, *variances))[1] <= rate
    # The tolerance of 0.031 is four standard errors. The variances are estimated too.
    assert alarms / draws <= rate + 0.031


@pytest.mark.parametrize(("scans", "said"), [(1, "does not account"), (2, "accounts")])
def test_the_spread_within_prints_is_accounted_for_only_if_it_is_known(scans, said):
    old, new = _scans(1 + 0.01 * np.arange(6 * scans).reshape(6, scans)), _scans(np.ones((2, 4)), 6)
    assert (spread_of(old, GAIN).within is None) == (scans == 1)
    assert any(f"the comparison {said} for this difference" in note for note in notes(old, new, []))


def test_the_chart_shows_prints_of_one_store_in_printing_order():
    rows = _scans(1 + 0.01 * np.arange(8.0)[:, None])
    for between, places in ((True, [1, 2]), (False, [6, 7])):
        shown = Check.model_construct(reference_scans=[rows[0], *rows[3:]], new_scans=rows[1:3])
        one = judge(shown.reference_scans, shown.new_scans, between=between)[0]
        axes = control_chart(shown, one, between=between).axes[0]
        new = next(line for line in axes.lines if line.get_label() == "new")
        assert list(new.get_xdata()) == places


def test_a_steady_drift_reaches_the_tolerance_when_it_must():
    values = 0.01 * np.arange(12.0)
    reference = np.arange(12) < 9
    found = forecast(values, np.ones(12), reference, tolerance=0.2)
    assert found.per_print == pytest.approx(0.01)
    # At 0.01 per print, the drift reaches 0.2 at 20 prints after print 4, the centre of the reference.
    assert found.prints_left in (12, 13)  # rounding may exclude the thirteenth
    noisy = values + np.random.default_rng(0).normal(0, 0.02, 12)
    assert forecast(noisy, np.ones(12), reference, tolerance=0.2).prints_left < 12


def test_figures_do_not_depend_on_datum_tilt_and_bow_and_follow_the_height():
    scan = make_scan(0)
    height, level = scan.height_um.astype(np.float64), scan.layout_um
    y, x = np.meshgrid(*(np.linspace(-1, 1, size) for size in scan.shape), indexing="ij")
    surface = 0.3 + 0.05 * x - 0.02 * y + 0.04 * x * x - 0.03 * x * y + 0.06 * y * y
    plain, moved, taller = (
        scan_figures(_with_height(scan, changed), level)
        for changed in (height, height + surface, 1.1 * height)
    )
    assert plain is not None
    assert moved is not None
    assert taller is not None
    # A float32 height of 0.5 µm has an error of 3e-8 µm, which is averaged over thousands of pixels.
    assert moved.gain == pytest.approx(plain.gain, rel=1e-6)
    assert moved.error_nm == pytest.approx(plain.error_nm, rel=1e-5)
    assert taller.gain == pytest.approx(1.1 * plain.gain, rel=1e-6)
    # The gain equals that of a joint fit of all seven terms.
    joint = fitted_terms(scan.height_um, level, scan.valid, POLICIES["full"])[0]
    assert np.min(np.abs(1 + joint - plain.gain)) < 1e-6


def _with_height(scan, height_um):
    return replace(scan, height_um=height_um.astype(np.float32))


def test_a_flat_layout_has_no_gain():
    from dataclasses import replace

    scan = make_scan(0)
    flat = replace(scan, mask_level=np.full_like(scan.mask_level, 5))
    assert scan_figures(flat, np.full(scan.shape, 0.4)) is None


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Write a model of twelve prints and two new sets of prints. One set is unchanged; the other is 8 %
    taller from the second print on.
    """
    folder = tmp_path_factory.mktemp("check")
    scans = make_scans(44, size_px=64)
    made = write_store(folder / "made.zarr", scans[:24])
    train(made, "affine", folder / "run")
    freeze(folder / "run", folder / "model")
    later = scans[24:32]
    taller = [
        _with_height(scan, scan.height_um + 0.08 * printed_height_um(scan.layout_um) * (place > 1))
        for place, scan in enumerate(later)
    ]
    write_store(folder / "same.zarr", later, name="same")
    write_store(folder / "taller.zarr", taller, name="taller")
    write_store(folder / "few.zarr", scans[32:38], name="few")
    return folder


def test_unchanged_prints_raise_no_alarm_whatever_their_datum(lab, tmp_path):
    plain = check(lab / "model", lab / "same.zarr", tmp_path / "out")
    assert not plain.alarm
    assert plain.verdict[0].startswith("No alarm: 4 new prints")
    assert plain.figures[0].reference_prints == 12
    assert Check.read(tmp_path / "out") == plain
    other = [make_scan(number, size_px=64, datum_um=0.4, bow_um=0.1) for number in range(24, 32)]
    moved = check(lab / "model", write_store(tmp_path / "moved.zarr", other, name="m"), tmp_path / "moved")
    for first, second in zip(plain.figures, moved.figures, strict=True):
        # Heights have float32 errors, as above.
        assert second.p == pytest.approx(first.p, rel=1e-3)


def test_an_error_that_the_fit_has_made_small_is_not_judged(lab, tmp_path):
    """Check this because new prints have a larger error than prints that were used in the fit, even if
    nothing has changed.
    """
    shutil.copytree(lab / "model", tmp_path / "model")
    card = json.loads((tmp_path / "model" / "card.json").read_text())
    honest = check(lab / "model", lab / "same.zarr", tmp_path / "honest")
    (tmp_path / "model" / "card.json").write_text(json.dumps(card | {"parameters": 100_000}))
    flexible = check(tmp_path / "model", lab / "same.zarr", tmp_path / "flexible")
    names = [[figure.name for figure in result.figures] for result in (honest, flexible)]
    assert [name for name in names[0] if name != "error"] == names[1]
    assert "error" in names[0]
    assert [any("error is not judged" in note for note in one.notes) for one in (honest, flexible)] == [
        False,
        True,
    ]


@pytest.mark.pictures
def test_taller_prints_end_the_strict_command_with_3(lab, tmp_path, monkeypatch, capsys):
    arguments = ["check", str(lab / "model"), str(lab / "taller.zarr"), "--out", str(tmp_path / "out")]
    assert _exit_code(monkeypatch, [*arguments, "--strict"]) == 3
    assert capsys.readouterr().out.startswith("ALARM: since print 13, the height gain is")
    assert _exit_code(monkeypatch, arguments) == 0
    found = Check.read(tmp_path / "out")
    alarm = found.figures[0].alarm
    assert found.alarm
    assert alarm is not None
    assert alarm.since == "13"
    assert alarm.step_ci95[0] < 0.08 < alarm.step_ci95[1]
    assert found.figures[0].measure_again_in == 0
    assert found.run.command.startswith("litho-models check ")
    assert "changed" in (tmp_path / "out" / "report.html").read_text()
    require_tables_equal_record(tmp_path / "out", Check.FILE_NAME, {"scans.csv": {"set": ""}})


def test_prints_of_one_store_are_checked_against_its_others(lab, tmp_path):
    found = check(lab / "model", lab / "made.zarr", tmp_path / "out", new=["3", "7"])
    assert (found.figures[0].reference_prints, found.figures[0].new_prints) == (10, 2)
    assert any("new prints were used to fit the model" in note for note in found.notes)


@pytest.mark.parametrize(
    ("store", "given", "message"),
    [
        ("same", {"reference": "few"}, "prints in the reference, got 3, wanted at least 4"),
        (
            "same",
            {"reference": "same"},
            "which shares scans with .*, wanted a store without the checked scans; use --new",
        ),
        ("same", {"reference": "made", "new": ["12"]}, "got both a store and --new, wanted only one"),
        ("same", {"new": ["99"]}, "--new, got 99, wanted a print of"),
        ("made", {}, "got the prints from which the model was made, wanted new prints; use --reference"),
        ("same", {"false_alarms": 0.0}, "rate of false alarms, got 0.0"),
        ("same", {"tolerance": 5.0}, "0.05 for 5 %"),
        ("pitch", {}, "pitch_um for model affine, got 0.2 µm, wanted 0.1 µm"),
        ("other", {"reference": "other-too"}, "the model describes another printer"),
    ],
)
def test_bad_input_is_one_line(lab, tmp_path, store, given, message):
    if store == "pitch":
        coarse = [replace(scan, pitch_um=0.2) for scan in make_scans(2, size_px=64)]
        write_store(lab / "pitch.zarr", coarse, name="pitch")
    for place, name in enumerate(("other", "other-too") if store == "other" else ()):
        flat = [
            _with_height(scan, 0.2 * scan.height_um)
            for scan in make_scans(20, size_px=64)[10 * place : 10 * place + 10]
        ]
        write_store(lab / f"{name}.zarr", flat, name=name)
    given = {**given, **({"reference": lab / f"{given['reference']}.zarr"} if "reference" in given else {})}
    with pytest.raises(InputError, match=message) as caught:
        check(lab / "model", lab / f"{store}.zarr", tmp_path / "out", **given)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_an_older_card_asks_for_a_reference_and_takes_one(lab, tmp_path):
    freeze(lab / "model", tmp_path / "older")
    file = tmp_path / "older" / "card.json"
    card = json.loads(file.read_text())
    assert len(card.pop("baseline")) == 20
    file.write_text(json.dumps(card))
    with pytest.raises(
        InputError, match="got no values of reference prints, wanted reference values; use --reference"
    ):
        check(tmp_path / "older", lab / "same.zarr", tmp_path / "out")
    given = check(tmp_path / "older", lab / "same.zarr", tmp_path / "out", reference=lab / "made.zarr")
    of_card = check(lab / "model", lab / "same.zarr", tmp_path / "of_card")
    assert given.figures == of_card.figures


def _exit_code(monkeypatch, arguments: list[str]) -> int:
    monkeypatch.setattr(sys, "argv", ["litho-models", *arguments])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0
